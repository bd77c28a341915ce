"""What the past and a recording are said to be otherwise in, once judged again: the same words for both."""

from __future__ import annotations

import math

from workbench.session.number_text import number_text


def turned(name: str, was: int | None, now: int | None) -> str:
    """When a flag of an episode turned true, and turns true now; None is never."""
    before = "never" if was is None else f"at step {was}"
    return f"{name} never now, was {before}" if now is None else f"{name} now at step {now}, was {before}"


def reward_change(largest: float, returns: tuple[float, float]) -> str:
    """By how much the rewards of an episode changed, or that they are no finite numbers now or were not.

    Args:
        largest: change of one reward; infinite where one of the two is not finite.
        returns: sums of the rewards, as recorded and now.
    """
    if math.isfinite(largest):
        return f"reward by up to {number_text(largest)}"
    was, now = returns
    if math.isfinite(was):
        return f"reward {number_text(now)} now"
    return (
        f"reward no longer {number_text(was)}"
        if math.isfinite(now)
        else f"reward {number_text(now)} at other steps"
    )


def counted(number: int, what: str) -> str:
    """``1 episode``, ``3 episodes``."""
    return f"{number} {what}{'' if number == 1 else 's'}"
