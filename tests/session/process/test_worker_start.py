"""Workers as forks of one process that has done the imports, and without it where they would be of something else."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from tests.drive.processes import workers_of
from tests.drive.session import live_session, wait_until
from tests.drive.waiting import until
from tests.session.hazards import write_task
from workbench.session.process import worker_process, worker_start
from workbench.session.process.worker_process import WorkerProcess
from workbench.session.process.worker_start import WorkerForks

pytestmark = pytest.mark.usefixtures("child_process")


@pytest.fixture(scope="module")
def fork_server(child_process: None) -> Iterator[WorkerForks]:
    forks = WorkerForks()
    yield forks
    forks.end()


@pytest.fixture
def forks(fork_server: WorkerForks, monkeypatch: pytest.MonkeyPatch) -> WorkerForks:
    """The fork server of this file's tests."""
    monkeypatch.setattr(worker_process, "worker_forks", fork_server)
    return fork_server


@pytest.fixture
def own_forks(monkeypatch: pytest.MonkeyPatch) -> Iterator[WorkerForks]:
    """A fork server of the test's own."""
    forks = WorkerForks()
    monkeypatch.setattr(worker_process, "worker_forks", forks)
    yield forks
    forks.end()


def started() -> WorkerProcess:
    return WorkerProcess(lambda name, piece: False)


def listens(worker: WorkerProcess) -> bool:
    return until(lambda: worker.beat().doing == "idle", "its first sleep")


def command_of(worker: WorkerProcess) -> str:
    return " ".join(psutil.Process(worker.pid).cmdline())


def has_ended(process: psutil.Process) -> bool:
    try:
        return process.status() == psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return True


def test_workers_are_forks_that_end_apart_from_each_other_and_say_how(forks: WorkerForks) -> None:
    one, other = started(), started()
    assert listens(one) and listens(other)
    assert len({os.getpid(), one.pid, other.pid}) == 3
    assert all("fork_server" in command_of(worker) for worker in (one, other))
    os.kill(one.pid, signal.SIGSEGV)
    with pytest.raises(EOFError):
        until(lambda: one.receive(0.1), "its end")
    assert one.exit_code() == -signal.SIGSEGV and "Segmentation fault" in one.crash_report()
    one.stop(0)
    assert listens(other)
    other.stop(grace=30)
    assert other.exit_code() == 0 and not workers_of(psutil.Process())


def test_two_forks_do_not_draw_the_same_random_numbers(tmp_path: Path) -> None:
    file = write_task(tmp_path)
    printed = "import random\nimport numpy as np\nprint('drawn', random.random(), np.random.rand())\n"
    file.write_text(file.read_text().replace("import torch\n", f"import torch\n{printed}", 1))
    drawn: list[list[str]] = []
    for _ in range(2):
        with live_session(file, tmp_path) as session:
            view = wait_until(session, lambda view: any("drawn" in str(t) for t in view.printed.texts), "it")
            (line,) = {text for text in view.printed.texts if "drawn" in text}
            drawn.append(line.split()[-2:])
    assert all(a != b for a, b in zip(*drawn))


@pytest.mark.slow
def test_after_a_save_of_what_was_imported_a_worker_imports_it_itself(
    own_forks: WorkerForks, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    library = tmp_path / "usercustomize.py"
    library.write_text("number = 1\n")
    (tmp_path / "sitecustomize.py").write_text("import usercustomize\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    before = started()
    assert listens(before) and "fork_server" in command_of(before)
    library.write_text("number = 22\n")
    after = started()
    assert listens(after) and "fork_server" not in command_of(after)
    for worker in (before, after):
        worker.stop()
        assert worker.exit_code() == 0


def test_a_worker_of_another_environment_or_folder_is_no_fork(
    forks: WorkerForks, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = started()
    assert listens(first)
    with monkeypatch.context() as changed:
        changed.setenv("MS_ASSET_DIR", str(tmp_path))
        other = started()
        assert "fork_server" not in command_of(other)
    with monkeypatch.context() as changed:
        changed.chdir(tmp_path)
        elsewhere = started()
        assert "fork_server" not in command_of(elsewhere)
    again = started()
    assert "fork_server" in command_of(again)
    for worker in (first, other, elsewhere, again):
        worker.stop(0)


@pytest.mark.slow
def test_what_cannot_be_imported_is_said_by_each_worker(
    own_forks: WorkerForks, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "gymnasium.py").write_text("raise ImportError('broken by the test')\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    said: list[bytes] = []
    worker = WorkerProcess(lambda name, piece: bool(said.append(piece)))
    with pytest.raises(EOFError):
        until(lambda: worker.receive(0.1), "its end")
    assert worker.exit_code() == 1
    worker.stop(0)
    assert b"ImportError: broken by the test" in b"".join(said)


@pytest.mark.slow
def test_one_that_is_ended_before_it_has_been_forked_never_runs(own_forks: WorkerForks) -> None:
    worker = started()
    began = time.monotonic()
    worker.stop(0)
    assert worker.exit_code() == -signal.SIGTERM
    assert time.monotonic() - began < 2, "it waited for the imports"
    another = started()
    assert listens(another) and len(workers_of(psutil.Process())) == 1
    another.stop(0)


@pytest.mark.slow
def test_when_the_fork_server_is_killed_its_workers_end_and_the_next_has_another(
    own_forks: WorkerForks,
) -> None:
    worker = started()
    assert listens(worker)
    server = psutil.Process(psutil.Process(worker.pid).ppid()).parent()
    assert server is not None
    task = psutil.Process(worker.pid)
    server.kill()
    with pytest.raises(EOFError):
        until(lambda: worker.receive(0.1), "its end")
    assert worker.exit_code() == -signal.SIGKILL
    worker.stop(0)
    until(lambda: has_ended(task), "the end of the task's process")
    following = [started(), started()]
    assert all(listens(one) for one in following)
    for one in following:
        one.stop(0)


def test_with_a_gpu_of_nvidia_no_worker_is_a_fork(
    forks: WorkerForks, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "nvidiactl").touch()
    monkeypatch.setattr(worker_start, "_GPUS", (str(tmp_path / "no"), str(tmp_path / "nvidiactl")))
    worker = started()
    assert "fork_server" not in command_of(worker)
    worker.stop(0)


def test_those_that_are_ended_at_once_leave_the_others_alone(forks: WorkerForks) -> None:
    worker = started()
    assert listens(worker)
    for pause in (0.0, 0.0, 0.005, 0.01, 0.02, 0.04, 0.08):
        ended = started()
        time.sleep(pause)
        ended.stop(0)
    unread = started()
    until(lambda: len(workers_of(psutil.Process())) == 2, "the fork")
    unread._process._told.close()  # type: ignore[attr-defined]
    unread._process._code = -signal.SIGTERM  # type: ignore[attr-defined]
    unread.stop(0)
    assert worker.exit_code() is None
    until(lambda: len(workers_of(psutil.Process())) == 1, "the end of the others")
    worker.stop()
    assert worker.exit_code() == 0


def test_a_wait_for_one_that_runs_ends_in_time(forks: WorkerForks) -> None:
    worker = started()
    assert listens(worker)
    with pytest.raises(subprocess.TimeoutExpired):
        worker._process.wait(timeout=0.05)
    worker.stop(0)
