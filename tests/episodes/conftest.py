"""rerun raises in the tests of its files."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import rerun as rr


@pytest.fixture(autouse=True)
def strict_rerun() -> Iterator[None]:
    """Without it rerun turns what it refuses into warnings."""
    before = rr.strict_mode()
    rr.set_strict_mode(True)
    yield
    rr.set_strict_mode(before)
