"""Pausing at a condition."""

# A session that has a task has a step.
# pyright: reportOptionalMemberAccess=false

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.drive.scenes import step_of, table_scene
from tests.drive.session import FakeWorkerSession, moment
from workbench.live.commands import ChoosePauseEntry, ChoosePauseTest, PlayRun, SetPauseLevel, Step
from workbench.live.messages import Play
from workbench.live.pause_when import PauseWhen, Test

POSES = table_scene(3)[1]
MET: dict[Test, Callable[[float, float], bool]] = {
    "becomes true": lambda value, level: value != 0,
    "becomes false": lambda value, level: value == 0,
    "rises above": lambda value, level: value > level,
    "falls below": lambda value, level: value < level,
}


@pytest.mark.parametrize("test", MET)
def test_a_condition_is_about_one_number_of_one_env_or_joint(test: Test) -> None:
    values = [0.0, 2.0, 3.0, np.nan]
    step = step_of(table_scene(4)[1], height=np.array(values))
    step = replace(step, qpos=np.array([[9.0, value] for value in values]), reward=np.array(values))
    for entry in ("height", "reward", "slide"):
        for env, value in enumerate(values):
            met = PauseWhen(entry, test, 2.0).is_met(step, env, ("hinge", "slide"))
            assert met == (MET[test](value, 2.0) and not np.isnan(value)), (entry, value)


@given(st.sampled_from(get_args(Test)), st.floats(width=32), st.floats(width=32), st.floats(-9, 9, width=32))
def test_a_condition_holds_where_it_becomes_met(test: Test, old: float, new: float, level: float) -> None:
    when = PauseWhen("height", test, level)
    before, now = (step_of(POSES, height=np.full(3, value, np.float32)) for value in (old, new))
    holds = when.holds(before, now, 1)
    assert holds == (when.is_met(now, 1) and not when.is_met(before, 1))
    assert when.holds(None, now, 1) == when.is_met(now, 1)
    assert not (np.isnan(new) and holds)
    assert not PauseWhen("", test).holds(before, now, 1) and not PauseWhen("gone", test).holds(before, now, 1)


def test_the_run_pauses_at_the_step_at_which_the_selected_env_succeeds(fake: FakeWorkerSession) -> None:
    fake.load()
    session = fake.session
    session.change(selected_env=1)
    session.do(ChoosePauseEntry(entry="success"))
    session.do(PlayRun())
    fake.step(2)
    fake.step(success=(0, 2))
    assert fake.view.playing, "other envs succeeded"
    fake.step(success=(0, 1))
    met = fake.view.timeline.last
    fake.step(2, success=(0, 1))  # the worker makes further steps before the pause arrives
    assert not fake.view.playing and [request.playing for request in fake.asked(Play)] == [True, False]
    assert fake.view.step_serial == fake.view.paused_at == met
    session.do(PlayRun())
    assert fake.view.paused_at is None
    fake.step(3, success=(0, 1))
    assert fake.view.playing, "the condition was met before"


def test_a_new_episode_in_which_the_condition_is_met_at_once_pauses(fake: FakeWorkerSession) -> None:
    """The end of the last episode does not count as before."""
    fake.play(1)
    fake.session.change(selected_env=1)
    fake.session.do(ChoosePauseEntry(entry="success"))
    fake.session.do(PlayRun())
    fake.step(success=(1,))
    fake.session.do(PlayRun())
    elapsed = np.array([9, 1, 9], np.int32)
    fake.tell(moment(elapsed, success=(1,), number=50))
    assert not fake.view.playing
    fake.session.do(PlayRun())
    fake.tell(moment(np.array([1, 2, 1], np.int32), success=(1,), number=51))
    assert fake.view.playing, "another env's episode does not matter"


def test_single_steps_do_not_pause_and_leave_the_moment(fake: FakeWorkerSession) -> None:
    fake.load()
    fake.session.do(ChoosePauseEntry(entry="success"))
    fake.session.do(PlayRun())
    fake.step(success=(0,))
    fake.session.do(Step())
    fake.step()
    fake.step(success=(0,))
    assert fake.view.paused_at is None and fake.view.timeline.shown is None


def test_a_threshold_is_chosen_with_its_level(fake: FakeWorkerSession) -> None:
    fake.load()
    for command in (
        ChoosePauseEntry(entry="reward"),
        ChoosePauseTest(test="rises above"),
        SetPauseLevel(level=0.5),
        PlayRun(),
    ):
        fake.session.do(command)
    fake.step(reward=(0.4, 0.9, 0.9))
    assert fake.view.playing
    fake.step(reward=(0.6, 0.0, 0.0))
    assert not fake.view.playing and fake.view.pause_when.text == "reward rises above 0.5"
