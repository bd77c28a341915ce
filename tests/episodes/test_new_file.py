"""A new film, sheet or page is written completely or not at all, and replaces no other file."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from tests.episodes.refused_calls import descriptors, left_open, refused
from workbench.machine.files import new_file


def write(path: Path, content: bytes = b"whole") -> None:
    with new_file(path) as temporary:
        temporary.write_bytes(content)


@pytest.fixture(params=[True, False], ids=["links", "no links"])
def links(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> bool:
    """Whether the file system has hard links."""

    def refuse(*_: object) -> None:
        raise OSError(errno.EPERM, "Operation not permitted")

    if not request.param:
        monkeypatch.setattr(os, "link", refuse)
    return request.param


@pytest.mark.parametrize("then", [0, errno.EROFS])
def test_whatever_call_fails_the_file_is_complete_or_absent(tmp_path: Path, links: bool, then: int) -> None:
    with refused() as calls:
        write(tmp_path / "0" / "a.mp4")
    assert {call.split()[0] for call in calls} >= {"mkdir", "fsync", "link" if links else "replace"}
    for at, call in enumerate(calls, 1):
        path, before = tmp_path / str(at) / "a.mp4", descriptors()
        problem = ""
        with refused(at, then=then):
            try:
                write(path)
            except OSError as error:
                problem = str(error.strerror)
        assert left_open(before) == [], call
        if path.exists() and (links or not then or path.stat().st_size):
            assert path.read_bytes() == b"whole" and not problem, call
        else:
            assert problem.startswith(f"Cannot write {path}: "), (call, problem)
        left = list(path.parent.glob("*")) if path.parent.exists() else []
        assert then or call.startswith("unlink") or set(left) <= {path}, call


def test_a_file_that_appeared_meanwhile_is_not_overwritten(tmp_path: Path, links: bool) -> None:
    path = tmp_path / "a.mp4"
    with pytest.raises(FileExistsError, match="is not overwritten"), new_file(path) as temporary:
        temporary.write_bytes(b"ours")
        path.write_bytes(b"of another")
    with pytest.raises(FileExistsError, match="is not overwritten"):
        write(path)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == {"a.mp4": b"of another"}
