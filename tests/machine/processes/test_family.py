"""Processes that a worker started end with it, even daemons, and other processes are not touched."""

from __future__ import annotations

import fcntl
import os
import signal
import subprocess
import sys
import termios
from collections.abc import Callable, Iterator
from pathlib import Path

import psutil
import pytest

from tests.drive.waiting import until
from workbench.live.process.memory_limit import FamilyMemory
from workbench.machine.processes.child_environment import child_environment, python_command
from workbench.machine.processes.family import end_family, family, proportional_memory, resident_memory

_MEMBER = '''
import ctypes, mmap, os, signal, sys, threading, time


def detach():
    """Detach as a daemon does, under another name and with an empty environment."""
    if os.fork() == 0:
        os.setsid()
        if os.fork() == 0:
            os.execve("/bin/sleep", ["innocent", "600"], {})
        os._exit(0)
    os.wait()


def main(how, *_):
    if how == "terminal":
        print("ready", flush=True)
        try:
            os.read(os.open("/dev/tty", os.O_RDWR), 1)
        except OSError:
            os._exit(7)
    if how in ("hold", "share"):
        held = mmap.mmap(-1, 64 * 2**20, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
        held.write(b"x" * len(held))
        if how == "share":
            for _ in range(4):
                if os.fork() == 0:
                    time.sleep(600)
        print("ready", flush=True)
        time.sleep(600)
    detach()
    os.posix_spawn("/bin/sleep", ["sleep", "600"], {})
    print("ready", flush=True)
    sys.stdin.readline()
    if how == "exit":
        sys.exit(3)
    if how == "crash":
        ctypes.string_at(0)
    if how == "group":
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        os.killpg(0, signal.SIGTERM)
        os._exit(5)
    if how == "pthread_exit":
        threading.Thread(target=time.sleep, args=(600,)).start()
        ctypes.CDLL(None).pthread_exit(None)
    time.sleep(600)
'''


@pytest.fixture
def begin(child_process: None, tmp_path: Path) -> Iterator[Callable[..., subprocess.Popen[bytes]]]:
    begun: list[subprocess.Popen[bytes]] = []
    (tmp_path / "family_member.py").write_text(_MEMBER)

    def begin(how: str) -> subprocess.Popen[bytes]:
        process = subprocess.Popen(
            python_command(
                "-m", "workbench.machine.processes.family", str(os.getpid()), "family_member", how
            ),
            env=child_environment(PYTHONPATH=str(tmp_path)),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        begun.append(process)
        assert process.stdout is not None and process.stdout.readline() == b"ready\n"
        return process

    yield begin
    for process in begun:
        end_family(process)


def test_a_read_from_the_terminal_fails_and_does_not_stop_the_process(
    child_process: None, tmp_path: Path
) -> None:
    (tmp_path / "family_member.py").write_text(_MEMBER)
    ours, theirs = os.openpty()
    process = subprocess.Popen(
        python_command(
            "-m", "workbench.machine.processes.family", str(os.getpid()), "family_member", "terminal"
        ),
        env=child_environment(PYTHONPATH=str(tmp_path)),
        stdin=theirs,
        stdout=theirs,
        stderr=theirs,
        start_new_session=True,
        preexec_fn=lambda: fcntl.ioctl(theirs, termios.TIOCSCTTY, 0),
    )
    try:
        assert process.wait(timeout=30) == 7
    finally:
        end_family(process)
        os.close(ours)
        os.close(theirs)


def members(keeper: int) -> list[psutil.Process]:
    return [psutil.Process(pid) for pid in family(keeper)[1:]]


def have_ended(processes: list[psutil.Process]) -> bool:
    return not psutil.wait_procs(processes, timeout=10)[1]


@pytest.mark.parametrize(("how", "code"), [("exit", 3), ("crash", -signal.SIGSEGV), ("group", 5)])
def test_detached_processes_end_with_the_worker_whose_exit_code_is_returned(
    begin: Callable[..., subprocess.Popen[bytes]], how: str, code: int
) -> None:
    keeper = begin(how)
    until(lambda: len(family(keeper.pid)) == 4, "the whole family")
    processes = members(keeper.pid)
    assert {process.name() for process in processes} >= {"sleep"}
    assert keeper.stdin is not None
    keeper.stdin.write(b"\n")
    keeper.stdin.close()
    assert keeper.wait(timeout=20) == code
    assert have_ended(processes)


def test_end_family_ends_one_family_only(begin: Callable[..., subprocess.Popen[bytes]]) -> None:
    one, other = begin("wait"), begin("wait")
    ours = subprocess.Popen(["sleep", "600"], start_new_session=True)
    all_of_one, all_of_other = members(one.pid), members(other.pid)
    end_family(one)
    assert one.returncode == -signal.SIGKILL and have_ended(all_of_one)
    assert all(process.is_running() for process in all_of_other) and ours.poll() is None
    end_family(other)
    ours.kill()
    assert ours.wait() == -signal.SIGKILL and have_ended(all_of_other)


@pytest.mark.slow
def test_end_family_does_not_wait_for_a_stopped_keeper(
    begin: Callable[..., subprocess.Popen[bytes]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("workbench.machine.processes.family._END_TIMEOUT_SECONDS", 0.1)
    keeper = begin("wait")
    processes = members(keeper.pid)
    os.kill(keeper.pid, signal.SIGSTOP)
    end_family(keeper)
    worker = processes.pop(0)
    assert have_ended([worker])
    for process in processes:
        process.kill()


def test_a_killed_server_leaves_no_family(child_process: None, tmp_path: Path) -> None:
    (tmp_path / "family_member.py").write_text(_MEMBER)
    (tmp_path / "server.py").write_text(
        "import os, subprocess, sys, time\n"
        "command = [sys.executable, '-m', 'workbench.machine.processes.family', str(os.getpid()), 'family_member', 'wait']\n"
        "subprocess.Popen(command, stdin=subprocess.DEVNULL)\n"
        "time.sleep(600)\n"
    )
    server = subprocess.Popen(
        [sys.executable, str(tmp_path / "server.py")],
        env=child_environment(PYTHONPATH=str(tmp_path)),
        stdout=subprocess.PIPE,
    )
    assert server.stdout is not None
    # The member's stdin is at EOF, so it goes on to sleep.
    assert server.stdout.readline() == b"ready\n"
    until(lambda: len(family(server.pid)) == 5, "the whole family")
    processes = members(server.pid)
    server.kill()
    server.wait()
    assert have_ended(processes)


def test_a_familys_memory_counts_shared_pages_once(begin: Callable[..., subprocess.Popen[bytes]]) -> None:
    keeper = begin("share")
    until(lambda: len(family(keeper.pid)) == 6, "the whole family")
    everyone = family(keeper.pid)[1:]
    assert sum(map(resident_memory, everyone)) > 5 * 64 * 2**20
    together = proportional_memory(everyone)
    assert 64 * 2**20 < together < 2 * 64 * 2**20
    memory = FamilyMemory()
    assert 64 * 2**20 < memory.measure(keeper.pid, limit=2 * 64 * 2**20) < 2 * 64 * 2**20
    end_family(keeper)
    assert memory.measure(keeper.pid) == 0
