"""How far the keeping of past episodes is, for the page."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class KeepStatus:
    active: bool = False
    what: str = ""
    """What is being done, while it is."""
    done: int = 0
    total: int = 0
    """Moments; 0 while they are not counted yet."""
    said: str = ""
    """What came of the last one, once it has ended."""
    failed: bool = False
    """`said` is why it did not go well."""
