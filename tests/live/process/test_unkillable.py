"""The session survives and reports whatever the author's code does to its process."""

# The fixture hands over a session whose task is loaded: what may be None before is not here.
# pyright: reportOptionalMemberAccess=false, reportOptionalSubscript=false, reportArgumentType=false
# pyright: reportAttributeAccessIssue=false, reportCallIssue=false

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import psutil
import pytest

from tests.drive.session import live_session, runs, save, step, wait_until
from tests.episodes.verify_rrd import verify_rrd
from tests.live.hazards import calm, edit, line_of, provocation, provoke, write_task
from workbench.app.session import Session
from workbench.episodes.rerun.read import read_properties
from workbench.live.commands import Interrupt, PauseRun, PlayRun, ReloadFile, ResetAll, RestartWorker, Step
from workbench.live.events import EnvsReset, MomentShown
from workbench.live.process import supervisor
from workbench.live.process.heartbeat import INTERRUPT_SIGNAL
from workbench.live.process.supervisor import WorkerOptions
from workbench.live.process.worker_process import signal_main_thread
from workbench.live.timeline_commands import ContinueFromHere
from workbench.live.view import SessionView
from workbench.record.commands import StopRecording
from workbench.record.state import RecordingStatus, RecordingWanted
from workbench.task.description import TaskOptions

pytestmark = pytest.mark.usefixtures("child_process")

LIMIT = 2 * 2**30


@pytest.fixture(scope="module", autouse=True)
def short_timeouts() -> Iterator[None]:
    """Timeouts of several seconds, for slow machines, are about one second here."""
    with pytest.MonkeyPatch.context() as patch:
        for name, seconds in (
            ("BUSY_SECONDS", 1.0),
            ("STACK_PERIOD_SECONDS", 0.3),
            ("INTERRUPT_TIMEOUT_SECONDS", 0.5),
        ):
            patch.setattr(supervisor, name, seconds)
        for name, seconds in (("LOAD_WAIT_SECONDS", 0.7), ("SILENCE_TIMEOUT_SECONDS", 2.0)):
            patch.setattr(supervisor, name, seconds)
        yield


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_task(tmp_path_factory.mktemp("author"))


@pytest.fixture(scope="module")
def risky_session(
    short_timeouts: None, file: Path, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Session]:
    limited = WorkerOptions(memory_limit=LIMIT)
    with live_session(file, tmp_path_factory.mktemp("recordings"), worker=limited) as session:
        yield session


@pytest.fixture
def session(risky_session: Session, file: Path) -> Iterator[Session]:
    """The session, paused at step 3 of an episode, with the file on disk loaded."""
    session = risky_session
    session.do(PauseRun())
    steps = session.view().step_serial
    session.dispatch(EnvsReset())
    wait_until(session, lambda v: v.step_serial > steps and not v.step.elapsed_steps.any(), "the reset")
    step(session, 3)
    wait_until(session, lambda v: v.problem is None and v.busy is None, "calm")
    yield session
    calm(file)


def back(session: Session, before: SessionView, steps: tuple[int, int] = (3, 3)) -> SessionView:
    """The first view after the version was restored at the last shown moment."""
    view = wait_until(session, lambda v: v.task_serial > before.task_serial, "the version again")
    assert view.task.source_hash == before.task.source_hash and not view.playing
    np.testing.assert_allclose(view.step.poses, before.step.poses, atol=1e-5)
    assert view.step.elapsed_steps.tolist() == before.step.elapsed_steps.tolist() == [*steps]
    return view


# --- hangs ---------------------------------------------------------------------------------------------


def test_an_infinite_loop_in_a_step_is_reported_and_can_be_interrupted_with_its_traceback(
    session: Session, file: Path
) -> None:
    before, worker = session.view(), session.worker_pid
    provoke(file, "reward", "loop")
    session.do(Step())
    busy = wait_until(session, lambda v: v.busy is not None, "busy").busy
    assert "reward" in busy.doing and busy.seconds >= supervisor.BUSY_SECONDS and not busy.ignores_interrupt
    assert busy.file == str(file) and busy.code in ("while True:", "pass")
    session.do(Step())
    session.do(Step())
    session.do(PlayRun())
    session.do(Interrupt())
    view = wait_until(session, lambda v: v.problem is not None and v.busy is None, "the interrupt")
    assert view.problem.stage == "reward" and view.problem.interrupted
    assert view.problem.file == str(file) and 'hazard("reward")' in view.problem.traceback
    calm(file)
    # The interrupted step leaves no trace: the next step is the same as without it.
    session.do(Step())
    view = wait_until(session, lambda v: v.step.elapsed_steps[0] == 4, "the fourth step")
    assert view.problem is None and session.worker_pid == worker and view.task_serial == before.task_serial


def test_interrupting_a_loop_in_a_replay_leaves_the_batch_where_it_was(session: Session, file: Path) -> None:
    before, worker = step(session, 3), session.worker_pid
    session.dispatch(MomentShown(before.timeline.last - 2))
    provoke(file, "evaluate", "loop")
    session.do(ContinueFromHere(scope="all"))
    wait_until(session, lambda v: v.busy is not None, "busy")
    session.do(Interrupt())
    view = wait_until(session, lambda v: v.problem is not None and v.busy is None, "the interrupt")
    assert view.problem.interrupted and view.problem.file == str(file) and view.problem_at_run
    assert view.timeline.last == before.timeline.last, "no moment was added"
    calm(file)
    session.do(Step())
    view = wait_until(session, lambda v: v.timeline.last > before.timeline.last, "the next step")
    assert (
        view.step.elapsed_steps.tolist() == [7, 7] and view.problem is None and session.worker_pid == worker
    )
    # The same request can be repeated and reaches the moment.
    session.dispatch(MomentShown(before.timeline.last - 2))
    shown, last = session.view().step.poses, view.timeline.last
    session.do(ContinueFromHere(scope="all"))
    view = wait_until(session, lambda v: v.timeline.last > last, "the going back")
    assert view.step.elapsed_steps.tolist() == [4, 4]
    np.testing.assert_allclose(view.step.poses, shown, atol=1e-5)


@pytest.mark.parametrize(
    "place", ["import", *(pytest.param(place, marks=pytest.mark.slow) for place in ("reset", "build"))]
)
def test_a_loop_in_a_load_can_be_interrupted_and_the_last_good_version_stays(
    session: Session, file: Path, place: str
) -> None:
    before = session.view()
    provoke(file, place, "loop")
    edit(file)
    wait_until(session, lambda v: v.busy is not None and v.busy.file == str(file), "busy")
    session.do(Interrupt())
    view = wait_until(session, lambda v: v.problem is not None, "the interrupt")
    assert view.problem.stage == place and view.problem.file == str(file)
    assert view.stale and view.task_serial == before.task_serial
    calm(file)
    session.do(Step())
    wait_until(session, lambda v: v.step.elapsed_steps[0] == 4, "a step of the last good version")
    session.do(ReloadFile())
    wait_until(session, lambda v: v.problem is None and not v.stale, "the new version")


@pytest.mark.parametrize("during", ["load", pytest.param("step", marks=pytest.mark.slow)])
def test_a_save_behind_a_hang_is_loaded_in_a_new_worker(session: Session, file: Path, during: str) -> None:
    before, worker = session.view(), session.worker_pid
    provoke(file, "evaluate", "loop")
    edit(file) if during == "load" else session.do(Step())
    wait_until(session, lambda v: v.busy is not None, "busy")
    calm(file)
    edit(file)
    view = wait_until(session, lambda v: v.task_serial > before.task_serial, "the new version")
    assert session.worker_pid != worker and not view.stale
    assert view.problem is None and view.reload is not None and view.reload.level == "restarted"


@pytest.mark.parametrize(
    "what", ["native", *(pytest.param(one, marks=pytest.mark.slow) for one in ("catch", "half"))]
)
def test_uninterruptible_work_is_reported_and_a_restart_restores_the_moment(
    session: Session, file: Path, what: str
) -> None:
    before = session.view()
    provoke(file, "evaluate", what)
    session.do(Step())
    wait_until(session, lambda v: v.busy is not None, "busy")
    if what != "half":  # "half" hangs in the middle of a message
        session.do(Interrupt())
        busy = wait_until(
            session, lambda v: v.busy and v.busy.ignores_interrupt, "the ignored interrupt"
        ).busy
        assert busy.file == str(file) and 'hazard("evaluate")' in busy.traceback
    calm(file)
    session.do(RestartWorker())
    assert back(session, before).problem is None, "the file no longer hangs"


@pytest.mark.slow
def test_slow_work_is_reported_and_not_stopped(session: Session, file: Path) -> None:
    before, worker = session.view(), session.worker_pid
    provoke(file, "build", "slow")
    edit(file)
    # Longer than a load waits for uninterruptible work.
    long = supervisor.LOAD_WAIT_SECONDS + supervisor.SILENCE_TIMEOUT_SECONDS + 0.5
    busy = wait_until(session, lambda v: v.busy is not None and v.busy.seconds > long, "busy").busy
    assert "build" in busy.doing and busy.code == "_time.sleep(0.1)"
    calm(file)
    view = wait_until(
        session, lambda v: v.task_serial > before.task_serial and v.busy is None, "the slow one"
    )
    assert view.problem is None and session.worker_pid == worker


def another_version(session: Session, file: Path) -> SessionView:
    """A new version, which has not crashed yet: two crashes in quick succession restore the version before it."""
    edit(file)
    return runs(session, file.read_text())


# --- ends ------------------------------------------------------------------------------------------------

DEATHS = [
    ("segfault", "SIGSEGV", "_ctypes.string_at(0)"),
    ("exit", "os._exit(3)", "_os._exit(3)"),
    ("abort", "SIGABRT", "_os.abort()"),
    ("children", "SIGKILL", None),
    ("detach", "SIGKILL", None),
    ("memory", "--memory-limit", 'eaten.append(b"x" * 2**24)'),
    ("garbage", "unreadable data", ...),
    ("wrong", "unreadable data", ...),
    ("misfit", "unusable data", ...),
    ("headless", "main thread", ...),
    ("thread", "exit code 1", ...),
]
QUICK = ("segfault",)
"""Deaths in the quick run; the others are similar, and each needs a new process."""


@pytest.mark.parametrize(
    ("what", "says", "code"),
    [pytest.param(*way, id=way[0], marks=() if way[0] in QUICK else pytest.mark.slow) for way in DEATHS],
)
def test_a_death_is_reported_with_its_line_and_the_moment_is_restored(
    session: Session, file: Path, what: str, says: str, code: object
) -> None:
    before, worker = another_version(session, file), session.worker_pid
    provoke(file, "evaluate", what)
    session.do(Step())
    wait_until(session, lambda v: v.problem is not None and v.problem.stage == "worker", "the death")
    calm(file)
    if what == "thread":  # it ends some time after the step
        view = wait_until(session, lambda v: v.task_serial > before.task_serial, "the version again")
        assert view.step.elapsed_steps[0] in (3, 4)
    else:
        view = back(session, before)
    assert says in view.problem.message and view.problem.stage == "worker" and not view.stale
    if code is not ...:
        assert view.problem.code == code
        assert code is None or view.problem.line == line_of(file, code)
    assert session.worker_pid != worker and not psutil.pid_exists(worker)
    innocent = [p for p in psutil.process_iter(["cmdline"]) if p.info["cmdline"] == ["innocent", "3600"]]
    assert not innocent, "a process that the task detached is left alive"


@pytest.mark.slow
def test_a_version_that_kills_its_process_on_import_costs_one_worker(session: Session, file: Path) -> None:
    before, good = session.view(), file.read_text()
    file.write_text(good + "\n\n_ctypes.string_at(0)\n")
    view = wait_until(session, lambda v: v.task_serial > before.task_serial, "the last good version")
    assert view.stale and "SIGSEGV" in view.problem.message
    assert view.problem.line == len(good.splitlines()) + 3
    session.do(Step())
    view = wait_until(session, lambda v: v.step.elapsed_steps[0] == 4, "a step of the last good version")
    assert view.problem is not None, "the file is still broken"
    save(session, file, good)


def test_a_recording_loses_only_the_step_in_progress(session: Session, file: Path) -> None:
    written = another_version(session, file).of(RecordingStatus).episodes_written
    session.dispatch(RecordingWanted((1,)))
    for count in (1, 2, 3, 4, 5):
        session.do(Step())
        wait_until(session, lambda v, n=count: v.of(RecordingStatus).steps == n, f"recorded step {count}")
    before, worker = session.view(), session.worker_pid
    provoke(file, "reward", "kill")
    session.do(Step())
    wait_until(session, lambda v: v.problem is not None and v.problem.stage == "worker", "the death")
    calm(file)  # at once: the reward of the restored moment would kill the next worker too
    view = wait_until(session, lambda v: v.of(RecordingStatus).episodes_written > written, "the file")
    assert not view.of(RecordingStatus).active and view.of(RecordingStatus).problem is None
    assert verify_rrd(view.of(RecordingStatus).last_file) is None
    assert "5" in str(read_properties(Path(view.of(RecordingStatus).last_file)))
    # A recording starts a new episode.
    view = back(session, before, steps=(8, 5))
    assert "SIGKILL" in view.problem.message and view.problem.code is None
    assert not view.stale and session.worker_pid != worker and not psutil.pid_exists(worker)


@pytest.mark.slow
def test_a_file_that_never_loaded_costs_one_worker_until_the_next_save(tmp_path: Path) -> None:
    file = write_task(tmp_path)
    provoke(file, "import", "abort")
    options = TaskOptions(num_envs=1, env_kwargs={"render_backend": "none"})
    session = Session(str(file), options, recordings=tmp_path / "recordings")
    view = wait_until(session, lambda v: v.state == "error" and session.worker_pid is not None, "the death")
    assert "SIGABRT" in view.problem.message and view.problem.code == "_os.abort()" and view.task is None
    waiting = session.worker_pid
    calm(file)
    edit(file)
    wait_until(session, lambda v: v.task is not None and v.problem is None, "the fixed file")
    assert session.worker_pid == waiting
    session.close()
    assert not psutil.pid_exists(waiting)


# --- ordinary errors --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("place", "what", "says", "code"),
    [
        ("reward", "read", "EOFError", 'input("your name? ")'),
        ("reward", "leave", "SystemExit", '_sys.exit("enough")'),
        ("evaluate", "ctrl_c", "KeyboardInterrupt", "raise KeyboardInterrupt"),
        ("reward", "interrupt_main", "KeyboardInterrupt", "_signal.raise_signal(_signal.SIGINT)"),
        ("reset", "own_base", "GeneratorExit", 'raise GeneratorExit("of this")'),
    ],
)
def test_input_exit_and_odd_exceptions_are_reported_with_their_line(
    session: Session, file: Path, place: str, what: str, says: str, code: str
) -> None:
    worker = session.worker_pid
    provoke(file, place, what)
    session.do(ResetAll() if place == "reset" else Step())
    view = wait_until(session, lambda v: v.problem is not None, "the problem")
    assert says in view.problem.message and view.problem.stage == place
    assert (view.problem.file, view.problem.line) == (str(file), line_of(file, code))
    assert view.problem.code == code and session.worker_pid == worker


@pytest.mark.parametrize(
    ("place", "error"),
    [
        ("evaluate", 'KeyboardInterrupt("two")'),
        pytest.param("import", 'GeneratorExit("two")', marks=pytest.mark.slow),
    ],
)
def test_an_error_of_a_saved_version_is_shown_with_that_versions_code(
    session: Session, file: Path, place: str, error: str
) -> None:
    good, worker = file.read_text(), session.worker_pid
    hook = f'hazard("{place}")'
    (line,) = [line for line in good.splitlines() if line.strip() == hook]
    raised = line.replace(hook, f"raise {error}")
    # At a line that is different in the version that keeps running.
    file.write_text(good.replace(f"{line}\n", f"{raised}\n{line}\n"))
    view = wait_until(session, lambda v: v.problem is not None, "the problem")
    number, code = line_of(file, raised.strip()), raised.strip()
    save(session, file, good)
    assert (view.problem.line, view.problem.code) == (number, code)
    shown = [text.strip() for text in view.problem.traceback.splitlines()]
    assert any(
        f"line {number}, in" in above and below == code
        for above, below in zip(shown, shown[1:], strict=False)
    )
    assert session.worker_pid != worker, "a refused version costs its process"


@pytest.mark.parametrize("what", ["device", "loop", "missing", pytest.param("large", marks=pytest.mark.slow)])
def test_a_task_path_that_is_no_longer_a_file_is_reported_and_loaded_once_fixed(
    session: Session, file: Path, what: str
) -> None:
    good, before, worker = file.read_text(), session.view(), session.worker_pid
    resident = psutil.Process().memory_info().rss
    other = file.with_name("other")
    if what == "large":
        with other.open("wb") as written:
            written.truncate(2**40)
    elif what != "missing":
        other.symlink_to("/dev/zero" if what == "device" else file)
    file.unlink() if what == "missing" else other.replace(file)
    try:
        view = wait_until(session, lambda v: v.problem is not None, "the problem")
        named = "/dev/zero" if what == "device" else str(file)
        assert named in view.problem.message and view.task_serial == before.task_serial
        session.do(Step())
        wait_until(session, lambda v: v.step.elapsed_steps[0] == 4, "a step of the last good version")
        assert psutil.Process().memory_info().rss - resident < 200 * 2**20
        assert session.worker_pid == worker
    finally:
        other.write_text(good)
        other.replace(file)
        runs(session, good)


def test_a_flood_of_prints_is_counted_and_its_last_lines_kept(session: Session, file: Path) -> None:
    session.clear_printed()
    provoke(file, "evaluate", "flood")
    session.do(Step())
    wait_until(session, lambda v: v.step.elapsed_steps[0] == 4, "the step behind the flood")
    # A slow reader keeps more lines for a while; newer ones push them out, so they are not counted.
    view = wait_until(session, lambda v: v.printed.dropped > 150_000, "most of the flood")
    assert len(view.printed.lines) <= 1000 and view.problem is None
    assert view.printed.lines[-1].stream == "stdout" and "no play" in view.printed.texts[-1]


@pytest.mark.slow
def test_a_task_that_changes_the_working_directory_is_still_reloaded_and_recorded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = write_task(tmp_path)
    (tmp_path / "act.py").write_text("def zero(obs):\n    import torch\n    return torch.zeros(1, 8)\n")
    monkeypatch.chdir(tmp_path)
    with live_session("risky.py", Path("recordings"), num_envs=1) as session:
        before = session.view()
        provoke(file, "evaluate", "chdir")
        step(session)
        assert not provocation(file).exists()
        session.change(action_source="policy", policy="act.py:zero")
        view = step(session)
        assert view.problem is None, view.problem
        edit(file)
        wait_until(
            session, lambda v: v.task_serial > before.task_serial and v.problem is None, "the new version"
        )
        session.dispatch(RecordingWanted())
        wait_until(session, lambda v: v.of(RecordingStatus).active, "the recording")
        session.do(Step())
        wait_until(session, lambda v: v.of(RecordingStatus).steps == 1, "a recorded step")
        session.do(StopRecording())
        view = wait_until(session, lambda v: v.of(RecordingStatus).episodes_written == 1, "the file")
        assert Path(view.of(RecordingStatus).last_file).resolve().parent == tmp_path / "recordings"


def test_an_interrupt_goes_to_the_thread_that_handles_signals_in_python() -> None:
    """The kernel may deliver a process signal to one of torch's threads, which would not interrupt the loop."""
    child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    child.send_signal(signal.SIGSTOP)
    os.waitpid(child.pid, os.WUNTRACED)  # it stops some time later; until then signals are delivered
    try:
        signal_main_thread(child.pid, INTERRUPT_SIGNAL)
        status = Path(f"/proc/{child.pid}/status").read_text()
        pending = {
            line.split(":")[0]: int(line.split()[1], 16) for line in status.splitlines() if "Pnd" in line
        }
        bit = 1 << (INTERRUPT_SIGNAL - 1)
        assert pending["SigPnd"] & bit and not pending["ShdPnd"] & bit
    finally:
        child.kill()
        child.wait()
    signal_main_thread(child.pid, INTERRUPT_SIGNAL)  # the process is gone: no error
