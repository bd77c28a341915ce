"""More ways to end a worker, or to seem to live: each is told, and the last good version comes back."""

# The fixture hands over a session whose task is loaded: what may be None before is not here.
# pyright: reportOptionalMemberAccess=false, reportOptionalSubscript=false, reportArgumentType=false

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from tests.drive.session import live_session, wait_until
from tests.session.hazards import calm, edit, line_of, provocation, provoke, write_task
from workbench.jobs.task import TaskOptions
from workbench.session.live.session import Session

pytestmark = pytest.mark.usefixtures("child_process")


@pytest.fixture(scope="module")
def risky_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_task(tmp_path_factory.mktemp("author"))


@pytest.fixture(scope="module")
def risky_session(risky_file: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Session]:
    with live_session(risky_file, tmp_path_factory.mktemp("recordings"), num_envs=1) as session:
        yield session


@pytest.fixture
def session(risky_session: Session, risky_file: Path) -> Iterator[Session]:
    """The session at rest at step 1, with the file as it is on disk."""
    session = risky_session
    steps = session.view().step_serial
    session.reset()
    wait_until(session, lambda v: v.step_serial > steps and not v.step.elapsed_steps.any(), "the reset")
    session.step()
    wait_until(session, lambda v: v.step.elapsed_steps[0] == 1 and v.problem is None, "a step")
    yield session
    calm(risky_file)


DEATHS = [
    ("garbage", "sent unreadable data (it says that it is 1886546286 bytes long) and was ended"),
    ("wrong", "sent unreadable data (it was a dict, which is no message) and was ended"),
    ("misfit", "sent unusable data ("),
    ("headless", "its main thread had ended and left another thread running"),
    ("thread", "ended with exit code 1"),
    ("detach", "was killed by SIGKILL"),
]
QUICK = ("garbage",)
"""Each costs a new process; the first has detached a child too."""


@pytest.mark.parametrize(
    ("what", "says"),
    [pytest.param(*way, id=way[0], marks=() if way[0] in QUICK else pytest.mark.slow) for way in DEATHS],
)
def test_an_end_is_told_and_the_last_good_version_comes_back(
    session: Session, risky_file: Path, what: str, says: str
) -> None:
    before, worker = session.view(), session.worker_pid
    provoke(risky_file, "evaluate", what)
    session.step()
    view = wait_until(session, lambda v: v.problem is not None and v.problem.stage == "worker", "the death")
    calm(risky_file)
    assert says in view.problem.message
    view = wait_until(session, lambda v: v.task_serial > before.task_serial, "the version again")
    assert view.task.source_hash == before.task.source_hash and view.step.elapsed_steps[0] in (1, 2)
    assert session.worker_pid != worker and not psutil.pid_exists(worker)
    innocent = [p for p in psutil.process_iter(["cmdline"]) if p.info["cmdline"] == ["innocent", "3600"]]
    assert not innocent, "what the task detached was left behind"


@pytest.mark.slow
def test_a_message_that_stops_in_the_middle_is_a_hang_like_others(session: Session, risky_file: Path) -> None:
    before = session.view()
    provoke(risky_file, "evaluate", "half")
    session.step()
    busy = wait_until(session, lambda v: v.busy is not None and v.busy.file is not None, "busy").busy
    assert busy.doing == "in evaluate"
    calm(risky_file)
    session.versions.restart_worker()
    wait_until(session, lambda v: v.task_serial > before.task_serial, "the version again")


@pytest.mark.parametrize(
    ("place", "what", "says", "code"),
    [
        ("evaluate", "ctrl_c", "KeyboardInterrupt", "raise KeyboardInterrupt"),
        ("import", "ctrl_c", "KeyboardInterrupt", "raise KeyboardInterrupt"),
        ("reward", "interrupt_main", "KeyboardInterrupt", "_signal.raise_signal(_signal.SIGINT)"),
        ("reset", "own_base", "GeneratorExit: of this", 'raise GeneratorExit("of this")'),
    ],
)
def test_what_is_no_ordinary_exception_is_named_with_its_line(
    session: Session, risky_file: Path, place: str, what: str, says: str, code: str
) -> None:
    worker = session.worker_pid
    provoke(risky_file, place, what)
    if place == "import":
        edit(risky_file)
    elif place == "reset":
        session.reset()
    else:
        session.step()
    view = wait_until(session, lambda v: v.problem is not None, "the problem")
    assert says in view.problem.message and view.problem.stage in (place, "build")
    assert view.problem.file == str(risky_file) and view.problem.line == line_of(risky_file, code)
    assert view.problem.code == code
    calm(risky_file)
    if place == "import":
        session.versions.reload()
        wait_until(session, lambda v: v.problem is None, "the mended version")
    assert (session.worker_pid != worker) == (place == "import"), (
        "a version that was refused costs its process"
    )


@pytest.mark.parametrize(
    ("place", "error"),
    [
        ("evaluate", 'KeyboardInterrupt("two")'),
        ("reset", 'KeyboardInterrupt("two")'),
        ("import", 'KeyboardInterrupt("two")'),
        ("build", 'GeneratorExit("two")'),
    ],
)
def test_what_a_saved_version_raises_is_shown_with_the_text_of_that_version(
    session: Session, risky_file: Path, place: str, error: str
) -> None:
    good, worker = risky_file.read_text(), session.worker_pid
    hook = f'hazard("{place}")'
    (line,) = [line for line in good.splitlines() if line.strip() == hook]
    raised = line.replace(hook, f"raise {error}")
    try:
        # In the place of a line that says something else in the version that is kept.
        risky_file.write_text(good.replace(f"{line}\n", f"{raised}\n{line}\n"))
        view = wait_until(session, lambda v: v.problem is not None, "the problem")
        assert view.problem.message == error.replace('("two")', ": two")
        assert view.problem.line == line_of(risky_file, raised.strip())
        assert view.problem.code == raised.strip()
        shown = view.problem.traceback.splitlines()
        assert any(
            f"line {view.problem.line}, in" in above and below.strip() == raised.strip()
            for above, below in zip(shown, shown[1:], strict=False)
        ), view.problem.traceback
    finally:
        risky_file.write_text(good)
    wait_until(session, lambda v: v.problem is None, "the mended version")
    assert session.worker_pid != worker


@pytest.mark.parametrize("what", ["device", "pipe", pytest.param("large", marks=pytest.mark.slow)])
def test_a_task_file_that_is_no_file_any_more_is_told_and_the_mended_one_loaded(
    session: Session, risky_file: Path, what: str
) -> None:
    good, before = risky_file.read_text(), session.view()
    resident = psutil.Process().memory_info().rss
    other = risky_file.with_name("other")
    if what == "device":
        other.symlink_to("/dev/zero")
    elif what == "pipe":
        os.mkfifo(other)
    else:
        with other.open("wb") as file:
            file.truncate(2**40)
    other.replace(risky_file)
    view = wait_until(session, lambda v: v.problem is not None, "the problem")
    expected = (
        "more than the 16.0 MB that such a file may have" if what == "large" else "is not an ordinary file"
    )
    assert expected in view.problem.message and view.task_serial == before.task_serial
    session.step()
    wait_until(session, lambda v: v.step.elapsed_steps[0] == 2, "a step of the last good version")
    assert psutil.Process().memory_info().rss - resident < 200 * 2**20
    other.write_text(good)
    other.replace(risky_file)
    wait_until(session, lambda v: v.problem is None, "the mended file")


@pytest.mark.slow
def test_a_task_that_goes_to_another_folder_is_reloaded_and_recorded_as_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = write_task(tmp_path)
    (tmp_path / "act.py").write_text("def zero(obs):\n    import torch\n    return torch.zeros(1, 8)\n")
    monkeypatch.chdir(tmp_path)
    options = TaskOptions(num_envs=1, env_kwargs={"render_backend": "none"})
    session = Session("risky.py", options, recordings=Path("recordings"))
    try:
        before = wait_until(session, lambda v: v.task is not None, "the task")
        provoke(file, "evaluate", "chdir")
        session.step()
        wait_until(session, lambda v: v.step.elapsed_steps[0] == 1, "a step")
        assert not provocation(file).exists()
        session.change(action_source="policy", policy="act.py:zero")
        session.step()
        view = wait_until(session, lambda v: v.step.elapsed_steps[0] == 2 or v.problem is not None, "a step")
        assert view.problem is None, view.problem
        edit(file)
        wait_until(
            session, lambda v: v.task_serial > before.task_serial and v.problem is None, "the new version"
        )
        session.start_recording()
        wait_until(session, lambda v: v.recording.active, "the recording")
        session.step()
        wait_until(session, lambda v: v.recording.steps == 1, "a recorded step")
        session.stop_recording()
        view = wait_until(session, lambda v: v.recording.episodes_written == 1, "the file")
        assert Path(view.recording.last_file).resolve().parent == tmp_path / "recordings"
    finally:
        session.close()
