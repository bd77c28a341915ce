"""The user's configuration folder: writes are atomic and leave no temporary files."""

from __future__ import annotations

import errno
import os
import resource
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import psutil
import pytest

from workbench.machine import folders as module
from workbench.machine.folders import (
    MAX_FILE_BYTES,
    NoUserFolder,
    create_private,
    locked,
    read_private,
    set_aside,
    write_private,
)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    return tmp_path / "config" / "workbench"


@contextmanager
def full_disk() -> Iterator[None]:
    """Let the kernel refuse to grow any file."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_files_are_private_to_the_user(folder: Path) -> None:
    assert read_private("a.json") is None
    write_private("a.json", b"one")
    write_private("a.json", b"two")
    assert read_private("a.json") == b"two" and names(folder) == ["a.json"]
    assert folder.stat().st_mode & 0o777 == 0o700 and (folder / "a.json").stat().st_mode & 0o777 == 0o600
    assert not create_private("a.json", b"three") and read_private("a.json") == b"two"
    assert create_private("b", b"three") and read_private("b") == b"three"
    assert (folder / "b").stat().st_mode & 0o777 == 0o600
    assert set_aside("b") == folder / "b.broken" and read_private("b") is None
    assert names(folder) == ["a.json", "b.broken"]


@pytest.mark.parametrize("call", ["fsync", "link"])
def test_a_failed_create_leaves_nothing(folder: Path, call: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object, **__: object) -> None:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    with monkeypatch.context() as patch:
        patch.setattr(os, call, fail)
        with pytest.raises(OSError, match="Input/output"):
            create_private("key", b"one")
    assert names(folder) == []
    assert create_private("key", b"two")


@pytest.mark.parametrize("write", [write_private, create_private])
def test_a_full_disk_leaves_nothing(folder: Path, write: Callable[[str, bytes], object]) -> None:
    write_private("a.json", b"one")
    with full_disk(), pytest.raises(OSError) as caught:
        write("b.json", b"x" * 100)
    assert caught.value.errno == errno.EFBIG
    assert read_private("a.json") == b"one" and names(folder) == ["a.json"]


def test_a_lock_admits_one_thread_at_a_time(folder: Path) -> None:
    inside, seen = [0], []

    def work() -> None:
        for _ in range(50):
            with locked("a.json"):
                inside[0] += 1
                seen.append(inside[0])
                content = read_private("count") or b"0"
                write_private("count", str(int(content) + 1).encode())
                inside[0] -= 1

    threads = [threading.Thread(target=work) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    assert set(seen) == {1} and read_private("count") == b"150"
    with locked("other"), locked("a.json"):
        pass  # locks of different names are independent
    assert names(folder) == ["a.json.lock", "count", "other.lock"]
    assert (folder / "a.json.lock").stat().st_mode & 0o777 == 0o600


@pytest.mark.parametrize("mode", [0o620, 0o602])
def test_files_that_others_can_write_are_not_read(folder: Path, mode: int) -> None:
    write_private("a.json", b"one")
    (folder / "a.json").chmod(mode)
    with pytest.raises(NoUserFolder, match=r"other users may write to .*a\.json"):
        read_private("a.json")
    (folder / "a.json").chmod(0o644)
    assert read_private("a.json") == b"one"
    folder.chmod(0o700 | mode & 0o022)
    for use in (lambda: read_private("a.json"), lambda: write_private("a.json", b"two"), lambda: _enter("a")):
        with pytest.raises(NoUserFolder, match="chmod go-w"):
            use()
    folder.chmod(0o755)
    assert read_private("a.json") == b"one"


def _enter(name: str) -> None:
    with locked(name):
        pass


def test_files_of_another_user_are_not_read(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_private("a.json", b"one")
    me = os.geteuid()
    # The test cannot switch users, so it fakes the user id.
    monkeypatch.setattr(module.os, "geteuid", lambda: me + 4711)
    if me == 0:
        assert read_private("a.json") == b"one"  # root's files are accepted
        os.chown(folder / "a.json", 4710, -1)
    with pytest.raises(NoUserFolder, match="another user"):
        read_private("a.json")


def test_only_regular_files_are_read(folder: Path) -> None:
    write_private("large", b"")
    os.truncate(folder / "large", MAX_FILE_BYTES + 1)
    os.mkfifo(folder / "pipe", 0o600)
    (folder / "folder").mkdir(0o700)
    for name in ("large", "pipe", "folder"):
        before = psutil.Process().num_fds()
        with pytest.raises(NoUserFolder, match="not a regular file"):
            read_private(name)
        assert psutil.Process().num_fds() == before
    os.truncate(folder / "large", MAX_FILE_BYTES)
    assert len(read_private("large") or b"") == MAX_FILE_BYTES
