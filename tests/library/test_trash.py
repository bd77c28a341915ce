"""Deleting and restoring move all files of a recording or none, whatever call fails."""

from __future__ import annotations

import errno
from pathlib import Path

import pytest

from tests.episodes.refused_calls import refused
from workbench.library.trash import (
    TRASH,
    Trash,
    TrashError,
    empty_trash,
    move_to_trash,
    read_trash,
    restore_from_trash,
)


def files(folder: Path) -> dict[str, bytes]:
    """The content of all files below `folder`, by path."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def outside(folder: Path) -> dict[str, bytes]:
    return {name: content for name, content in files(folder).items() if not name.startswith(TRASH)}


def recording(folder: Path, name: str, suffixes: tuple[str, ...] = (".json", ".h5", ".rrd")) -> list[Path]:
    """Write the files of a recording, main file first; each contains its own name."""
    paths = [folder / f"{name}{suffix}" for suffix in suffixes]
    for path in paths:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(str(path.relative_to(folder)))
    return paths


def test_the_trash_is_counted_in_deletions_files_and_bytes(tmp_path: Path) -> None:
    assert read_trash(tmp_path) == Trash()
    recordings = [recording(tmp_path, name) for name in ("a", "sub/b")]
    size = sum(len(content) for content in files(tmp_path).values())
    first = move_to_trash(tmp_path, recordings[:1])
    second = move_to_trash(tmp_path, recordings[1:])
    assert first is not None and second is not None and first < second
    (tmp_path / TRASH / "no deletion").write_text("?")
    (tmp_path / TRASH / "link").symlink_to(tmp_path)
    assert read_trash(tmp_path) == Trash((first, second), files=6, size=size)
    assert move_to_trash(tmp_path, recordings) is None, "the files are already moved"
    assert read_trash(tmp_path).batches == (first, second)
    assert restore_from_trash(tmp_path, second) == ("sub/b.h5", "sub/b.rrd", "sub/b.json")
    assert read_trash(tmp_path).batches == (first,)
    with pytest.raises(TrashError, match="no longer in the trash"):
        restore_from_trash(tmp_path, second)
    with pytest.raises(TrashError, match="no longer in the trash"):
        restore_from_trash(tmp_path, "link")


def test_links_are_moved_as_links_and_restoring_overwrites_nothing(tmp_path: Path) -> None:
    paths = recording(tmp_path, "a")
    paths[2].unlink()
    paths[2].symlink_to(tmp_path / "gone")
    batch = move_to_trash(tmp_path, [paths])
    assert batch is not None and outside(tmp_path) == {} and not paths[2].is_symlink()
    paths[0].write_text("a newer one")
    with pytest.raises(TrashError, match="a.json was not moved: there is already a file with that name"):
        restore_from_trash(tmp_path, batch)
    assert outside(tmp_path) == {"a.json": b"a newer one"} and not paths[2].is_symlink()
    paths[0].unlink()
    assert len(restore_from_trash(tmp_path, batch)) == 3
    assert paths[2].is_symlink() and outside(tmp_path) == {"a.json": b"a.json", "a.h5": b"a.h5"}


def test_a_trash_that_is_a_link_to_another_folder_is_not_touched(tmp_path: Path) -> None:
    folder, elsewhere = tmp_path / "folder", tmp_path / "elsewhere"
    paths = recording(folder, "a")
    recording(elsewhere / "batch", "b")
    before = files(elsewhere)
    (folder / TRASH).symlink_to(elsewhere)
    assert read_trash(folder) == Trash()
    with pytest.raises(TrashError, match="is a link, so nothing was moved there"):
        move_to_trash(folder, [paths])
    with pytest.raises(TrashError, match="could not be emptied"):
        empty_trash(folder)
    assert files(elsewhere) == before and all(path.exists() for path in paths)


@pytest.mark.parametrize("then", [0, errno.EROFS])
def test_whatever_call_fails_no_recording_is_split_over_two_places(tmp_path: Path, then: int) -> None:
    """If moving back fails too, the error names where the files are."""

    def two(folder: Path) -> list[list[Path]]:
        return [recording(folder, "sub/a"), recording(folder, "b", (".json", ".h5", ".rrd", ".notes"))]

    folder = tmp_path / "0"
    both, before = two(folder), files(folder)
    with refused() as calls:
        move_to_trash(folder, both)
    assert {call.split()[0] for call in calls} == {"mkdir", "rename"}
    for at, call in enumerate(calls, 1):
        folder = tmp_path / str(at)
        both = two(folder)
        problem = ""
        with refused(at, then=then):
            try:
                move_to_trash(folder, both)
            except TrashError as error:
                problem = str(error)
        left = outside(folder)
        assert problem or left == {}, call
        for paths in both:
            moved = [path for path in paths if not path.exists()]
            if len(moved) not in (0, len(paths)):
                assert then and all(f"{path} is now at {folder / TRASH}" in problem for path in moved), (
                    call,
                    problem,
                )
        for batch in read_trash(folder).batches:
            restore_from_trash(folder, batch)
        assert outside(folder) == before, call


def test_foreign_content_of_the_trash_is_no_deletion(tmp_path: Path) -> None:
    outer = tmp_path / "outer"
    paths = recording(tmp_path / "folder", "a")
    recording(outer, "b")
    batch = move_to_trash(tmp_path / "folder", [paths])
    assert batch is not None
    for name in ("..", "../..", "../../outer", "", ".", "nothing", str(outer), f"{batch}/."):
        with pytest.raises(TrashError, match="no longer in the trash"):
            restore_from_trash(tmp_path / "folder", name)
    assert len(files(outer)) == 3
