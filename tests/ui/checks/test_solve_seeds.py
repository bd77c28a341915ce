"""The folder *Solve many seeds*: what it says, and what it asks the session for."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import pytest
import viser

from tests.drive.panels import Panels, inputs_of
from tests.ui.scenes import problem, running
from workbench.planning.report import SolvedSeed, SolveReport
from workbench.planning.verdicts import ENOUGH_SEEDS, RewardVerdict
from workbench.session.checks.solve_seeds import SeedsView
from workbench.ui.checks.solve_seeds import (
    SOLVE,
    STOP_SOLVING,
    TITLE,
    SolveSeedsPanel,
    seeds_html,
    verdict_cards,
)

REPORT = SolveReport(
    (
        SolvedSeed(0, 8, 13, 9.25, 3.2, "", Path("/r/seed0.rrd")),
        SolvedSeed(1, 0, 50, 21.5, 12.5, "earned <0.9> a step without success", Path("/r/seed1.rrd")),
    ),
    (RewardVerdict("reward-exploited", "1 of 2 episodes earned more", (1,)),),
    20.0,
    False,
    2,
)
DONE = SeedsView("done", 4, REPORT, total=2)


@dataclass
class RecordedSession:
    """Stands where the session stands for the panel, and notes what it was asked."""

    view: SeedsView = DONE
    asked: list[object] = field(default_factory=list)

    @property
    def seeds_solver(self) -> RecordedSession:
        return self

    def solve_seeds(self, seeds: int) -> None:
        self.asked.append(seeds)

    def stop(self) -> None:
        self.asked.append("stop")


@dataclass
class Shown:
    panel: SolveSeedsPanel
    session: RecordedSession
    panels: Panels
    looked_at: list[Path]

    def draw(self, seeds: SeedsView) -> None:
        self.panel.draw(running(1, seeds=seeds))


@pytest.fixture
def shown(server: viser.ViserServer) -> Iterator[Shown]:
    session, looked_at = RecordedSession(), list[Path]()
    panel = SolveSeedsPanel(server, session, looked_at.append)  # type: ignore[arg-type]
    yield Shown(panel, session, Panels(server), looked_at)


def test_so_many_seeds_as_are_typed_are_solved_and_it_can_be_stopped(shown: Shown) -> None:
    shown.draw(SeedsView())
    assert "Every episode is recorded" in shown.panels.html() and not shown.panels.shows(STOP_SOLVING)
    shown.panels.set("Seeds", 12)
    shown.panels.press(SOLVE)
    shown.draw(SeedsView("starting", 1, total=12, activity="importing push_cube.py"))
    assert "0 of 12 seeds are done" in shown.panels.html() and "importing push_cube.py" in shown.panels.html()
    assert not shown.panels.shows(SOLVE, "button")
    shown.draw(SeedsView("solving", 2, total=12, done=0.6, activity="seed 0 at step 30 of 50"))
    assert "seed 0 at step 30 of 50" in shown.panels.html() and "width: 5%" in shown.panels.html()
    shown.panels.press(STOP_SOLVING)
    assert shown.session.asked == [12, "stop"]


def test_who_comes_back_from_a_recording_finds_the_folder_open(server: viser.ViserServer) -> None:
    SolveSeedsPanel(server, RecordedSession(SeedsView()), lambda path: None)  # type: ignore[arg-type]
    SolveSeedsPanel(server, RecordedSession(DONE), lambda path: None)  # type: ignore[arg-type]
    folders = [
        one
        for one in server.gui._container_handle_from_uuid.values()
        if isinstance(one, viser.GuiFolderHandle)
    ]
    assert [one.expand_by_default for one in folders if one.label == TITLE] == [False, True]
    numbers = [one.value for one in inputs_of(server.gui) if isinstance(one, viser.GuiNumberHandle)]
    assert numbers == [ENOUGH_SEEDS, DONE.total]


def test_each_seed_has_a_row_that_opens_its_recording(shown: Shown) -> None:
    shown.draw(DONE)
    said = shown.panels.html()
    assert "Solved 1 of 2 seeds, in 8 control steps (median). 20 s." in said
    assert "earned &lt;0.9&gt; a step without success" in said and "21.5" in said
    shown.panels.press("look 1")
    assert shown.looked_at == [Path("/r/seed1.rrd")]


def test_a_verdict_is_a_card_as_of_the_checks_with_its_seeds(shown: Shown) -> None:
    shown.draw(DONE)
    assert 'data-rule="reward-exploited"' in shown.panels.html()
    assert "1 of 2 episodes earned more (seeds 1)" in shown.panels.html()
    assert "<b>Mend</b>" not in shown.panels.html()
    shown.panels.press("fold reward-exploited")
    shown.draw(DONE)
    assert "<b>Mend</b>" in shown.panels.html()
    (card,) = verdict_cards(REPORT, old=True)
    assert card.old


def test_it_says_why_it_failed_where_it_was_stopped_and_of_which_version_it_is() -> None:
    def html(seeds: SeedsView) -> str:
        return seeds_html(seeds, lambda seed: str(seed))

    failed = html(SeedsView("failed", why="the task failed", problem=problem()))
    assert "the task failed: KeyError" in failed and "push.py:88" in failed
    stopped = html(SeedsView("stopped", report=REPORT, total=9, stale=True))
    assert "stopped by hand" in stopped and "of the version before" in stopped
    assert "0 of 9 seeds are done" in html(SeedsView("stopped", total=9))


def test_what_the_first_seeds_tell_says_how_many_they_are() -> None:
    def html(state: Any, wanted: int, **changes: Any) -> str:
        report = replace(REPORT, wanted=wanted, **changes)
        return seeds_html(SeedsView(state, report=report, total=wanted), lambda seed: str(seed))

    third = replace(REPORT.seeds[0], seed=2)
    solving = html("solving", 9, seeds=(*REPORT.seeds, third))
    assert "3 of 9 seeds are done, 2 solved" in solving and "Solved 1" not in solving
    assert "What the seeds tell of the reward after 3 of 9 seeds; further ones may change that:" in solving
    assert "No rule of the reward is broken after 3 of 9 seeds." in html(
        "stopped", 9, seeds=(*REPORT.seeds, third), verdicts=()
    )
    assert "is said from 3 seeds on" in html("solving", 9, verdicts=())
    assert "further ones" not in html("solving", 2) and "finishing" in html("solving", 2)
    assert "2 seeds are few: what is wrong" in html("done", 2)
