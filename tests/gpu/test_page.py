"""The page's basis: a worker plays the task and renders pictures. Rates are printed, not tested."""

# pyright: reportOptionalMemberAccess=false

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.drive.session import wait_until
from tests.gpu.conftest import Simulation, SummaryLine
from workbench.app.session import Session
from workbench.live.commands import PlayRun
from workbench.live.events import PagesCounted
from workbench.live.messages import CameraRequest
from workbench.task.description import TaskOptions

TASK = Path(__file__).parents[2] / "tasks" / "push_cube.py"
STEPS, PICTURES = 100, 5
N = 16


@pytest.fixture
def session(simulation: Simulation, renderer: str, tmp_path: Path) -> Iterator[Session]:
    session = Session(str(TASK), TaskOptions(num_envs=N, backend=simulation), recordings=tmp_path)
    wait_until(session, lambda view: view.task is not None, "the first load")
    yield session
    session.close()


@pytest.mark.slow
def test_a_session_plays_with_pictures(
    session: Session, simulation: Simulation, summary_line: SummaryLine
) -> None:
    assert ("gpu" in session.view().task.backend) == (simulation == "gpu")
    session.dispatch(PagesCounted(1))
    session.change(cameras=(CameraRequest("base_camera", "sensor", ("rgb",)),))
    session.change(speed=float("inf"))
    session.do(PlayRun())
    first = wait_until(
        session, lambda v: bool(v.pictures) and bool(v.step.elapsed_steps.any()), "a first picture"
    )
    begun = time.monotonic()
    view = wait_until(
        session,
        lambda v: (
            v.step_serial >= first.step_serial + STEPS
            and v.pictures_serial >= first.pictures_serial + PICTURES
        ),
        "steps and pictures",
    )
    took = time.monotonic() - begun
    assert view.problem is None
    summary_line(
        f"{simulation}: {(view.step_serial - first.step_serial) / took:.0f} control steps/s of {N} envs, "
        f"{(view.pictures_serial - first.pictures_serial) / took:.1f} pictures/s at the same time"
    )
