"""Fixtures: shared sessions with a real worker on a real task, and sessions whose worker is the test."""

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
    """A session shared by the tests of a file; without a renderer unless the file sets ``DRAWS``."""
    with live_session(
        task_file, tmp_path_factory.mktemp("recordings"), draw=getattr(request.module, "DRAWS", False)
    ) as session:
        yield session


@pytest.fixture
def told(tmp_path: Path) -> Iterator[Told]:
    """A session whose worker has sent nothing yet."""
    with told_session(tmp_path / "recordings") as told:
        told.asked(object)
        yield told


@pytest.fixture
def played(told: Told) -> Told:
    """A reset of three envs and three steps: moments 0 to 3."""
    told.play(3)
    told.asked(object)
    return told
