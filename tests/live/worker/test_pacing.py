"""The simulated-time budget that decides when a control step is due."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from workbench.live.worker.pacing import Pacer, Rate, Shares


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
    rate.clear()
    rate.tick(20.0)
    assert rate.per_second(20.0) == 0.0, "one step has no rate"
    rate.tick(22.0)
    assert rate.per_second(22.0) == pytest.approx(0.5), "steps that take longer than the window have a rate"


def test_unlimited_speed_is_always_due_and_never_waits() -> None:
    pacer = Pacer(control_dt=0.05, speed=math.inf)
    for now in (0.0, 0.0, 1.0):
        assert pacer.due(now) and pacer.wait() == 0.0
        pacer.spend()
    pacer.speed = 1.0
    pacer.start(2.0)
    assert pacer.due(2.0), "the first step is due at once"
    pacer.spend()
    assert not pacer.due(2.0) and pacer.wait() == pytest.approx(0.05)


def test_a_share_is_that_of_its_kind_of_work_in_the_last_seconds() -> None:
    shares = Shares(window=2.0)
    shares.add("recorded", 0.5, 10.5)
    shares.add("watched", 0.2, 11.0)
    shares.add("recorded", 0.1, 11.9)
    assert shares.of("recorded", 12.0) == pytest.approx(0.3) and shares.of("watched", 12.0) == pytest.approx(
        0.1
    )
    assert shares.of("recorded", 12.4) == pytest.approx(0.1), "a part of the first lies in the window"
    assert shares.of("recorded", 13.0) == pytest.approx(0.05) and shares.of("other", 12.0) == 0.0
    shares.clear(20.0)
    assert shares.of("recorded", 20.5) == 0.0
    shares.add("recorded", 0.25, 20.5)
    assert shares.of("recorded", 20.5) == pytest.approx(0.5), "of the time since then"
    shares.add("recorded", 9.0, 21.0)
    assert shares.of("recorded", 21.0) == 1.0
