"""The row of marks above the tabs."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, cast

from tests.drive.env_rows import rows_of
from tests.drive.live import StubSession
from tests.drive.panels import Panels
from tests.drive.scenes import camera, changed, running
from workbench.app.marks import EPISODES, Marks, flagged_text, moved_mark, recording_mark
from workbench.cameras.commands import PutMovedCamerasBack, ShowCameraChange
from workbench.cameras.events import CameraChosen, EditWanted
from workbench.cameras.view import EditRequest, StudioCamera, StudioView
from workbench.checks.commands import ShowChecks
from workbench.checks.results import RuleResult
from workbench.checks.state import ChecksView
from workbench.envs.gpu_rules import Finding
from workbench.envs.outliers import Outlier, OutlierKind
from workbench.live.env_commands import ShowFirstFlagged
from workbench.live.process.background_jobs import JobProgress
from workbench.page.commands import ShowTab
from workbench.page.widgets.open_tabs import OpenTabs
from workbench.page.widgets.templates import render
from workbench.record.commands import StopRecording
from workbench.record.saving_state import SaveStatus
from workbench.record.state import RecordingStatus


def marks(panels: Panels, session: StubSession | None = None) -> Marks:
    return Marks(panels.server, cast(Any, session or StubSession()), OpenTabs(panels.visitors))


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
    assert "wb-sight-saving" in panels.html() and panels.presses(ShowTab(tab=EPISODES))
    row.draw(view)
    assert "wb-sight" not in panels.html()


def test_each_page_sees_that_others_are_open(panels: Panels) -> None:
    row, view = marks(panels), running(6)
    row.draw(replace(view, pages=1))
    assert "pages" not in panels.html()
    row.draw(replace(view, pages=3))
    assert "3 pages" in panels.html()


def test_the_recorded_envs_are_named_and_those_that_wait(panels: Panels) -> None:
    def mark(env_idx: tuple[int, ...], num_envs: int = 6, selected: int = 0, **more: Any) -> Any:
        status = RecordingStatus(True, env_idx, 1e9, **more)
        return recording_mark(running(num_envs, selected_env=selected, recording=status))

    assert recording_mark(running(6)) is None
    some = mark((0, 2), episodes=3)
    assert "2" in some["envs"] and "all" not in some["envs"] and some["episodes"] == 3
    assert (some["waiting"], some["all_wait"], some["stop"]) == (0, False, StopRecording())
    assert mark((0, 2), waiting=1)["hint"] != some["hint"] != mark((0, 2), selected=1)["hint"]
    assert mark((0, 2), waiting=2)["all_wait"] and not mark((0, 2), waiting=1)["all_wait"]
    assert mark((0, 2), selected=2)["hint"] == some["hint"]
    assert mark(tuple(range(6)))["envs"] == "all 6 envs" and "all" not in mark((0,), 1)["envs"]
    assert some["since"] == mark((0, 2))["since"] != replace_since(6, 1e9 + 3600)
    row, view = marks(panels), running(6, recording=RecordingStatus(True, (0, 2), 1e9, 1))
    before = row.urgent(view)
    assert row.urgent(replace(view, step_serial=99)) == before
    for change in ({"active": False}, {"env_idx": (0, 3)}, {"waiting": 1}, {"episodes": 2}):
        status = replace(view.of(RecordingStatus), **cast(Any, change))
        assert row.urgent(changed(view, recording=status)) != before, change
    row.draw(view)
    assert panels.presses(StopRecording())


def replace_since(num_envs: int, since: float) -> str:
    mark = recording_mark(running(num_envs, recording=RecordingStatus(True, (0,), since)))
    assert mark is not None
    return str(mark["since"])


def moved_view(*moved: bool) -> Any:
    infos = [camera(f"camera_{k}") for k in range(len(moved))]
    cameras = tuple(
        StudioCamera(one.key, one, None, is_moved, None) for one, is_moved in zip(infos, moved, strict=True)
    )
    return running(6, studio=StudioView(cameras=cameras))


def test_moved_cameras_are_named_and_can_be_put_back_or_written(panels: Panels) -> None:
    session = StubSession()
    row, view = marks(panels, session), moved_view(False, True, True)
    panels.visitors.do = row.do
    assert row.urgent(view) != row.urgent(moved_view(False, True, False))
    assert moved_mark(moved_view(False, False)) is None
    mark, one = moved_mark(view), moved_mark(moved_view(False, True))
    assert mark is not None and one is not None and mark["names"] == "camera_1, camera_2"
    assert one["names"] == "camera_1" and one["what"] != mark["what"]
    row.draw(view)
    assert panels.presses(PutMovedCamerasBack())
    session.shown = moved_view(False, False)
    panels.do(ShowCameraChange())
    assert session.asked == [] and panels.client.sent == []
    session.shown = view
    panels.ask(ShowCameraChange())
    key = ("sensor", "camera_1")
    assert session.asked == [CameraChosen(key), EditWanted(EditRequest("edit", key))]
    assert panels.client.sent == [render("open_tab", tab="Cameras", fold="")]


def test_findings_are_counted_and_open_the_checks(panels: Panels) -> None:
    row = marks(panels)
    panels.visitors.do = row.do
    found = Finding("reward-changes", "warn", "a message", "/home/me/push.py", 24, "code", "evaluate", 3, 1)
    checks = ChecksView("done", 1, (RuleResult("reward-changes", "broken", (found,)),), total=1)
    row.draw(running(6))
    assert not panels.presses(ShowChecks())
    row.draw(running(6, checks=checks))
    panels.ask(ShowChecks())
    assert panels.client.sent == [render("open_tab", tab="Checks", fold="")]


def test_the_flagged_episode_may_be_the_previous_one() -> None:
    first, second = (Outlier(OutlierKind.DROPPED, step, f"fell {step} m") for step in (12, 30))
    now = flagged_text(rows_of(outliers={5: (first, second)}))
    last = replace(rows_of().last, outliers={3: (second, first)})
    before = flagged_text(rows_of(outliers={}, last=last))
    assert flagged_text(rows_of(outliers={})) is None
    assert now is not None and before is not None
    assert "1 of 6" in now[0] and "env 5" in now[1] and "step 12" in now[1] and "fell 12 m" in now[1]
    assert "1 of 6" in before[0] and "env 3" in before[1] and "step 30" in before[1]
    assert len(before[1]) > len(now[1]), "it says that the episode is over"
