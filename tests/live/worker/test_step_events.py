"""Which envs a worker records: from now on, or from the next reset."""

from __future__ import annotations

from copy import copy
from dataclasses import replace

import numpy as np

from tests.drive.scenes import step_of
from workbench.live.worker.step_events import StepEvents


def test_an_env_that_waits_for_a_reset_is_not_recorded_from_the_middle_of_an_episode() -> None:
    events = StepEvents()
    events.capture((1,), from_reset=True)
    here = step_of(np.zeros((2, 3, 7), np.float32))

    def due(elapsed: int, *jumped: bool) -> bool:
        step = replace(here, elapsed_steps=np.array([0, elapsed], np.int32))
        return events.pictures_due(step, np.array(jumped))

    assert not due(0, True, False), "another env was reset"
    assert not due(5, False, True), "it went back to an earlier moment"
    assert due(0, False, True) and due(1, False, False)
    events.capture((), from_reset=True)
    assert not due(0, False, True)


def test_an_env_that_is_recorded_already_does_not_wait_with_others_for_a_reset() -> None:
    events = StepEvents()
    here = step_of(np.zeros((3, 3, 7), np.float32))

    def recorded(*jumped: bool) -> list[int]:
        step = replace(here, elapsed_steps=np.where(jumped, 0, 5).astype(np.int32))
        events.pictures_due(step, np.array(jumped))
        return [env for env in range(3) if captures(env)]

    def captures(env: int) -> bool:
        """Whether this env is recorded now: it goes on if it is asked for alone, and waits otherwise."""
        one = copy(events)
        one.capture((env,), from_reset=True)
        return one.pictures_due(replace(here, elapsed_steps=np.full(3, 5, np.int32)), np.zeros(3, bool))

    events.capture((0, 1), from_reset=False)
    assert recorded(False, False, False) == [0, 1]
    events.capture((1, 2), from_reset=True)
    assert events.recorded == {1, 2} and recorded(True, False, False) == [1]
    assert recorded(False, True, True) == [1, 2] == recorded(False, False, False)
    events.capture((0,), from_reset=True)
    events.new_scene()
    assert events.recorded == frozenset() and recorded(True, True, True) == []
