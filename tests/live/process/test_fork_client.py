"""Workers are forks of a process with the imports done; started without it where a fork would differ."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from tests.drive.processes import workers_of
from tests.drive.session import live_session, wait_until
from tests.drive.waiting import TIMEOUT_SECONDS, until
from tests.live.hazards import write_task
from workbench.live.process import fork_client, worker_process
from workbench.live.process.fork_client import WorkerForks
from workbench.live.process.worker_process import WorkerProcess

pytestmark = pytest.mark.usefixtures("child_process")


@pytest.fixture(scope="module")
def started_forks(child_process: None) -> Iterator[WorkerForks]:
    forks = WorkerForks()
    yield forks
    forks.end()


@pytest.fixture
def forks(started_forks: WorkerForks, monkeypatch: pytest.MonkeyPatch) -> WorkerForks:
    """The fork server of this file's tests."""
    monkeypatch.setattr(worker_process, "worker_forks", started_forks)
    return started_forks


@pytest.fixture
def own_forks(monkeypatch: pytest.MonkeyPatch) -> Iterator[WorkerForks]:
    """A fork server for one test."""
    forks = WorkerForks()
    monkeypatch.setattr(worker_process, "worker_forks", forks)
    yield forks
    forks.end()


def started() -> WorkerProcess:
    return WorkerProcess(lambda name, piece: False)


def listens(worker: WorkerProcess) -> bool:
    return until(lambda: worker.beat().doing == "idle", "its first sleep")


def is_fork(worker: WorkerProcess) -> bool:
    return "worker.fork_server" in " ".join(psutil.Process(worker.pid).cmdline())


def ends_as_asked(worker: WorkerProcess) -> bool:
    """Whether the worker stops on request, within the time that a busy machine may need."""
    worker.stop(grace=TIMEOUT_SECONDS)
    return worker.exit_code() == 0


def until_gone(worker: WorkerProcess) -> int | None:
    with pytest.raises(EOFError):
        until(lambda: worker.receive(0.1), "its end")
    return until(worker.exit_code, "its exit code")


def has_ended(process: psutil.Process) -> bool:
    try:
        return process.status() == psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return True


@pytest.mark.slow
def test_forked_workers_end_independently_and_report_how(forks: WorkerForks) -> None:
    one, other = started(), started()
    assert listens(one) and listens(other)
    assert len({os.getpid(), one.pid, other.pid}) == 3 and is_fork(one) and is_fork(other)
    os.kill(one.pid, signal.SIGSEGV)
    assert until_gone(one) == -signal.SIGSEGV and "Segmentation fault" in one.crash_report()
    one.stop(0)
    assert listens(other) and ends_as_asked(other)
    until(lambda: not workers_of(psutil.Process()), "the end of both")


@pytest.mark.slow
def test_workers_killed_right_after_the_start_leave_the_others_alone(forks: WorkerForks) -> None:
    worker = started()
    assert listens(worker)
    for pause in (0.0, 0.0, 0.005, 0.01, 0.02, 0.04, 0.08):
        ended = started()
        time.sleep(pause)
        ended.stop(0)
    assert worker.exit_code() is None
    until(lambda: len(workers_of(psutil.Process())) == 1, "the end of the others")
    assert ends_as_asked(worker)


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
    assert all(a != b for a, b in zip(*drawn, strict=True))


@pytest.mark.slow
def test_a_worker_with_other_code_or_settings_is_not_forked(
    forks: WorkerForks, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    workers = [started()]
    assert listens(workers[0]) and is_fork(workers[0])
    (tmp_path / "nvidiactl").touch()
    for change in (
        lambda to: to.setenv("MS_ASSET_DIR", str(tmp_path)),
        lambda to: to.chdir(tmp_path),
        lambda to: to.setattr(
            fork_client, "GPU_DEVICES", (str(tmp_path / "no"), str(tmp_path / "nvidiactl"))
        ),
    ):
        with monkeypatch.context() as changed:
            change(changed)
            workers.append(started())
            assert not is_fork(workers[-1])
    workers.append(started())
    assert is_fork(workers[-1])
    for worker in workers:
        worker.stop(0)


@pytest.mark.slow
def test_after_a_save_of_an_imported_module_a_worker_imports_it_itself(
    own_forks: WorkerForks, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    library = tmp_path / "usercustomize.py"
    library.write_text("number = 1\n")
    (tmp_path / "sitecustomize.py").write_text("import usercustomize\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    before = started()
    assert listens(before) and is_fork(before)
    library.write_text("number = 22\n")
    after = started()
    assert listens(after) and not is_fork(after)
    assert ends_as_asked(before) and ends_as_asked(after)


@pytest.mark.slow
def test_each_worker_reports_a_failed_import(
    own_forks: WorkerForks, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "gymnasium.py").write_text("raise ImportError('broken by the test')\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    printed: list[bytes] = []
    worker = WorkerProcess(lambda name, piece: bool(printed.append(piece)))
    assert until_gone(worker) == 1
    worker.stop(0)
    assert b"ImportError: broken by the test" in b"".join(printed)


@pytest.mark.slow
def test_a_worker_ended_before_its_fork_never_runs(own_forks: WorkerForks) -> None:
    worker = started()
    began = time.monotonic()
    worker.stop(0)
    assert worker.exit_code() == -signal.SIGTERM
    assert time.monotonic() - began < 4, "it waited for the imports"
    another = started()
    assert listens(another) and len(workers_of(psutil.Process())) == 1
    another.stop(0)


@pytest.mark.slow
def test_a_killed_fork_server_ends_its_workers_and_is_replaced(
    own_forks: WorkerForks,
) -> None:
    worker = started()
    assert listens(worker)
    server = psutil.Process(psutil.Process(worker.pid).ppid()).parent()
    assert server is not None
    task = psutil.Process(worker.pid)
    server.kill()
    assert until_gone(worker) == -signal.SIGKILL
    worker.stop(0)
    until(lambda: has_ended(task), "the end of the task's process")
    following = [started(), started()]
    assert all(listens(one) for one in following)
    for one in following:
        one.stop(0)
