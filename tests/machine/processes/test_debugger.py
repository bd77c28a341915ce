"""``--debug``: a real debugger attaches to the worker, holds it for longer than a worker may hang, and lets it go on."""

# pyright: reportOptionalMemberAccess=false, reportOptionalSubscript=false

from __future__ import annotations

import socket
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from tests.drive.session import wait_until
from tests.live.debug_client import DebugClient
from workbench.app.session import Session
from workbench.app.status_line import status_values
from workbench.cli.main import main
from workbench.live.commands import Interrupt, RestartWorker, Step
from workbench.live.panels.banners import is_busy_for_long
from workbench.live.process import supervisor
from workbench.live.process.supervisor import WorkerOptions
from workbench.live.view import SessionView
from workbench.machine.processes.child_python import child_environment, python_command
from workbench.machine.processes.debugger import port_for_debugger
from workbench.task.description import TaskOptions

HANGS = 0.3
"""Seconds; as short as the worker's ordinary work allows."""

JUDGES, REWARDS = "distance = torch.linalg.norm(", "behind_cube = self.cube.pose.p.clone()"
"""The first lines of two hooks of the task."""


def line_of(file: Path, text: str) -> int:
    return next(i for i, line in enumerate(file.read_text().splitlines(), 1) if text in line)


def said(view: SessionView, words: str) -> int:
    return sum(words in text for text in view.printed.texts)


@pytest.fixture
def port() -> int:
    return port_for_debugger(0)


@pytest.fixture
def session(
    child_process: None, task_file: Path, tmp_path: Path, port: int, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Session]:
    """Its worker waits for a debugger before it loads the task."""
    monkeypatch.setattr(supervisor, "_BUSY_SECONDS", HANGS)
    monkeypatch.setattr(supervisor, "_LOAD_WAIT_SECONDS", HANGS)
    monkeypatch.setattr(supervisor, "_SILENCE_TIMEOUT_SECONDS", HANGS)
    session = Session(
        str(task_file),
        TaskOptions(num_envs=2, env_kwargs={"render_backend": "none"}),
        recordings=tmp_path / "recordings",
        worker=WorkerOptions(debug_port=port, debug_wait=True),
    )
    text = task_file.read_text()
    yield session
    session.close()
    task_file.write_text(text)  # a breakpoint() left in it would stop the next test's recording for ever


@pytest.mark.slow
def test_a_debugger_holds_the_worker_as_long_as_it_likes(
    session: Session, task_file: Path, port: int
) -> None:
    view = wait_until(session, lambda v: bool(v.busy and v.busy.awaited), "the waiting")
    assert view.task is None and status_values(view)["word"] == "waiting"
    assert said(view, f"waits for a debugger at 127.0.0.1:{port}") == 1
    listens = [
        found.laddr.ip  # type: ignore[union-attr]
        for found in psutil.net_connections("tcp")
        if found.status == psutil.CONN_LISTEN and found.laddr.port == port  # type: ignore[union-attr]
    ]
    assert listens == ["127.0.0.1"]

    client = DebugClient(port)
    client.begin()
    before = wait_until(session, lambda v: v.task is not None and v.step is not None, "the first load")
    worker = session.worker_pid

    # A breakpoint, held for longer than a worker may hang, with a save that waits behind it.
    line = line_of(task_file, JUDGES)
    assert client.stop_at(task_file, line) == [True]
    session.do(Step())
    thread, *place = client.stopped_at()
    assert place == [str(task_file), line]
    view = wait_until(session, lambda v: bool(v.busy and v.busy.held), "the mark")
    assert (view.busy.file, view.busy.line) == (str(task_file), line) and not view.busy.awaited
    status = status_values(view)
    assert status["word"] == "held" and f"by a debugger at {task_file.name}:{line}" in str(status["activity"])
    good = task_file.read_text()
    task_file.write_text(good.replace("def evaluate", "# a line more\n    def evaluate"))
    held_since = time.monotonic()
    view = wait_until(session, lambda v: bool(v.busy and v.busy.seconds > 6 * HANGS), "a long time")
    session.do(Interrupt())
    assert view.stale and not is_busy_for_long(view) and view.problem is None
    assert session.worker_pid == worker and time.monotonic() - held_since > 4 * HANGS
    client.stop_at(task_file)
    client.ask("continue", threadId=thread)
    view = wait_until(session, lambda v: v.task_serial > before.task_serial and not v.stale, "the save")
    assert session.worker_pid == worker and view.problem is None and view.reload.level == "same"
    assert view.step.elapsed_steps.tolist() == [1, 1], "the step that was held was made"
    wait_until(session, lambda v: v.busy is None, "rest")

    # After the reload the same debugger goes on, and breakpoint() stops for it.
    task_file.write_text(good.replace(REWARDS, f"breakpoint()\n        {REWARDS}"))
    _, *place = client.stopped_at()
    stops = line_of(task_file, "breakpoint()")
    assert place in ([str(task_file), stops], [str(task_file), stops + 1])

    # A debugger that is gone lets go, and what it would have stopped at is passed and told.
    client.close()
    view = wait_until(session, lambda v: said(v, "a breakpoint was skipped") == 1, "the note")
    wait_until(session, lambda v: v.task_serial > before.task_serial + 1 and v.busy is None, "the version")
    assert session.worker_pid == worker

    # Another worker listens at the same place, waits for nobody, and says so.
    session.do(RestartWorker())
    view = wait_until(session, lambda v: said(v, "worker listens for a debugger") == 1, "the port again")
    view = wait_until(session, lambda v: v.task is not None and v.busy is None, "the task again")
    wait_until(session, lambda v: session.worker_pid not in (None, worker), "another worker")
    client = DebugClient(port)
    client.begin()
    serial = session.view().step_serial
    session.do(Step())
    thread, file, _ = client.stopped_at()
    assert file == str(task_file)
    client.ask("continue", threadId=thread)
    wait_until(session, lambda v: v.step_serial > serial, "the step")
    client.close()


@pytest.mark.slow
def test_a_recording_waits_for_a_debugger_and_stops_for_it(task_file: Path, tmp_path: Path) -> None:
    asked = ("--debug", "--episodes", "1", "--num-envs", "1", "--max-steps", "2", "--no-pictures")
    command = python_command(
        "-m", "workbench.cli.main", "record", str(task_file), "--out", str(tmp_path), *asked
    )
    environment = child_environment(PYTHONUNBUFFERED="1")
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment)
    try:
        assert process.stdout is not None
        said = process.stdout.readline()
        assert said.startswith("waiting for a debugger at 127.0.0.1:")
        client = DebugClient(int(said.rsplit(":", 1)[1]))
        line = line_of(task_file, JUDGES)
        client.stop_at(task_file, line)
        client.begin()
        thread, *place = client.stopped_at()
        assert place == [str(task_file), line]
        client.stop_at(task_file)
        client.ask("continue", threadId=thread)
        client.event("terminated")
        client.close()
        assert "Look at them with" in process.communicate(timeout=60)[0]
        assert process.returncode == 0
    finally:
        process.kill()
        process.wait()


def test_a_port_that_is_taken_is_refused_or_another_found(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        taken = other.getsockname()[1]
        with pytest.raises(ValueError, match=f"--debug-port {taken} cannot be listened on"):
            port_for_debugger(taken)
        monkeypatch.setattr("workbench.machine.processes.debugger.DEFAULT_PORT", taken)
        assert port_for_debugger(None) not in (0, taken)


@pytest.mark.parametrize(
    "options",
    [("--debug", "--socket", "here"), ("--debug-wait", "--socket", "here"), ("--debug-port", "70000")],
)
def test_what_everybody_on_the_machine_could_debug_is_refused(
    options: tuple[str, ...], task_file: Path
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["open", str(task_file), *options])
    assert ended.value.code == 2
