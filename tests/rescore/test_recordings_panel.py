"""The verdicts on the Rescore tab, and what a press on one opens."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from tests.drive.episodes import made, write
from tests.drive.panels import Clock, Panels
from tests.drive.waiting import until
from tests.rescore.verdicts import verdict
from workbench.episodes.row import Source
from workbench.library.folder import Library
from workbench.live.timeline_commands import ShowRescored, StopRescoring, TurnRescored
from workbench.rescore import verdict_text
from workbench.rescore.recordings_panel import (
    RECORDED,
    TODAYS,
    Code,
    RescoreChoices,
    RescorePanel,
    episode_files,
)
from workbench.rescore.result_parts import MAX_ROWS
from workbench.rescore.state import RescoreView
from workbench.review.commands import ChooseRescoreCode
from workbench.review.playback import Review

AS_RECORDED, TODAYS_CODE = Code(RECORDED, "", recorded=True), Code(TODAYS, "")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for seed in range(1, 4):
        write(tmp_path, made(6, seed=seed), pictures=False)
    return tmp_path


@pytest.fixture
def library(child_process: None, folder: Path) -> Iterator[Library]:
    library = Library(folder)
    library.refresh()
    yield library
    library.close()


@pytest.fixture
def review(library: Library) -> Iterator[Review]:
    review = Review(library)
    yield review
    review.close()


class FakeJob:
    """Stands in for the rescoring job of the panel; holds its last view."""

    def __init__(self) -> None:
        self.view = RescoreView()
        self.started: list[tuple[list[str], dict[str, object]]] = []

    def start(self, files: list[Source], **named: object) -> None:
        """Only store the ids and the options; no job runs here."""
        self.started.append(([file.id for file in files], named))

    def do(self, command: StopRescoring) -> None:
        self.view = replace(self.view, state="stopped")


@dataclass
class Rescoring:
    """The panel on a page, with its inputs."""

    panel: RescorePanel
    panels: Panels
    clock: Clock
    review: Review
    choices: RescoreChoices
    job: FakeJob

    def draw(self, view: RescoreView) -> None:
        self.job.view = view
        self.clock.passes()
        self.panel.draw(self.review.view())


@pytest.fixture
def rescoring(panels: Panels, library: Library, review: Review, clock: Clock) -> Rescoring:
    job, choices = FakeJob(), RescoreChoices(AS_RECORDED)
    panel = RescorePanel(panels.server, cast(Any, job), review, library, choices)
    panels.visitors.do = panel.do
    return Rescoring(panel, panels, clock, review, choices, job)


def test_a_row_opens_its_episode_at_the_first_difference(
    rescoring: Rescoring, library: Library, review: Review
) -> None:
    rows = {row.seed: row for row in library.view().rows}
    given = [
        verdict(rows[seed].id, seed=seed, first_difference=seed + 1, returns=(0.0, float(seed)))
        for seed in (1, 2, 3)
    ]
    rescoring.draw(RescoreView("done", 1, tuple(given), 3, 3))
    assert "3 of 3 episodes differ" in rescoring.panels.html() and "seed 3" in rescoring.panels.html()
    assert not any(rescoring.panels.shows(name) for name in ("Rescore the open recordings", "Stop"))
    rescoring.panels.ask(ShowRescored(run=rows[2].id))  # by the change of their returns: 3, 2, 1
    until(lambda: review.view().opened, "the recording", seen=lambda: review.view().problems)
    view = review.view()
    assert view.opened[0].id == rows[2].id and view.states == (3,)
    rescoring.draw(replace(rescoring.job.view, serial=2))
    assert len(rescoring.panels.charts()) == 1 and rescoring.panels.shows("Rescore the open recordings")
    assert "wb-selected" in rescoring.panels.html()


def test_an_open_recording_is_selected_and_shown_where_it_differs(
    rescoring: Rescoring, library: Library, review: Review
) -> None:
    ids = {row.seed: row.id for row in library.view().rows}
    review.open(list(ids.values()))
    until(lambda: len(review.view().opened) == 3 and not review.view().loading, "the recordings")
    for seed, at in ((2, 3), (3, 1), (1, None)):
        given = verdict(ids[seed], seed=seed, first_difference=at, new_reward=np.arange(5) * np.float32(2))
        rescoring.draw(RescoreView("done", 1, (given,), 3, 3))
        rescoring.panels.ask(ShowRescored(run=ids[seed]))
        view = review.view()
        assert view.chosen is not None and view.chosen.id == ids[seed] and len(view.opened) == 3
        assert view.position == (1 if at is None else at)
        rescoring.draw(rescoring.job.view)
        (chart,) = rescoring.panels.charts()
        assert str(seed) in chart.title and len(chart.lines) == 2
        old, new = (points[:, 1] for _, points in chart.lines)
        assert (old.max(), new.max()) == pytest.approx((4, 8), abs=0.05)


def test_recordings_are_rescored_with_the_chosen_code(
    rescoring: Rescoring, library: Library, review: Review
) -> None:
    ids = {row.seed: row.id for row in library.view().rows}
    wanted = [ids[2], ids[1]]
    rescoring.draw(RescoreView())
    rescoring.panel.rescore_and_notify(wanted)
    rescoring.panel.rescore_and_notify([])
    rescoring.panels.set("Recorded states", True)
    rescoring.panels.set("Code", "today's")
    review.open(wanted)
    until(lambda: len(review.view().opened) == 2 and not review.view().loading, "the recordings")
    rescoring.draw(RescoreView())
    rescoring.panels.press("Rescore the open recordings")
    assert rescoring.job.started == [
        (wanted, {"file": None, "recorded_source": True, "use_env_states": False}),
        (
            [one.id for one in review.view().opened],
            {"file": None, "recorded_source": False, "use_env_states": True},
        ),
    ]


def test_a_row_names_the_changes_and_an_unchanged_row_is_paler(rescoring: Rescoring) -> None:
    moved = {"first_difference": 4, "largest": 0.25, "differing": ("reward",), "returns": (1.0, 2.5)}
    given = (
        verdict("same", seed=5),
        verdict("lost", seed=6, why_not="it has no step"),
        verdict("other", seed=7, metres=0.032, **moved),
    )
    rescoring.draw(RescoreView("done", 1, given, 3, 3))
    html = rescoring.panels.html("wb-again-table")
    rows = re.findall(r'<tr [^>]*class="([^"]*)" title="[^"]*">(.*?)</tr>', html)
    shown = [(style.split(), re.sub(r"<[^>]*>", "|", cells)) for style, cells in rows]
    assert shown == [
        ([], "|seed 7||reward changed by up to 0.25, from step 4|drifted 3.2 cm|||1 → 2.5|"),
        (["wb-same"], "|seed 5||unchanged||10|"),
        (["wb-same"], "|seed 6||not rescored: it has no step|||"),
    ]
    assert verdict_text.PUT_IN in rescoring.panels.html("wb-again"), "the text about drifted states"


def test_a_long_list_is_shown_in_pages(rescoring: Rescoring) -> None:
    many = tuple(verdict(str(k), first_difference=1, returns=(0.0, 99.0 - k), seed=k) for k in range(23))
    rescoring.draw(RescoreView("done", 1, many, 23, 23))
    assert (
        rescoring.panels.html().count('data-do="') == MAX_ROWS + 2
        and "1 to 10 of 23" in rescoring.panels.html()
    )
    for _ in range(3):
        rescoring.panels.ask(TurnRescored(by=1))
    rescoring.draw(RescoreView("done", 2, many, 23, 23))
    assert "21 to 23 of 23" in rescoring.panels.html()
    rescoring.panel.rescore(["no such"])
    rescoring.draw(RescoreView("done", 3, many, 23, 23))
    assert "1 to 10 of 23" in rescoring.panels.html(), "a new result begins at its first page"


def test_a_file_that_becomes_known_is_a_choice_of_code(
    panels: Panels, library: Library, review: Review, tmp_path: Path
) -> None:
    known: list[Path] = []
    panel = RescorePanel(
        panels.server, cast(Any, FakeJob()), review, library, RescoreChoices(AS_RECORDED), lambda: known
    )
    for labels in ([TODAYS, RECORDED], [TODAYS, RECORDED, "pull.py"]):
        panel.draw(review.view())
        assert list(panels.field("Code").options) == labels
        known.append(tmp_path / "pull.py")


def test_an_invalid_choice_sent_by_a_page_is_harmless(rescoring: Rescoring) -> None:
    rescoring.draw(RescoreView())
    assert rescoring.panels.field("Code").value == "as recorded"
    rescoring.panels.set("Recorded states", True)
    rescoring.panels.do(ChooseRescoreCode(code="../../etc"))
    assert (
        rescoring.choices == RescoreChoices(AS_RECORDED, True) and len(rescoring.panels.client.notices) == 1
    )
    rescoring.panels.set("Code", "today's")
    assert rescoring.choices == RescoreChoices(TODAYS_CODE, True)


def test_a_rescoring_can_be_stopped_while_it_runs(rescoring: Rescoring) -> None:
    rescoring.draw(RescoreView("rescoring", 1, total=3))
    rescoring.panels.press("Stop")
    assert rescoring.job.view.state == "stopped"
    rescoring.draw(replace(rescoring.job.view, serial=2))
    assert not rescoring.panels.shows("Stop")


def test_deleted_recordings_are_not_rescored(library: Library) -> None:
    rows = library.view().rows
    found = episode_files(library, ["no such", rows[0].id, rows[0].id])
    assert [(file.id, file.path) for file in found] == [(rows[0].id, rows[0].paths[0])]
