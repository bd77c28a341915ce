"""``workbench open`` leaves no process behind, however it ends and whatever its worker is doing."""

from __future__ import annotations

import ctypes
import shutil
import signal
import time
from pathlib import Path

import psutil
import pytest

from tests.drive.episodes import made, write
from tests.drive.hung_disk import HungDisk
from tests.drive.page import TASK, open_workbench
from tests.drive.processes import workers_of
from tests.drive.tabs import open_deaf_tab, tabs_of
from tests.drive.waiting import until
from tests.episodes.verify_rrd import verify_rrd
from tests.live.hazards import provoke, provoked, write_task
from workbench.live.commands import PlayRun
from workbench.record.commands import ChooseRecordedEnvs, ToggleRecording

pytestmark = pytest.mark.usefixtures("child_process")

EXIT_TIMEOUT_SECONDS = 15.0


def gone(processes: list[psutil.Process]) -> bool:
    _, alive = psutil.wait_procs(processes, timeout=EXIT_TIMEOUT_SECONDS)
    return not alive


def signal_thread(pid: int, thread: int, number: signal.Signals) -> None:
    if ctypes.CDLL(None, use_errno=True).tgkill(pid, thread, int(number)) != 0:
        raise OSError(ctypes.get_errno(), "tgkill")


@pytest.mark.slow
@pytest.mark.parametrize(
    "number", [pytest.param(signal.SIGINT, id="ctrl-c"), pytest.param(signal.SIGKILL, id="kill -9")]
)
def test_a_hanging_worker_ends_with_its_server(tmp_path: Path, number: signal.Signals) -> None:
    file = write_task(tmp_path)
    provoke(file, "build", "catch")
    with open_workbench(str(file), "--num-envs", "1", "--no-spare", cwd=tmp_path) as opened:
        server = psutil.Process(opened.process.pid)
        until(lambda: provoked(file), "the build of the task")
        processes = [server, *server.children(recursive=True)]
        began = time.monotonic()
        server.send_signal(number)
        assert gone(processes)
        print(f"{number.name}: all gone after {time.monotonic() - began:.2f} s")


@pytest.mark.slow
def test_a_signal_delivered_to_another_thread_ends_the_page(tmp_path: Path) -> None:
    """Python's handler runs in the main thread, which such a signal does not wake: Ctrl-C must still work."""
    (tmp_path / "recordings").mkdir()
    with open_workbench("recordings", cwd=tmp_path, what="review") as opened:
        server = psutil.Process(opened.process.pid)
        others = [thread.id for thread in server.threads() if thread.id != server.pid]
        signal_thread(server.pid, max(others), signal.SIGINT)
        assert gone([server])
    assert opened.process.returncode == 0


@pytest.mark.slow
def test_ctrl_c_ends_everything_that_can_be_running(tmp_path: Path) -> None:
    """Tabs, one of which reads nothing; a recording; a worker in an infinite loop; a spare worker and a rescoring process."""
    file = write_task(tmp_path)
    # Without a renderer: in software the first picture takes about 15 s.
    arguments = (str(file), "--num-envs", "2", "--env", "render_backend=none")
    with open_workbench(*arguments, cwd=tmp_path) as opened, tabs_of(opened.url) as tabs:
        server = psutil.Process(opened.process.pid)
        opened.wait_for_line("loaded", 90)
        tab, _ = tabs.open(), tabs.open()
        deaf = open_deaf_tab(opened.url)
        until(lambda: tab.open, "the tab")
        tabs.trigger(tab, "Start or stop recording")
        tabs.trigger(tab, "Play or pause")
        until(lambda: list((tmp_path / "recordings").glob("*.rrd")), "the first episodes")
        file.write_text(file.read_text().replace("> 0.05}", "> 0.06}"))
        opened.wait_for_line("patched", 90)
        until(lambda: len(workers_of(server)) == 3, "the spare worker and the rescoring process")
        provoke(file, "evaluate", "catch")
        until(lambda: provoked(file), "the loop")
        processes = [server, *server.children(recursive=True)]
        said, began = len(opened.lines), time.monotonic()
        server.send_signal(signal.SIGINT)
        assert gone(processes)
        print(f"all gone after {time.monotonic() - began:.2f} s")
        deaf.close()
    recordings = list((tmp_path / "recordings").glob("*.rrd"))
    assert recordings and not [problem for problem in map(verify_rrd, recordings) if problem is not None]
    ending = "\n".join(opened.lines[said:])
    assert "Traceback" not in ending, "\n".join(opened.lines)


@pytest.mark.slow
def test_ctrl_c_waits_for_episodes_that_are_being_written(tmp_path: Path) -> None:
    """It waits longer than for a hung disk."""
    count = 32
    shutil.copy(TASK, tmp_path)
    arguments = (TASK.name, "--num-envs", str(count), "--env", "render_backend=none", "--no-spare")
    with open_workbench(*arguments, cwd=tmp_path) as opened, tabs_of(opened.url) as tabs:
        opened.wait_for_line("loaded", 90)
        tab = tabs.open()
        until(lambda: tab.open and tab.name, "the tab")
        for command in (ChooseRecordedEnvs(envs="all"), ToggleRecording(), PlayRun()):
            assert "refused" not in tabs.do(tab, command)
        folder = tmp_path / "recordings"
        until(lambda: len(list(folder.glob("*.rrd"))) > 0, "the first episode of each env")
    recordings = list(folder.glob("*.rrd"))
    assert opened.process.returncode == 0 and len(recordings) >= count, opened.lines[-5:]
    assert not [problem for problem in map(verify_rrd, recordings) if problem is not None]


MAX_EXIT_SECONDS = 2.0


LIVE = (TASK.name, "--num-envs", "1", "--env", "render_backend=none", "--no-spare")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("what", "arguments", "calls", "presses"),
    [
        pytest.param("open", LIVE, ("stat", "open"), (), id="watching"),
        pytest.param("open", LIVE, ("pwrite", "fsync"), ("Start or stop recording", "Play"), id="recording"),
        pytest.param(
            "open",
            ("empty.py", *LIVE[1:]),
            ("write", "rename"),
            ("Write the minimal task into the empty file",),
            id="edit",
        ),
        pytest.param("review", (".",), ("scandir", "open", "stat"), (), id="library"),
        pytest.param("start", ("--recordings", "/nowhere/recordings"), ("scandir", "open"), (), id="search"),
    ],
)
def test_ctrl_c_ends_a_page_with_any_disk_hung(
    tmp_path: Path,
    tmp_path_factory: pytest.TempPathFactory,
    what: str,
    arguments: tuple[str, ...],
    calls: tuple[str, ...],
    presses: tuple[str, ...],
) -> None:
    """The last of `presses` is repeated until a call hangs."""
    write(tmp_path, made(4, seed=1), pictures=False)
    shutil.copy(TASK, tmp_path)
    (tmp_path / "empty.py").touch()
    disk = HungDisk(tmp_path, tmp_path_factory.mktemp("aside"), calls)
    with open_workbench(*arguments, cwd=disk.folder, what=what, env=disk.environment()) as opened:
        if what == "open":
            opened.wait_for_line("loaded|failed", 90)
        with tabs_of(opened.url) as tabs:
            tab = tabs.open()
            until(lambda: tab.open, "the tab")
            for press in presses[:-1]:
                tabs.trigger(tab, press)
            disk.hang()
            disk.until_it_hangs(lambda: [tabs.trigger(tab, press) for press in presses[-1:]])
            server, began = psutil.Process(opened.process.pid), time.monotonic()
            processes = [server, *server.children(recursive=True)]
            server.send_signal(signal.SIGINT)
            assert gone([server])
            seconds = time.monotonic() - began
            assert gone(processes)
    assert opened.process.returncode == 0 and seconds < MAX_EXIT_SECONDS, opened.lines
