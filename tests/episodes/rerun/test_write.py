"""An .rrd is written completely or fails with an error, whatever the disk, other threads or the user's rerun do."""

from __future__ import annotations

import dataclasses
import errno
import os
import resource
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import psutil
import pytest
import rerun as rr
from rerun.chunk import Chunk, RrdReader

from tests.drive.episodes import Made, header_of, journal_of
from tests.drive.rows import append
from tests.drive.waiting import until
from tests.episodes.read_rrd import read_rrd
from tests.episodes.verify_rrd import verify_rrd
from workbench.episodes.episode import Episode
from workbench.episodes.reader.read_episode import read_episode
from workbench.episodes.rerun import entities as layout
from workbench.episodes.rerun import write as rrd
from workbench.episodes.rerun.viewer import quiet_environment, rerun_command
from workbench.episodes.writing.from_journal import episode_in
from workbench.episodes.writing.journal import JournalReader

Maker = Callable[..., Made]


def test_a_disk_that_is_full_at_any_byte_raises_a_disk_error(
    child_process: None, make_episode: Maker, tmp_path: Path
) -> None:
    """This holds too where the last byte that fits belongs to the blueprint or the index."""
    episode = make_episode(30, action=np.random.default_rng(0).random((30, 1)).astype(np.float32))
    writer = episode.writer(tmp_path)
    for row in episode.rows():
        append(writer, row)
    journal = journal_of(writer)
    journal.finish()
    reader = JournalReader(journal.path)
    recorded = episode_in(reader, header_of(journal.path))
    assert recorded is not None
    path = tmp_path / "some.rrd"

    def size_with_room(room: int) -> int:
        soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (room, hard))
        try:
            rrd.write_rrd(recorded, path)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        return path.stat().st_size

    whole = [size_with_room(1 << 30) for _ in range(3)][-1]
    before = len(os.listdir("/proc/self/fd"))
    fitted = 0
    for room in [*range(0, whole - 128, whole // 80), *range(whole - 128, whole, 8)]:
        try:
            size = size_with_room(room)
        except OSError as error:
            assert error.errno == errno.EFBIG, room
        else:
            # Compressed data contains the time of writing, so two files differ by some bytes: this file just fitted.
            assert room > whole - 128 and size <= room and verify_rrd(path) is None, (room, size, whole)
            fitted += 1
    assert fitted < 8, "the full disk was rarely hit"
    assert len(os.listdir("/proc/self/fd")) == before
    assert size_with_room(whole + 4096) > 0
    assert verify_rrd(path) is None
    reader.close()
    writer.discard()


def test_a_recording_is_complete_even_if_the_user_disabled_rerun(
    child_process: None, make_episode: Maker, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RERUN", "off")
    episode = make_episode()
    # Blueprints are stored by the task's name.
    episode.info = dataclasses.replace(episode.info, task="NobodyElses-v1")
    files = episode.write(tmp_path)
    assert len(RrdReader(files.rrd).blueprints()) == 1
    assert os.environ["RERUN"] == "off"


def test_the_blueprint_comes_first_in_the_file(
    child_process: None, make_episode: Maker, tmp_path: Path
) -> None:
    path = make_episode(300).write(tmp_path).rrd
    command = [*rerun_command(), "rrd", "print", os.fspath(path)]
    printed = subprocess.run(
        command, env=quiet_environment(), capture_output=True, text=True, check=True, timeout=60
    ).stdout
    blueprint, recording = printed.split("BlueprintActivationCommand")
    assert "Chunk(" in blueprint and "/world" not in blueprint
    assert "make_active: true, make_default: true" in recording and "/world" in recording


def test_episodes_of_one_process_are_separate_recordings_with_equal_content(
    child_process: None, make_episode: Maker, tmp_path: Path
) -> None:
    episode = make_episode(5)
    paths = []
    for seed in range(4):
        episode.info = dataclasses.replace(episode.info, seed=seed, id=f"{seed}")
        paths.append(episode.write(tmp_path).rrd)
    readers = [RrdReader(path) for path in paths]
    assert len({store.recording_id for reader in readers for store in reader.recordings()}) == 4
    assert [len(reader.blueprints()) for reader in readers] == [1] * 4
    first, *others = (read_rrd(path) for path in paths)
    for other in others:
        assert other.keys() == first.keys()
        for entity, columns in first.items():
            assert other[entity].keys() == columns.keys()
            if entity.startswith(("/__properties", "/logs")):  # they contain the seed
                continue
            for name, column in columns.items():
                again = other[entity][name]
                np.testing.assert_equal((again.steps, again.values), (column.steps, column.values))
    for seed, path in enumerate(paths):
        assert read_episode(path).info.seed == seed
        assert verify_rrd(path) is None


def test_concurrent_threads_each_write_complete_files_and_leave_no_threads(
    child_process: None, make_episode: Maker, tmp_path: Path
) -> None:
    def some(steps: int) -> list[Path]:
        return [make_episode(steps).write(tmp_path).rrd for _ in range(5)]

    def own_threads() -> int:
        names = (Path(task, "comm").read_text() for task in Path("/proc/self/task").iterdir())
        return sum(name.startswith(("ChunkBatcher", "RecordingStream", "rerun-copy")) for name in names)

    some(1)
    process = psutil.Process()
    files_open = process.num_fds()
    with ThreadPoolExecutor(4) as pool:
        paths = list(pool.map(some, range(1, 5)))
    until(lambda: process.num_fds() <= files_open, "all files are closed", 20)
    for steps, of_thread in enumerate(paths, 1):
        for path in of_thread:
            reader = RrdReader(path)
            assert len(reader.blueprints()) == 1 and len(reader.store()) == len(reader.stream().to_chunks())
            assert read_episode(path).length == steps
    assert len(list(tmp_path.iterdir())) == 3 * 25
    until(lambda: own_threads() == 0, "the threads of rerun's streams have ended")


def test_a_process_forked_during_writing_does_not_hold_the_file_open(
    child_process: None, make_episode: Maker, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """PyTorch's data loader forks such workers in the process that records."""
    forked = []

    def chunks(episode: Episode) -> Iterator[Chunk]:
        if (pid := os.fork()) == 0:
            time.sleep(600)
            os._exit(0)
        forked.append(pid)
        yield from layout.chunks(episode)

    monkeypatch.setattr(rrd, "chunks", chunks)
    episode = make_episode(5)
    writing = threading.Thread(target=lambda: episode.write(tmp_path), daemon=True)
    writing.start()
    writing.join(timeout=30)
    for pid in forked:
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
    assert forked and not writing.is_alive()
    (path,) = tmp_path.glob("*.rrd")
    assert verify_rrd(path) is None


def test_the_users_own_rerun_logs_do_not_mix_with_the_recording(
    child_process: None, make_episode: Maker, tmp_path: Path
) -> None:
    """A recorded env may itself log with rerun: to a stream, to a thread-local one, and to the global recording."""

    def log_and_record(name: str, log: Callable[[str, rr.TextLog], None]) -> None:
        for step in range(5):
            log(f"before/{step}", rr.TextLog(name))
            writing = threading.Thread(target=lambda: make_episode().write(tmp_path / "ours"))
            writing.start()
            writing.join()
            log(f"after/{step}", rr.TextLog(name))

    own, of_thread = (rr.RecordingStream("theirs", recording_id=name) for name in ("own", "thread"))
    own.save(tmp_path / "own.rrd")
    of_thread.save(tmp_path / "thread.rrd")
    log_and_record("own", own.log)
    with of_thread:
        log_and_record("thread", rr.log)
    rr.init("theirs", recording_id="global")
    try:
        rr.save(tmp_path / "global.rrd")
        log_and_record("global", rr.log)
        rr.disconnect()
    finally:
        rr.set_global_data_recording(None)  # later tests run in the same process
    own.disconnect()
    wanted = {f"/{when}/{step}" for when in ("before", "after") for step in range(5)}
    for name in ("own", "thread", "global"):
        reader = RrdReader(tmp_path / f"{name}.rrd")
        assert [store.recording_id for store in reader.recordings()] == [name]
        held = {chunk.entity_path for chunk in reader.stream()}
        assert {entity for entity in held if not entity.startswith("/__properties")} == wanted
    assert all(verify_rrd(path) is None for path in (tmp_path / "ours").glob("*.rrd"))
