"""The simulated-time budget that decides when a control step is due."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from workbench.live.worker.pacing import Pacer, Rate


def steps_taken(pacer: Pacer, moments: list[float]) -> int:
    taken = 0
    for now in moments:
        while pacer.due(now):
            pacer.spend()
            taken += 1
    return taken


@given(
    control_dt=st.floats(0.01, 0.1),
    speed=st.floats(0.1, 8.0),
    gaps=st.lists(st.floats(0.0, 0.09), min_size=20, max_size=200),
)
def test_simulated_time_follows_wall_time_with_an_uneven_loop(
    control_dt: float, speed: float, gaps: list[float]
) -> None:
    pacer = Pacer(control_dt, speed)
    pacer.start(0.0)
    moments, now = [], 0.0
    for gap in gaps:
        now += gap
        moments.append(now)
    simulated = steps_taken(pacer, moments) * control_dt
    assert simulated <= now * speed + control_dt * 1.001
    assert simulated >= now * speed - control_dt * 1.001


def test_a_long_pause_is_not_caught_up() -> None:
    pacer = Pacer(control_dt=0.05, speed=1.0)
    pacer.start(0.0)
    steps_taken(pacer, [0.0])
    assert steps_taken(pacer, [60.0]) <= 3


def test_a_step_is_due_after_the_returned_wait() -> None:
    pacer = Pacer(control_dt=0.05, speed=0.5)
    pacer.start(0.0)
    assert pacer.due(0.0)
    pacer.spend()
    assert not pacer.due(0.01)
    assert pacer.due(0.01 + pacer.wait())


def test_the_rate_is_that_of_the_last_second() -> None:
    rate = Rate()
    for i in range(100):
        rate.tick(i * 0.02)
    assert rate.per_second(1.98) == pytest.approx(50)
    assert rate.per_second(11.98) == pytest.approx(0.1), "the next step has taken ten seconds already"
