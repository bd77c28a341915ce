"""A real session with a real worker process on a real task, shared where a test leaves it usable."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.drive.session import live_session
from workbench.session.live.session import Session


@pytest.fixture(scope="module")
def session(
    child_process: None,
    request: pytest.FixtureRequest,
    task_file: Path,
    tmp_path_factory: pytest.TempPathFactory,
) -> Iterator[Session]:
    """Without a renderer, unless the file says that it ``DRAWS``."""
    with live_session(
        task_file, tmp_path_factory.mktemp("recordings"), draw=getattr(request.module, "DRAWS", False)
    ) as session:
        yield session
