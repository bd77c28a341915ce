from __future__ import annotations

from collections.abc import Iterator

import pytest
import viser

from tests.drive.live import Live


@pytest.fixture(scope="module")
def open_live() -> Iterator[Live]:
    """A live page, made once for a file: each of its tests shows it what it needs."""
    live = Live(viser.ViserServer(host="127.0.0.1", port=0, verbose=False))
    yield live
    live.server.stop()


@pytest.fixture
def live_page(server: viser.ViserServer) -> Live:
    """A live page of a test's own, for what keeps how it was arranged."""
    return Live(server)
