"""Which envs a worker records: from now on, or from the next reset."""

from __future__ import annotations

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
