"""The files subprocess writes the same files as a thread; when it is killed, no episode is lost or duplicated."""

from __future__ import annotations

import fcntl
import json
import shutil
import subprocess
import sys
import termios
import threading
from array import array
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import psutil
import pytest

from tests.drive.episodes import appended, geometry_of, header_of, journal_of, made
from tests.drive.waiting import until
from tests.episodes.read_rrd import read_rrd
from workbench.episodes.reader.read_episode import read_episode
from workbench.episodes.seal import InstallationSeal, made_here
from workbench.episodes.writing.episode_writer import EpisodeWriter
from workbench.episodes.writing.files_process import FilesProcess
from workbench.episodes.writing.finish_or_recover import make_files
from workbench.episodes.writing.journal import claim
from workbench.episodes.writing.publish import RecordingError
from workbench.record.gather import EpisodeFinisher, GatheredEpisode

pytestmark = pytest.mark.usefixtures("child_process")


@pytest.fixture(scope="module")
def shared() -> Iterator[tuple[FilesProcess, psutil.Process]]:
    """A shared process that tests must not kill."""
    process, child = started()
    yield process, child
    process.close()


@pytest.fixture
def process(shared: tuple[FilesProcess, psutil.Process]) -> FilesProcess:
    return shared[0]


def started() -> tuple[FilesProcess, psutil.Process]:
    before = set(psutil.Process().children())
    process = FilesProcess()
    (child,) = set(psutil.Process().children()) - before
    until(lambda: process.is_ready, "the process has done its imports")
    return process, child


def written(folder: Path, steps: int = 3) -> EpisodeWriter:
    return appended(folder, made(steps), pictures=False)


def unread(process: FilesProcess) -> int:
    """Bytes that were sent to the process and that it has not received."""
    count = array("i", [0])
    fcntl.ioctl(process._end, termios.TIOCOUTQ, count)
    return count[0]


def content(rrd: Path) -> dict[str, dict[str, object]]:
    """The content of an .rrd without rerun's random ids."""
    return {
        entity: {
            name: (plain(column.steps), list(map(plain, column.values))) for name, column in columns.items()
        }
        for entity, columns in read_rrd(rrd).items()
    }


def plain(value: object) -> object:
    return (value.dtype.str, value.tobytes()) if isinstance(value, np.ndarray) else value


def description(path: Path) -> object:
    """The content of a .json without values that depend on those ids."""
    data = json.loads(path.read_text())
    for name in ("files", "made_here"):
        del data["workbench"][name]
    del data["workbench_checksum"]
    return data


def files_in(folder: Path) -> list[str]:
    return sorted(path.suffix for path in folder.iterdir())


@pytest.mark.parametrize("pictures", [False, True])
def test_the_process_writes_the_same_files_as_a_thread(
    tmp_path: Path, process: FilesProcess, pictures: bool
) -> None:
    episode = made(6, 4, env_kwargs={"sizes": (1, 2.5), "name": None}, reset_options={"k": [1]})
    by_process = appended(tmp_path / "process", episode, pictures).finish(process)
    by_thread = appended(tmp_path / "thread", episode, pictures).finish()
    assert by_process.h5.name == by_thread.h5.name and by_process.rrd.parent == tmp_path / "process"
    assert (by_process.solved_at, by_process.means) == (by_thread.solved_at, by_thread.means)
    assert by_process.solved_at == 4
    assert by_process.h5.read_bytes() == by_thread.h5.read_bytes()
    assert content(by_process.rrd) == content(by_thread.rrd)
    assert description(by_process.json) == description(by_thread.json)
    seals = {made_here(read_episode(files.json).info) for files in (by_process, by_thread)}
    assert seals == {InstallationSeal.CONTENT}
    assert files_in(tmp_path / "process") == [".h5", ".json", ".rrd"]


def test_each_episode_has_the_meshes_of_its_own_scene(tmp_path: Path, process: FilesProcess) -> None:
    for scale in (1, 2):
        episode = made(3)
        visuals = tuple(
            replace(one, mesh=replace(one.mesh, vertices=one.mesh.vertices * scale))
            for one in geometry_of(episode).visuals
        )
        episode = replace(episode, geometry=replace(geometry_of(episode), visuals=visuals))
        files = appended(tmp_path / f"{scale}", episode, pictures=False).finish(process)
        read = geometry_of(read_episode(files.json)).visuals
        for one, other in zip(read, visuals, strict=True):
            np.testing.assert_allclose(one.mesh.vertices, other.mesh.vertices)


def test_a_write_error_is_reported_as_on_a_thread(tmp_path: Path, process: FilesProcess) -> None:
    messages = []
    for asked in (process, None):
        folder = tmp_path / "here"
        writer = written(folder)
        shutil.rmtree(folder)
        with pytest.raises(RecordingError) as error:
            writer.finish(asked)
        writer.discard()
        messages.append(str(error.value))
    assert messages[0] == messages[1] and "here" in messages[0]
    assert written(tmp_path).finish(process).json.is_file(), "the process still works"


@pytest.mark.slow
@pytest.mark.parametrize("wait", [0, 0.02])
def test_a_process_killed_at_any_moment_leaves_the_episode_exactly_once(tmp_path: Path, wait: float) -> None:
    process, child = started()
    writer = appended(tmp_path, made(20), pictures=True)
    killer = threading.Timer(wait, child.kill)
    killer.start()
    files = writer.finish(process)
    killer.join()
    assert read_episode(files.rrd).length == 20
    assert files_in(tmp_path) == [".h5", ".json", ".rrd"]
    process.close()


def test_files_finished_before_a_kill_are_used(tmp_path: Path) -> None:
    process, child = started()
    writer = appended(tmp_path, made(3, 2), pictures=False)
    journal_of(writer).finish()
    before = make_files(journal_of(writer).path, header_of(journal_of(writer).path), tmp_path)
    child.kill()
    assert writer.finish(process) == before
    assert files_in(tmp_path) == [".h5", ".json", ".rrd"]
    assert not process.is_ready


def test_a_journal_in_use_is_not_recovered_by_another_process(
    tmp_path: Path, shared: tuple[FilesProcess, psutil.Process]
) -> None:
    """The writer's process may be killed meanwhile, which releases the writer's own lock."""
    process, child = shared
    writer = written(tmp_path)
    path = journal_of(writer).path
    child.suspend()
    # Until it has stopped it may still receive the request.
    until(lambda: child.status() == psutil.STATUS_STOPPED, "it has stopped")
    with ThreadPoolExecutor(1) as pool:
        future = pool.submit(writer.finish, process)
        until(lambda: unread(process) > 0, "it is asked")
        writer.close()
        assert claim(path) is None
        child.resume()
        assert future.result(30).json.is_file()


def test_if_no_process_can_be_started_a_thread_writes_the_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(*_: object, **__: object) -> None:
        raise BlockingIOError(11, "Resource temporarily unavailable")

    monkeypatch.setattr(subprocess, "Popen", refused)
    finisher = EpisodeFinisher(in_process=True)
    future = finisher.finish(GatheredEpisode(written(tmp_path), env=0, seed=0))
    finisher.close()
    assert not isinstance(future.result(), str)


@pytest.mark.slow
def test_the_process_ends_with_the_program_that_started_it(tmp_path: Path) -> None:
    program = (
        "import os, psutil, time\n"
        "from workbench.episodes.writing.files_process import FilesProcess\n"
        "process = FilesProcess()\n"
        "while not process.is_ready: time.sleep(0.01)\n"
        "print(*[child.pid for child in psutil.Process().children()], flush=True)\n"
        "os.kill(os.getpid(), 9)\n"
    )
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60)
    pid = int(ended.stdout)
    until(lambda: has_ended(pid), "it has ended too")


def has_ended(pid: int) -> bool:
    with suppress(psutil.NoSuchProcess):
        return psutil.Process(pid).status() == psutil.STATUS_ZOMBIE
    return True
