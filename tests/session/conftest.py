"""A real session with a real worker process on a real task, shared where a test leaves it usable."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from workbench.session.messages import TaskOptions
from workbench.session.session import Session
from workbench.session.view import SessionView

TASKS = Path(__file__).parents[2] / "tasks"
PATIENCE = 90.0
"""Seconds after which a session that does not get where it should is a failed test."""


def wait_until(session: Session, reached: Callable[[SessionView], bool], what: str) -> SessionView:
    """The first snapshot for which `reached` holds."""
    deadline = time.monotonic() + PATIENCE
    seen = -1
    while time.monotonic() < deadline:
        view = session.view()
        if reached(view):
            return view
        seen = session.wait(seen, timeout=0.5)
    view = session.view()
    raise AssertionError(
        f"{what} did not come; state {view.state}, problem {view.problem}, {view.printed.texts[-10:]}"
    )


@pytest.fixture(scope="module")
def session(task_file: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Session]:
    session = Session(
        str(task_file), TaskOptions(num_envs=2), recordings=tmp_path_factory.mktemp("recordings")
    )
    wait_until(session, lambda view: view.task is not None, "the first load")
    yield session
    session.close()
