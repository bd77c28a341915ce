"""What the past and a recording are said to be otherwise in, once judged again: the same words for both."""

from __future__ import annotations


def turned(name: str, was: int | None, now: int | None) -> str:
    """When a flag of an episode turned true, and turns true now; None is never."""
    before = "never" if was is None else f"at step {was}"
    return f"{name} never now, was {before}" if now is None else f"{name} now at step {now}, was {before}"


def counted(number: int, what: str) -> str:
    """``1 episode``, ``3 episodes``."""
    return f"{number} {what}{'' if number == 1 else 's'}"
