"""A hung disk blocks only the work that needs it."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.drive.session import FakeWorkerSession, fake_worker_session
from tests.drive.waiting import until
from workbench.app import session
from workbench.live.commands import Step
from workbench.live.messages import SingleStep, TaskFailed
from workbench.record.commands import StopRecording
from workbench.record.state import RecordingStatus, RecordingWanted
from workbench.task.problem import Problem
from workbench.task.watch import SourceWatcher

pytestmark = pytest.mark.thorough


@pytest.fixture
def disk() -> Iterator[threading.Event]:
    """The disk hangs until this event is set."""
    disk = threading.Event()
    yield disk
    disk.set()


def answers(fake: FakeWorkerSession) -> bool:
    """Whether a press on Step reaches the worker, and its result the page."""
    fake.asked(object)
    fake.session.do(Step())
    fake.step()
    return len(fake.asked(SingleStep)) == 1 and fake.view.timeline.last > 0


def test_files_that_cannot_be_watched_block_neither_a_step_nor_the_exit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, disk: threading.Event
) -> None:
    with fake_worker_session(tmp_path, task=str(tmp_path / "push.py")) as fake:
        fake.play(2)
        hangs = threading.Event()

        def follow(self: SourceWatcher, *_: object) -> None:
            hangs.set()
            disk.wait(60)

        monkeypatch.setattr(SourceWatcher, "follow", follow)
        fake.load("patched", source_files=(str(tmp_path / "push.py"),))
        assert hangs.wait(60)
        assert answers(fake)
        problem = Problem("import", "SyntaxError", str(tmp_path / "module.py"), 1, None, "")
        fake.tell(TaskFailed(problem, kept=True))
        assert fake.view.problem == problem and answers(fake)


def test_a_disk_that_hangs_during_a_load_blocks_no_step(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, disk: threading.Event
) -> None:
    """After a save and after a worker's death, the files are compared with those of the version."""
    file = str(tmp_path / "push.py")
    with fake_worker_session(tmp_path, task=file) as fake:
        fake.play(2)
        hangs = threading.Event()

        def read(path: str) -> str:
            hangs.set()
            disk.wait(60)
            return ""

        monkeypatch.setattr(session, "read_source", read)
        for happens in (lambda: None, fake.die):
            happens()
            worker = threading.Thread(
                target=lambda: fake.load("patched", source={file: "x = 1"}), daemon=True
            )
            worker.start()
            assert hangs.wait(60)
            assert answers(fake)
            worker.join(20)
            assert not worker.is_alive() and answers(fake), "the worker's next event is handled"


def test_a_recording_that_cannot_be_written_blocks_no_step(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, disk: threading.Event
) -> None:
    with fake_worker_session(tmp_path / "kept") as fake:
        fake.play(0)
        fake.session.dispatch(RecordingWanted((0,)))
        hangs = threading.Event()
        write = os.pwrite

        def pwrite(*what: object) -> int:
            hangs.set()
            disk.wait(60)
            return write(*what)  # type: ignore[arg-type]

        monkeypatch.setattr(os, "pwrite", pwrite)
        fake.reset((0,))
        fake.step(3)
        assert hangs.wait(60)
        assert answers(fake) and fake.view.of(RecordingStatus).active
        fake.session.do(StopRecording())
        assert answers(fake)
        disk.set()
        until(
            lambda: fake.view.of(RecordingStatus).episodes_written == 1,
            "the episode",
            seen=lambda: fake.view.of(RecordingStatus),
        )
