"""When a page is drawn next."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from workbench.app.pages import FRAME_SECONDS, next_frame

CLOSE = 1e-9


def draw_times(late: list[float], due: float = 0.0) -> list[float]:
    """When frames are drawn that come so much after they are due."""
    drawn = []
    for delay in late:
        drawn.append(due + delay)
        due = next_frame(due, drawn[-1])
    return drawn


def test_a_frame_that_came_late_takes_nothing_from_the_rate() -> None:
    drawn = draw_times([0.0, 0.3 * FRAME_SECONDS, 0.1 * FRAME_SECONDS, 0.4 * FRAME_SECONDS, 0.0])
    assert abs(drawn[-1] - 4 * FRAME_SECONDS) < CLOSE


@given(st.lists(st.floats(0.0, 5.0), min_size=2, max_size=30))
def test_frames_never_follow_closer_than_half_of_their_time_however_late_they_are(late: list[float]) -> None:
    drawn = draw_times(late)
    assert all(b - a > FRAME_SECONDS / 2 - CLOSE for a, b in zip(drawn, drawn[1:], strict=False))
