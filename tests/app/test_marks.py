"""The row of marks above the tabs."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, cast

from tests.drive.env_rows import rows_of
from tests.drive.live import StubSession
from tests.drive.panels import Panels
from tests.drive.scenes import changed, running
from workbench.app.marks import Marks
from workbench.envs.outliers import Outlier, OutlierKind
from workbench.live.env_commands import ShowFirstFlagged
from workbench.live.process.background_jobs import JobProgress
from workbench.page.widgets.open_tabs import OpenTabs
from workbench.record.saving_state import SaveStatus
from workbench.record.state import RecordingStatus


def marks(panels: Panels) -> Marks:
    return Marks(panels.server, cast(Any, StubSession()), OpenTabs(panels.visitors))


def test_flagged_envs_are_shown_and_a_press_selects_the_first(panels: Panels) -> None:
    """Without the mark, a NaN reward in most envs would show only a green "running"."""
    lost = Outlier(OutlierKind.REWARD_NOT_FINITE, 3, "the reward is <b>NaN</b>")
    row = marks(panels)
    view = replace(running(6), env_table=rows_of(outliers={4: (lost,), 2: (lost,)}))
    row.draw(view)
    (standing,) = (html for html in panels.htmls() if "wb-sight-flagged" in html.content)
    content = standing.content
    assert (
        "2 of 6 envs flagged: the reward is &lt;b&gt;NaN" in content
        and "In env 2, step 3: reward-finite: the reward" in content
    )
    row.draw(replace(view, steps_per_second=21.0))
    assert standing.content is content, "the mark is not redrawn under a press"
    assert panels.presses(ShowFirstFlagged())


def test_saving_of_the_past_is_shown_until_it_is_done(panels: Panels) -> None:
    row, view = marks(panels), running(6)
    saves = SaveStatus(progress=JobProgress("replaying", 3, 20))
    saving = changed(view, recording=replace(view.of(RecordingStatus), saving=saves))
    assert row.urgent(saving) != row.urgent(view)
    row.draw(saving)
    assert "wb-sight-saving" in panels.html()
    row.draw(view)
    assert "wb-sight" not in panels.html()


def test_each_page_sees_that_others_are_open(panels: Panels) -> None:
    row, view = marks(panels), running(6)
    row.draw(replace(view, pages=1))
    assert "pages" not in panels.html()
    row.draw(replace(view, pages=3))
    assert "3 pages" in panels.html()
