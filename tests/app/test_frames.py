"""The schedule of page frames."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from workbench.app.pages import FRAME_SECONDS, next_frame

TOLERANCE_SECONDS = 1e-9


def draw_times(late: list[float], due: float = 0.0) -> list[float]:
    """Times of frames that are each drawn this late, in seconds."""
    drawn = []
    for delay in late:
        drawn.append(due + delay)
        due = next_frame(due, drawn[-1])
    return drawn


def test_a_late_frame_does_not_lower_the_rate() -> None:
    drawn = draw_times([0.0, 0.3 * FRAME_SECONDS, 0.1 * FRAME_SECONDS, 0.4 * FRAME_SECONDS, 0.0])
    assert abs(drawn[-1] - 4 * FRAME_SECONDS) < TOLERANCE_SECONDS


@given(st.lists(st.floats(0.0, 5.0), min_size=2, max_size=30))
def test_late_frames_are_never_closer_than_half_a_frame_time(late: list[float]) -> None:
    drawn = draw_times(late)
    assert all(b - a > FRAME_SECONDS / 2 - TOLERANCE_SECONDS for a, b in zip(drawn, drawn[1:], strict=False))
