from __future__ import annotations

from collections.abc import Iterator

import pytest
import viser


@pytest.fixture
def server() -> Iterator[viser.ViserServer]:
    """A real server on a free port of this machine, without a page."""
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    yield server
    server.stop()
