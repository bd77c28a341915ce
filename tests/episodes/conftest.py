"""Rerun raises errors in these tests instead of warning."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import rerun as rr


@pytest.fixture(autouse=True)
def strict_rerun() -> Iterator[None]:
    """Turn on rerun's strict mode; without it rerun warns about invalid data instead of raising."""
    before = rr.strict_mode()
    rr.set_strict_mode(True)
    yield
    rr.set_strict_mode(before)
