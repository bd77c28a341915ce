"""Resetting until a first state meets a condition."""

# A session that has a task has a step.
# pyright: reportOptionalMemberAccess=false

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from tests.drive.panels import Panels
from tests.drive.scenes import running
from tests.drive.session import FakeWorkerSession, live_session, wait_until
from workbench.hands.commands import ResetUntil, StopResetUntil
from workbench.hands.reset_until import (
    MAX_RESETS,
    BeginSearch,
    EndSearch,
    ResetSearch,
    ResetTried,
    SearchFailed,
)
from workbench.hands.reset_until_panel import ResetUntilPanel
from workbench.live.commands import ChoosePauseEntry, ChoosePauseTest, PlayRun, SetPauseLevel, SetSeed
from workbench.live.messages import Play, Reset
from workbench.live.pause_when import PauseWhen
from workbench.page.command import Refused

FAR_RIGHT = """

from mani_skill.envs.tasks import PickCubeEnv
from mani_skill.utils.registration import register_env


@register_env("FarRight-v1", max_episode_steps=10)
class FarRightEnv(PickCubeEnv):
    def evaluate(self):
        return {**super().evaluate(), "right": self.cube.pose.p[:, 1]}
"""


def test_the_first_seed_that_meets_the_condition_is_shown(child_process: None, tmp_path: Path) -> None:
    (task := tmp_path / "far_right.py").write_text(FAR_RIGHT)
    with live_session(task, tmp_path / "recordings", num_envs=2) as session:
        session.do(ChoosePauseEntry(entry="right"))
        session.do(ChoosePauseTest(test="rises above"))
        session.do(SetPauseLevel(level=0.08))
        session.do(ResetUntil())
        view = wait_until(session, lambda v: v.of(ResetSearch).state == "found", "a seed")
        search = view.of(ResetSearch)
        assert view.seed == search.seed >= 2 and view.selected_env == search.env
        assert search.tried == search.seed, "every seed between was tried"
        wait_until(session, lambda v: v.timeline.last >= 1, "the reset")
        right = session.view().step.evaluate["right"]
        assert right[search.env] > 0.08
        for seed in range(2, search.seed, 2):
            last = session.view().timeline.last
            session.do(SetSeed(seed=seed))
            view = wait_until(session, lambda v, n=last: v.timeline.last > n, "the reset")
            assert (view.step.evaluate["right"] <= 0.08).all()


@pytest.fixture
def begun(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """The effects of a fake session's search."""
    effects: list[Any] = []
    monkeypatch.setattr("workbench.hands.reset_until.SearchJobs.perform", lambda _, one: effects.append(one))
    return effects


def test_the_env_in_front_is_preferred_and_the_run_pauses(fake: FakeWorkerSession, begun: list[Any]) -> None:
    fake.load()
    fake.session.do(ChoosePauseEntry(entry="success"))
    fake.session.do(PlayRun())
    fake.session.change(selected_env=1)
    fake.session.do(ResetUntil())
    fake.asked(Reset)
    fake.session.dispatch(ResetTried(3, 3, ()))
    assert fake.view.of(ResetSearch).tried == 3 and not fake.asked(Reset)
    fake.session.dispatch(ResetTried(6, 3, (0, 1)))
    assert fake.view.of(ResetSearch).state == "found"
    assert (fake.view.seed, fake.view.selected_env) == (6, 1)
    assert fake.worker.sent.count(Reset(None, 6)) == 1 and not fake.asked(Play)[-1].playing
    fake.session.do(ResetUntil())
    assert begun[-1].seeds[0] == 9


def test_a_search_is_bounded_stops_and_goes_on_where_it_stopped(
    fake: FakeWorkerSession, begun: list[Any]
) -> None:
    fake.load()
    fake.session.do(ChoosePauseEntry(entry="success"))
    fake.session.do(ResetUntil())
    (search,) = begun
    assert isinstance(search, BeginSearch) and search.seeds[:2] == range(3, 9, 3)
    fake.session.dispatch(ResetTried(3, 3, ()))
    fake.session.do(StopResetUntil())
    assert EndSearch() in begun
    fake.session.dispatch(ResetTried(6, 3, (0,)))
    assert fake.view.of(ResetSearch).state == "stopped" and fake.view.seed == 0
    fake.session.do(ResetUntil())
    assert begun[-1].seeds[0] == 6
    for seed in begun[-1].seeds:
        fake.session.dispatch(ResetTried(seed, 3, ()))
    assert fake.view.of(ResetSearch).state == "not found"
    fake.session.do(ResetUntil())
    fake.load("patched")
    assert fake.view.of(ResetSearch).state == "stopped", "the code has changed"


def test_another_condition_begins_at_the_present_seed_and_a_failure_is_told(
    fake: FakeWorkerSession, begun: list[Any]
) -> None:
    fake.load()
    fake.session.do(ChoosePauseEntry(entry="success"))
    fake.session.do(ResetUntil())
    assert len(begun[-1].seeds) == MAX_RESETS and fake.view.of(ResetSearch).total == 3 * MAX_RESETS
    fake.session.dispatch(ResetTried(30, 3, ()))
    fake.session.do(StopResetUntil())
    fake.session.do(ChoosePauseTest(test="becomes false"))
    fake.session.do(ResetUntil())
    assert begun[-1].seeds[0] == 3 and fake.view.of(ResetSearch).tried == 0
    fake.session.dispatch(SearchFailed("the task raised", None))
    failed = fake.view.of(ResetSearch)
    assert (failed.state, failed.why) == ("failed", "the task raised")
    fake.session.dispatch(ResetTried(33, 3, (0,)))
    assert fake.view.of(ResetSearch) == failed
    fake.load("patched")
    assert fake.view.of(ResetSearch) == ResetSearch()


def test_the_result_of_another_condition_is_not_shown(panels: Panels) -> None:
    panel, found = (
        ResetUntilPanel(panels.server, 1.0),
        ResetSearch("found", PauseWhen("success"), 8, 40, 6, 1),
    )
    for when, shown in ((PauseWhen("success"), True), (PauseWhen("near"), False)):
        panel.draw(replace(running(2), pause_when=when, features={ResetSearch: found}))
        assert ("Seed 6, env 1" in panels.html("reset_until")) == shown


def test_no_condition_and_a_reward_are_refused(fake: FakeWorkerSession, begun: list[Any]) -> None:
    with pytest.raises(Refused):
        fake.session.do(ResetUntil())
    fake.load()
    with pytest.raises(Refused):
        fake.session.do(ResetUntil())
    fake.session.do(ChoosePauseEntry(entry="reward"))
    with pytest.raises(Refused):
        fake.session.do(ResetUntil())
    assert not begun


def test_the_button_is_there_with_a_condition_and_stops_a_running_search(panels: Panels) -> None:
    panel, view = ResetUntilPanel(panels.server, 1.0), running(2)
    when = PauseWhen("success")
    shown = []
    for search in (
        ResetSearch(),
        ResetSearch("running", when, 8, 40, 6),
        ResetSearch("found", when, 8, 40, 6, 1),
    ):
        panel.draw(replace(view, pause_when=when, features={ResetSearch: search}))
        shown.append(panels.html("reset_until"))
    assert "stop_reset_until" in shown[1] and "stop_reset_until" not in shown[0] + shown[2]
    assert "40" in shown[1] and "6" in shown[2]
