"""``--debug``: a real debugger attaches to the worker, pauses it for longer than the hang timeouts, and resumes it."""

# pyright: reportOptionalMemberAccess=false, reportOptionalSubscript=false

from __future__ import annotations

import socket
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from tests.drive.commands import exit_code, line_of
from tests.drive.session import wait_until
from tests.live.debug_client import DebugClient
from workbench.app.session import Session
from workbench.app.status_line import status_values
from workbench.live.commands import Interrupt, RestartWorker, Step
from workbench.live.panels.banners import is_busy_for_a_long_time
from workbench.live.process import supervisor
from workbench.live.process.supervisor import WorkerOptions
from workbench.live.view import SessionView
from workbench.machine.processes.child_environment import child_environment, python_command
from workbench.machine.processes.debugger import port_for_debugger
from workbench.task.description import TaskOptions

HANG_SECONDS = 0.3
"""Patched hang timeouts; as short as the worker's ordinary work allows."""

EVALUATE_LINE, REWARD_LINE = "distance = torch.linalg.norm(", "behind_cube = self.cube.pose.p.clone()"
"""The first lines of two hooks of the task."""


def count_printed(view: SessionView, words: str) -> int:
    return sum(words in text for text in view.printed.texts)


@pytest.fixture
def port() -> int:
    return port_for_debugger(0)


@pytest.fixture
def session(
    child_process: None, task_file: Path, tmp_path: Path, port: int, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Session]:
    """A session whose worker waits for a debugger before it loads the task."""
    monkeypatch.setattr(supervisor, "BUSY_SECONDS", HANG_SECONDS)
    monkeypatch.setattr(supervisor, "LOAD_WAIT_SECONDS", HANG_SECONDS)
    monkeypatch.setattr(supervisor, "SILENCE_TIMEOUT_SECONDS", HANG_SECONDS)
    session = Session(
        str(task_file),
        TaskOptions(num_envs=2, env_kwargs={"render_backend": "none"}),
        recordings=tmp_path / "recordings",
        worker=WorkerOptions(debug_port=port, debug_wait=True),
    )
    text = task_file.read_text()
    yield session
    session.close()
    task_file.write_text(text)  # a remaining breakpoint() would block the next test's recording forever


@pytest.mark.slow
def test_a_debugger_can_pause_the_worker_for_any_time(session: Session, task_file: Path, port: int) -> None:
    view = wait_until(session, lambda v: bool(v.busy and v.busy.awaited), "the waiting")
    assert view.task is None and status_values(view)["word"] == "waiting"
    assert count_printed(view, f"waits for a debugger at 127.0.0.1:{port}") == 1
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

    # Pause at a breakpoint for longer than the hang timeouts, while a save waits.
    line = line_of(task_file, EVALUATE_LINE)
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
    view = wait_until(session, lambda v: bool(v.busy and v.busy.seconds > 6 * HANG_SECONDS), "a long time")
    session.do(Interrupt())
    assert view.stale and not is_busy_for_a_long_time(view) and view.problem is None
    assert session.worker_pid == worker and time.monotonic() - held_since > 4 * HANG_SECONDS
    client.stop_at(task_file)
    client.ask("continue", threadId=thread)
    view = wait_until(session, lambda v: v.task_serial > before.task_serial and not v.stale, "the save")
    assert session.worker_pid == worker and view.problem is None and view.reload.level == "same"
    assert view.step.elapsed_steps.tolist() == [1, 1], "the paused step must be completed"
    wait_until(session, lambda v: v.busy is None, "rest")

    # After the reload the same debugger stays attached, and breakpoint() stops.
    task_file.write_text(good.replace(REWARD_LINE, f"breakpoint()\n        {REWARD_LINE}"))
    _, *place = client.stopped_at()
    stops = line_of(task_file, "breakpoint()")
    assert place in ([str(task_file), stops], [str(task_file), stops + 1])

    # After the debugger disconnects, breakpoints are skipped with a message.
    client.close()
    view = wait_until(session, lambda v: count_printed(v, "a breakpoint was skipped") == 1, "the note")
    wait_until(session, lambda v: v.task_serial > before.task_serial + 1 and v.busy is None, "the version")
    assert session.worker_pid == worker

    # A new worker listens at the same port, does not wait, and prints a message.
    session.do(RestartWorker())
    view = wait_until(
        session, lambda v: count_printed(v, "worker listens for a debugger") == 1, "the port again"
    )
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
    arguments = ("--debug", "--episodes", "1", "--num-envs", "1", "--max-steps", "2", "--no-pictures")
    command = python_command(
        "-m", "workbench.cli.main", "record", str(task_file), "--out", str(tmp_path), *arguments
    )
    environment = child_environment(PYTHONUNBUFFERED="1")
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment)
    try:
        assert process.stdout is not None
        line_printed = process.stdout.readline()
        assert line_printed.startswith("waiting for a debugger at 127.0.0.1:")
        client = DebugClient(int(line_printed.rsplit(":", 1)[1]))
        line = line_of(task_file, EVALUATE_LINE)
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


def test_a_port_in_use_is_refused_if_given_and_replaced_if_not(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        taken = other.getsockname()[1]
        with pytest.raises(ValueError, match=f"cannot listen on --debug-port {taken}"):
            port_for_debugger(taken)
        monkeypatch.setattr("workbench.machine.processes.debugger.DEFAULT_PORT", taken)
        assert port_for_debugger(None) not in (0, taken)


@pytest.mark.parametrize(
    "options",
    [("--debug", "--socket", "here"), ("--debug-wait", "--socket", "here"), ("--debug-port", "70000")],
)
def test_debug_options_that_open_a_port_to_other_users_are_refused(
    options: tuple[str, ...], task_file: Path
) -> None:
    assert exit_code("open", task_file, *options) == 2
