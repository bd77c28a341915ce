import os
import socket
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from workbench.machine.files import FileTooLarge, NotARegularFile, open_regular_file, read_regular_file


def test_a_file_and_a_link_to_one_are_read(tmp_path: Path) -> None:
    file = tmp_path / "task.py"
    file.write_bytes(b"x = 1\n")
    (tmp_path / "link.py").symlink_to(file)
    assert read_regular_file(file, 100) == b"x = 1\n"
    assert read_regular_file(str(tmp_path / "link.py"), 6) == b"x = 1\n"
    with open_regular_file(file) as opened:
        assert opened.read(3) == b"x ="
        assert not os.get_inheritable(opened.fileno())


def test_one_byte_too_many_is_refused_with_both_sizes(tmp_path: Path) -> None:
    file = tmp_path / "task.py"
    file.write_bytes(b"1234567")
    with pytest.raises(FileTooLarge, match=r"task\.py has 7 bytes, more than the limit of 6 bytes") as caught:
        read_regular_file(file, 6)
    assert isinstance(caught.value, OSError) and str(caught.value.strerror).startswith("has 7 bytes")
    with pytest.raises(FileTooLarge):
        open_regular_file(file, 6)


def test_a_file_without_a_size_is_read_up_to_the_limit() -> None:
    assert os.stat("/proc/self/status").st_size == 0
    with pytest.raises(FileTooLarge, match="has more than the limit of 10 bytes"):
        read_regular_file("/proc/self/status", 10)


def _pipe(path: Path) -> None:
    os.mkfifo(path)


def _socket(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(os.path.relpath(path))


@pytest.mark.parametrize(
    ("make", "kind"),
    [
        (_pipe, "named pipe"),
        (_socket, "socket"),
        (lambda path: path.symlink_to("/dev/zero"), "character device"),
        (lambda path: path.mkdir(), "folder"),
    ],
)
def test_anything_but_a_regular_file_is_refused_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, make: Callable[[Path], None], kind: str
) -> None:
    monkeypatch.chdir(tmp_path)  # the path of a socket must be short
    path = tmp_path / "task.py"
    make(path)
    with pytest.raises(NotARegularFile, match=rf"task\.py is a {kind}, not a regular file"):
        read_regular_file(path, 100)
    with pytest.raises(NotARegularFile):
        open_regular_file(path)


@pytest.mark.timeout(60)  # a blocking read would never return
def test_a_file_replaced_by_a_pipe_does_not_block(tmp_path: Path) -> None:
    path, stop = tmp_path / "task.py", threading.Event()

    def exchange() -> None:
        while not stop.is_set():
            for make in (lambda at: at.write_bytes(b"x"), _pipe):
                other = tmp_path / "other"
                make(other)
                other.replace(path)

    path.write_bytes(b"x")
    thread = threading.Thread(target=exchange)
    thread.start()
    read = refused = 0
    try:
        while read < 300 or not refused:
            try:
                assert read_regular_file(path, 10) == b"x"
                read += 1
            except NotARegularFile:
                refused += 1
    finally:
        stop.set()
        thread.join()


def test_no_descriptor_is_left_open(tmp_path: Path) -> None:
    _pipe(tmp_path / "pipe")
    before = len(os.listdir("/proc/self/fd"))
    for _ in range(20):
        for path in (tmp_path / "pipe", tmp_path, "/dev/zero", "/proc/self/status"):
            with pytest.raises((NotARegularFile, FileTooLarge)):
                read_regular_file(path, 10)
    assert len(os.listdir("/proc/self/fd")) == before
