"""Fixtures: sessions that tests share, with a real worker on a real task, and with a worker that is the test."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.drive.session import Told, live_session, told_session
from workbench.app.session import Session


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


@pytest.fixture
def told(tmp_path: Path) -> Iterator[Told]:
    """Its worker has said nothing yet."""
    with told_session(tmp_path / "recordings") as told:
        told.asked(object)
        yield told


@pytest.fixture
def played(told: Told) -> Told:
    """A reset of three envs and three steps: moments 0 to 3."""
    told.play(3)
    told.asked(object)
    return told
