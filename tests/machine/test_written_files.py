"""Files of the user are replaced in one step, or stay as they were."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path

import pytest

from workbench.machine.files import (
    FileTooLarge,
    create_file,
    new_file,
    read_regular_file,
    real_path,
    replace_file,
)


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_a_replaced_file_keeps_its_mode_and_a_link_to_it(tmp_path: Path) -> None:
    file, link = tmp_path / "task.py", tmp_path / "link.py"
    file.write_bytes(b"one")
    file.chmod(0o751)
    link.symlink_to("task.py")
    for path, content in ((link, b"two"), (file, b"three")):
        assert replace_file(path, content)
        assert file.read_bytes() == content and link.is_symlink()
        assert stat.S_IMODE(file.stat().st_mode) == 0o751
    assert replace_file(tmp_path / "new.py", b"new") and (tmp_path / "new.py").read_bytes() == b"new"
    assert names(tmp_path) == ["link.py", "new.py", "task.py"]


def test_an_edit_made_meanwhile_is_not_overwritten(tmp_path: Path) -> None:
    file = tmp_path / "task.py"
    file.write_bytes(b"one")
    assert not replace_file(file, b"two", expected=b"on") and file.read_bytes() == b"one"
    assert replace_file(file, b"two", expected=b"one") and file.read_bytes() == b"two"
    assert names(tmp_path) == ["task.py"]


@pytest.mark.parametrize("call", ["fsync", "replace"])
def test_a_failed_write_leaves_the_old_content_alone(
    tmp_path: Path, call: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "task.py"
    file.write_bytes(b"one")

    def fail(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(os, call, fail)
        for _ in range(2):
            with pytest.raises(OSError, match="No space"):
                replace_file(file, b"two")
    assert file.read_bytes() == b"one" and names(tmp_path) == ["task.py"]


@pytest.mark.parametrize("links", [True, False])
def test_a_new_file_never_replaces_one(tmp_path: Path, links: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """With hard links, and on a file system that has none."""
    if not links:

        def refuse(*_: object) -> None:
            raise OSError(errno.EPERM, os.strerror(errno.EPERM))

        monkeypatch.setattr(os, "link", refuse)
    assert create_file(tmp_path / "a", b"one", 0o600)
    assert stat.S_IMODE((tmp_path / "a").stat().st_mode) == 0o600
    assert not create_file(tmp_path / "a", b"two")
    with pytest.raises(NotADirectoryError), new_file(tmp_path / "a" / "e"):
        pass
    assert (tmp_path / "a").read_bytes() == b"one" and names(tmp_path) == ["a"]


def test_a_real_path_of_a_cycle_of_links_is_no_error(tmp_path: Path) -> None:
    (tmp_path / "loop").symlink_to("loop")
    (tmp_path / "to").symlink_to(tmp_path / "file")
    assert real_path(tmp_path / "to") == tmp_path / "file" and real_path(tmp_path / "loop").is_absolute()


@pytest.mark.parametrize(("size", "said"), [(3 << 10, "3.0 KB"), (5 << 19, "2.5 MB"), (900, "900 bytes")])
def test_the_size_of_a_file_that_is_too_large_is_named(tmp_path: Path, size: int, said: str) -> None:
    file = tmp_path / "large.py"
    file.touch()
    os.truncate(file, size)
    with pytest.raises(FileTooLarge) as refused:
        read_regular_file(file, 800)
    assert said in str(refused.value) and "800 bytes" in str(refused.value)
