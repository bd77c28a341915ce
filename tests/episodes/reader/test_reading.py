"""Foreign recordings are read in a sandboxed process; if it ends, an error message says why."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import threading
import time
from pathlib import Path
from typing import Any

import psutil
import pytest
from rerun.chunk import RrdReader

from tests.drive.episodes import made, write
from tests.drive.equal import assert_equal
from tests.drive.waiting import until
from tests.episodes.library_files import describe
from workbench.episodes.episode import CameraTrack
from workbench.episodes.reader import reading
from workbench.episodes.reader.read_episode import read_episode
from workbench.episodes.reader.scan import scan_folder
from workbench.episodes.row import Facts, Source, UnreadableRecording
from workbench.machine.processes.child_environment import child_environment, python_command
from workbench.machine.processes.confinement import landlock_version

pytestmark = pytest.mark.usefixtures("child_process")


def rows(folder: Path) -> dict[str, Facts]:
    read = reading.read_rows(folder, scan_folder(folder).found.values())
    return {found.key: entries[0][0] for found, entries in read if entries}


def slow_json(path: Path) -> None:
    """Write a .json that takes the reader about a second."""
    path.write_text("[" + "[0,1,2,3,4,5,6,7,8,9]," * 1_500_000 + "0]")


def newest_reader() -> psutil.Process:
    """The reader that was started last; the fork server is the parent of all."""
    servers = [one for one in psutil.Process().children() if "episodes.reader" in " ".join(one.cmdline())]
    return max((reader for one in servers for reader in one.children()), key=psutil.Process.create_time)


def test_a_recording_that_times_out_is_skipped_and_the_others_are_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in "acd":
        describe(tmp_path, name)
    rows(tmp_path)
    slow_json(tmp_path / "b.json")
    monkeypatch.setattr(reading, "ROW_SECONDS", 0.2)
    first = newest_reader()
    found = rows(tmp_path)
    assert sorted(key for key, facts in found.items() if facts.problem is None) == ["a", "c", "d"]
    assert found["b"].problem is not None and "b (.json) takes longer to read than 0 s" in found["b"].problem
    assert not first.is_running()
    (tmp_path / "b.json").unlink()
    assert sorted(rows(tmp_path)) == ["a", "c", "d"]


@pytest.mark.slow
def test_a_cancelled_reading_stops(tmp_path: Path) -> None:
    whole = describe(tmp_path, "a")
    slow_json(tmp_path / "b.json")
    began = time.monotonic()
    with pytest.raises(UnreadableRecording, match="b"):
        reading.read_recording(Source(tmp_path / "b.json"), stopped=lambda: time.monotonic() - began > 0.3)
    assert time.monotonic() - began < reading.OPEN_SECONDS / 2
    assert rows(tmp_path)["a"].problem is None and whole.exists()


def test_a_crash_of_the_reader_is_one_bad_row_and_another_reader_continues(tmp_path: Path) -> None:
    for name in "acd":
        describe(tmp_path, name)
    rows(tmp_path)
    slow_json(tmp_path / "b.json")
    ended = threading.Event()

    def crash() -> None:
        seen: list[psutil.Process] = []
        # The first crash is ignored: the recording may not be its cause.
        while len(seen) < 2 and not ended.wait(0.05):
            victim = newest_reader()
            if victim not in seen and victim.cpu_times().user > 0.1:
                victim.send_signal(signal.SIGSEGV)
                seen.append(victim)

    thread = threading.Thread(target=crash)
    thread.start()
    found = rows(tmp_path)
    ended.set()
    thread.join()
    assert sorted(key for key, facts in found.items() if facts.problem is None) == ["a", "c", "d"]
    assert found["b"].problem is not None and "it was killed by SIGSEGV" in found["b"].problem


def test_an_episode_equals_one_read_in_this_process(recorded: Any, tmp_path: Path) -> None:
    path = recorded.episode.write(tmp_path).json
    assert_equal(reading.read_recording(Source(path)), read_episode(path))


def brightness(camera: CameraTrack, index: int) -> int:
    assert camera.rgb is not None
    return round(float(camera.rgb[index].mean()))


def test_pictures_are_read_after_the_reader_or_the_file_is_gone(tmp_path: Path) -> None:
    path = write(tmp_path, made(4))
    (camera,) = reading.read_recording(Source(path)).cameras
    (other,) = reading.read_recording(Source(write(tmp_path, made(2, speed=1), every=2))).cameras
    reader = newest_reader()
    reader.kill()
    until(lambda: not reader.is_running() or reader.status() == psutil.STATUS_ZOMBIE, "its end")
    # In another order than before: each is opened again under its own number.
    shades = [brightness(other, 1), brightness(camera, 1), brightness(other, 0)]
    assert shades == pytest.approx([40, 20, 0], abs=2)
    for file in tmp_path.iterdir():
        if file.is_file():
            file.unlink()
    assert [brightness(camera, 3), brightness(other, 1)] == pytest.approx([60, 40], abs=2)


def test_recordings_of_many_folders_are_open_with_few_processes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reading, "MAX_READERS", 2)

    def processes() -> int:
        found = psutil.Process().children(recursive=True)
        return sum(one.is_running() and one.status() != psutil.STATUS_ZOMBIE for one in found)

    before = processes()
    opened = [reading.read_recording(Source(write(tmp_path / str(k), made(k)))) for k in (1, 2, 3)]
    until(lambda: processes() <= before + reading.MAX_READERS + 1, "the oldest readers have ended")
    assert [episode.length for episode in opened] == [1, 2, 3]
    # The first reader was replaced, and its pictures are read by a new one.
    shades = [brightness(one.cameras[0], one.length) for one in opened]
    assert shades == pytest.approx([20, 40, 60], abs=2)


def test_linked_files_and_a_folder_that_was_made_again_are_read(tmp_path: Path) -> None:
    here, there = tmp_path / "here", tmp_path / "there"
    here.mkdir()
    path = write(there, made(3))
    for file in there.glob(f"{path.stem}.*"):
        (here / f"linked{file.suffix}").symlink_to(file)
    episode = reading.read_recording(Source(here / "linked.json"))
    assert episode.broken_files == () and episode.length == 3
    assert brightness(episode.cameras[0], 2) == pytest.approx(40, abs=2)
    assert rows(here)["linked"].length == 3
    shutil.rmtree(here)
    again = write(here, made(5))
    assert list(rows(here)) == [again.stem] and rows(here)[again.stem].problem is None
    assert reading.read_recording(Source(again)).length == 5


def test_a_reading_that_is_no_longer_needed_is_given_up_and_the_next_one_is_read(tmp_path: Path) -> None:
    path = write(tmp_path, made(2))
    with pytest.raises(UnreadableRecording, match=path.stem):
        reading.read_recording(Source(path), stopped=lambda: True)
    assert reading.read_recording(Source(path)).length == 2
    with pytest.raises(UnreadableRecording, match="as it is"):
        reading.read_recording(Source(path, problem="It is damaged as it is."))


def test_a_recording_is_named_to_reruns_viewer_by_its_own_id(tmp_path: Path) -> None:
    path = write(tmp_path, made(1, task="A:b/c-v1"), pictures=False).with_suffix(".rrd")
    (store,) = RrdReader(path).recordings()
    assert reading.read_store_id(path) == f"Recording:workbench A\\:b-c-v1:{store.recording_id}"
    (tmp_path / "none.rrd").write_bytes(b"")
    with pytest.raises(UnreadableRecording, match="none"):
        reading.read_store_id(tmp_path / "none.rrd")


def test_recovered_episodes_are_counted_and_the_first_ones_named() -> None:
    assert reading.recovered_text([]) == ""
    assert reading.recovered_text(["a", "b", "c", "d", "e"]).endswith(": a, b, c and 2 more")
    assert reading.recovered_text(["a"]).startswith("1 ") and reading.recovered_text(["a"]).endswith(": a")


@pytest.mark.slow
def test_readers_end_with_the_program_however_it_ends(tmp_path: Path) -> None:
    describe(tmp_path, "a")
    program = (
        "import sys, os, pathlib, time\n"
        "from workbench.episodes.reader import reading\n"
        "from workbench.episodes.reader.scan import scan_folder\n"
        "folder = pathlib.Path(sys.argv[1])\n"
        "list(reading.read_rows(folder, scan_folder(folder).found.values()))\n"
        "print('read', flush=True)\n"
        "time.sleep(60)\n"
    )
    command = python_command("-c", program, str(tmp_path))
    process = subprocess.Popen(command, env=child_environment(), stdout=subprocess.PIPE)
    assert process.stdout is not None and process.stdout.readline() == b"read\n"
    family = psutil.Process(process.pid).children(recursive=True)
    assert family
    process.kill()
    process.wait()
    process.stdout.close()
    _, alive = psutil.wait_procs(family, timeout=10)
    assert not alive


def test_an_episode_that_claims_more_memory_than_the_limit_is_refused(recorded: Any, tmp_path: Path) -> None:
    path = recorded.episode.write(tmp_path).json
    whole = json.loads(path.read_text()) | {"workbench_checksum": None}
    for length, says in ((10**15, "steps"), (9_000_000, "numbers"), (-5, "steps"), ("many", "broken")):
        whole["workbench"]["length"] = length
        path.write_text(json.dumps(whole))
        with pytest.raises(UnreadableRecording, match=says):
            reading.read_recording(Source(path))
    assert psutil.Process().memory_info().rss < 3 << 30


@pytest.mark.skipif(not landlock_version(), reason="this kernel has no Landlock")
def test_a_reader_can_reach_its_folder_and_nothing_else(tmp_path: Path) -> None:
    folder = tmp_path / "recordings"
    folder.mkdir()
    (folder / "inside").write_text("inside")
    (tmp_path / "outside").write_text("outside")
    program = """
import os, pathlib, socket, subprocess, sys
from workbench.machine.processes.confinement import confine
folder = pathlib.Path(sys.argv[1])
server = socket.socket(); server.bind(("127.0.0.1", 0)); server.listen()
confine([folder], 1 << 30)
def tried(do):
    try:
        do()
        return "did"
    except OSError as error:
        return os.strerror(error.errno)
    except MemoryError:
        return "no memory"
print(tried((folder / "inside").read_text), tried((folder.parent / "outside").read_text), sep="|", end="|")
print(tried(lambda: (folder / "new").write_text("x")), tried(lambda: (folder / "inside").unlink()), sep="|", end="|")
print(tried(lambda: list(pathlib.Path.home().iterdir())), sep="|", end="|")
print(tried(lambda: socket.create_connection(server.getsockname())), sep="|", end="|")
print(tried(lambda: os.kill(os.getppid(), 0)), tried(lambda: bytearray(2 << 30)), sep="|", end="|")
print(tried(lambda: subprocess.run(["/bin/true"], check=True)), tried(lambda: open(f"/proc/{os.getppid()}/environ").read()), sep="|")
"""
    ran = subprocess.run(
        python_command("-c", program, str(folder)),
        env=child_environment(OPENBLAS_NUM_THREADS="1"),
        capture_output=True,
        text=True,
    )
    no = "Permission denied"
    assert ran.stdout.strip().split("|") == [
        "did", no, no, no, no, no, "Operation not permitted", "no memory", "did", no
    ], ran.stderr  # fmt: skip
    assert (folder / "inside").read_text() == "inside"
