"""Fixtures: shared sessions with a real worker on a real task, and sessions whose worker is the test."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.drive.session import FakeWorkerSession, fake_worker_session, live_session
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
def fake(tmp_path: Path) -> Iterator[FakeWorkerSession]:
    """A session whose worker has sent nothing yet."""
    with fake_worker_session(tmp_path / "recordings") as fake:
        fake.asked(object)
        yield fake


@pytest.fixture
def played(fake: FakeWorkerSession) -> FakeWorkerSession:
    """A reset of three envs and three steps: moments 0 to 3."""
    fake.play(3)
    fake.asked(object)
    return fake
