from __future__ import annotations

import io
import json
import os
import re
import shutil
import sqlite3
import tempfile
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import h5py
import mani_skill.envs  # noqa: F401  (registers the tasks)
import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mani_skill.utils.wrappers.record import RecordEpisode
from PIL import Image

from tests.drive.episodes import Made
from tests.drive.waiting import until
from tests.episodes.library_files import describe
from workbench.episodes.reader.read_episode import read_episode
from workbench.episodes.reader.read_rows import read_found
from workbench.episodes.reader.reading import read_rows
from workbench.episodes.reader.scan import RecordingFiles, scan_folder
from workbench.episodes.row import Facts, LibraryEntry, LibraryRow, clean_facts
from workbench.library.folder import Library, LibraryError
from workbench.library.index import index_path

pytestmark = pytest.mark.usefixtures("child_process")


@pytest.fixture(scope="module")
def maniskill(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with two episodes, of 3 and 2 steps, that ManiSkill's own recorder wrote."""
    folder = tmp_path_factory.mktemp("demos")
    env: Any = gym.make("PushCube-v1", obs_mode="none", render_backend="none", num_envs=1)
    env = RecordEpisode(env, str(folder), trajectory_name="demo", save_video=False, source_type="test")
    for seed, steps in ((5, 3), (6, 2)):
        env.reset(seed=seed)
        for _ in range(steps):
            env.step(np.zeros(env.action_space.shape, np.float32))
    env.close()
    return folder


@pytest.fixture
def library(tmp_path: Path) -> Iterator[Library]:
    library = Library(tmp_path)
    yield library
    library.close()


def read(folder: Path) -> list[LibraryRow]:
    """The rows of a newly opened library."""
    library = Library(folder)
    library.refresh()
    library.close()
    return list(library.view().rows)


def tree(folder: Path) -> dict[str, bytes]:
    """The content of all files in the folder, by relative path."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()
    }


# --- content of rows ------------------------------------------------------------------------------------


def test_a_written_recording_is_a_row_and_reads_the_same_after_tagging(
    tmp_path: Path, library: Library, make_episode: Callable[..., Made]
) -> None:
    made = make_episode(5, reward=np.full(5, 0.5, np.float32), evaluate={"success": np.arange(6) >= 4})
    unfinished = make_episode().writer(tmp_path)
    files = made.write(tmp_path)
    library.refresh()
    (row,) = library.view().rows
    assert (row.id, row.task, row.seed, row.length) == (made.info.id, "Made-v1", 7, 5)
    assert (row.total_reward, row.success, row.problem) == (2.5, True, None)
    assert set(row.paths) == {files.json, files.h5, files.rrd}
    library.set_tags([row.id], add=["good"])
    library.set_note([row.id], "slips")
    read_back = read_episode(files.json)
    assert read_back.info == made.info and len(read_back.reward) == 5
    assert [row.tags for row in library.view().rows] == [("good",)]
    unfinished.discard()


def test_each_trajectory_of_maniskills_recorder_is_a_row(maniskill: Path) -> None:
    first, second = read(maniskill)
    assert (first.name, second.name) == ("demo#traj_0", "demo#traj_1")
    assert (first.kind, first.task, first.trajectory, first.problem) == (
        "maniskill",
        "PushCube-v1",
        "traj_0",
        None,
    )
    assert (first.seed, first.length, second.seed, second.length) == (5, 3, 6, 2)
    assert first.success is False and first.total_reward is not None and first.total_reward > 0
    assert first.acted_by == "test"
    assert first.control_mode == "pd_joint_delta_pos" and first.id != second.id


def test_a_trajectory_with_pictures_has_a_thumbnail(
    maniskill: Path, tmp_path: Path, library: Library
) -> None:
    for suffix in (".json", ".h5"):
        shutil.copy(maniskill / f"demo{suffix}", tmp_path)
    seen = np.zeros((4, 200, 300, 3), np.uint8)
    seen[3] = (255, 0, 0)
    with h5py.File(tmp_path / "demo.h5", "r+") as file:
        file.create_dataset("traj_0/obs/sensor_data/eye/depth", data=np.zeros((4, 2, 2, 1), np.int16))
        file.create_dataset("traj_0/obs/sensor_data/hand/rgb", data=seen, compression="gzip")
    library.refresh()
    first, second = library.view().rows
    picture = library.thumbnails((first.id,)).get(first.id)
    assert picture is not None and library.thumbnails((second.id,)).get(second.id) is None
    with Image.open(io.BytesIO(picture)) as image:
        assert image.size == (96, 64)
        red, green, _ = np.asarray(image.convert("RGB")).mean((0, 1))
    assert red > 250 and green < 5


@pytest.mark.parametrize(
    ("files", "problem"),
    [
        ({"x.json": b'{"workbench": {"task": '}, "x.json is not JSON, or was cut short."),
        ({"x.rrd": b""}, "x.rrd is not a recording that rerun can read"),
        ({"x.json": b'{"episodes": [{"episode_id": 0}], "env_info": {"env_id": "A-v1"}}'}, "is missing"),
        (
            {"x.json": b'{"episodes": [{"episode_id": 0}], "env_info": {"env_id": "A-v1"}}', "x.h5": b"HDF"},
            "x.h5 is damaged, or still being written.",
        ),
        ({"x.json": b'{"workbench": {"task": "A-v1"}}', "x.h5": b""}, "x.rrd is missing."),
    ],
)
def test_broken_files_are_rows_with_a_message(tmp_path: Path, files: dict[str, bytes], problem: str) -> None:
    for name, content in files.items():
        (tmp_path / name).write_bytes(content)
    (row,) = read(tmp_path)
    assert row.problem is not None and problem in row.problem


def test_other_files_are_no_rows(tmp_path: Path) -> None:
    (tmp_path / "package.json").write_text('{"name": "x"}')
    (tmp_path / "lonely.notes").write_text("{}")
    (tmp_path / "notes.txt").write_text("x")
    describe(tmp_path / ".hidden", "a")
    (tmp_path / "round").symlink_to(tmp_path)
    (tmp_path / "nowhere.json").symlink_to(tmp_path / "gone.json")
    assert read(tmp_path) == []


def test_recordings_with_non_utf_8_names_can_be_shown_and_deleted(tmp_path: Path, library: Library) -> None:
    folder = Path(os.fsdecode(os.fsencode(tmp_path) + b"/caf\xe9"))
    describe(folder, os.fsdecode(b"a\xff\n"), id="aaaa")
    for _ in range(2):
        library.refresh()
        (row,) = library.view().rows
        row.name.encode()
    library.set_note(["aaaa"], "x")
    library.delete(["aaaa"])
    assert library.view().rows == ()
    library.undo_delete()
    assert [row.note for row in library.view().rows] == ["x"]


_anything = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=6,
)
_TYPES: dict[str, tuple[type, ...]] = {
    **dict.fromkeys(("id", "task", "source_hash", "written_at", "note"), (str,)),
    **dict.fromkeys(("env_index", "length"), (int,)),
    **dict.fromkeys(("success", "fail"), (bool, type(None))),
    "seed": (int, type(None)),
    "return": (int, float, type(None)),
    "recovered": (bool,),
    "tags": (list,),
    "thumbnail": (str, type(None)),
}


def is_wrong(name: str, value: Any) -> bool:
    if type(value) not in _TYPES[name]:
        return True
    if name == "tags":
        return not all(isinstance(tag, str) for tag in value)
    return type(value) is int and name != "return" and not -(2**63) <= value < 2**63


@settings(max_examples=60)
@given(st.fixed_dictionaries({}, optional=dict.fromkeys(_TYPES, _anything)))
def test_any_description_gives_one_row_that_the_index_can_store(fields: dict) -> None:
    with tempfile.TemporaryDirectory() as name:
        describe(Path(name), "a", **fields)
        ((facts, picture),) = read_found(Path(name), scan_folder(Path(name)).found["a"])
    wrong = {key for key, value in fields.items() if is_wrong(key, value)}
    named = re.search(
        r"a\.json is not in the format of a recording: .* at \$\.workbench\.(\w+)", facts.problem or ""
    )
    assert facts.kind == "workbench"
    assert named[1] in wrong if wrong and named else (facts.problem is None and not wrong)
    assert clean_facts(msgspec.msgpack.decode(msgspec.msgpack.encode(facts), type=Facts)) == facts
    assert picture is None or picture[:2] == b"\xff\xd8"


# --- following changes ----------------------------------------------------------------------------------


def test_only_changed_recordings_are_read_again(
    tmp_path: Path, library: Library, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in "abc":
        describe(tmp_path, name, note=name)
    library.refresh()
    read_keys: list[str] = []

    def spy(
        folder: Path, wanted: Iterable[RecordingFiles]
    ) -> Iterator[tuple[RecordingFiles, list[LibraryEntry]]]:
        wanted = list(wanted)
        read_keys.extend(found.key for found in wanted)
        return read_rows(folder, wanted)

    monkeypatch.setattr("workbench.library.folder.read_rows", spy)
    library.refresh()
    assert read_keys == []
    describe(tmp_path, "b", note="changed")
    read_keys.clear()
    for suffix in (".json", ".h5", ".rrd"):
        (tmp_path / f"c{suffix}").unlink()
    library.refresh()
    assert read_keys == ["b"]
    assert [(row.name, row.note) for row in library.view().rows] == [("a", "a"), ("b", "changed")]
    read_keys.clear()
    assert [row.note for row in read(tmp_path)] == ["a", "changed"]
    assert read_keys == []  # all rows come from the index


@pytest.mark.parametrize(
    "damage", ["deleted", "garbage", "cut", "another program's", "rows of another version"]
)
def test_a_damaged_index_is_rebuilt(tmp_path: Path, damage: str) -> None:
    for k in range(30):
        describe(tmp_path, f"r{k:02}", seed=k)
    good = read(tmp_path)
    index = index_path(tmp_path)
    content = index.read_bytes()
    if damage == "deleted":
        index.unlink()
    elif damage == "garbage":
        index.write_bytes(os.urandom(len(content)))
    elif damage == "cut":
        index.write_bytes(content[: len(content) // 2])
    else:
        with sqlite3.connect(index) as database:
            if damage == "another program's":
                database.execute("ALTER TABLE read DROP COLUMN rows")
            else:
                database.execute("UPDATE read SET rows = ? WHERE key = ?", (b"\x93\x80\x80\x91\x80", b"r03"))
                assert database.total_changes == 1
        database.close()
    assert len(good) == 30 and read(tmp_path) == good
    library = Library(tmp_path)
    library.refresh()
    assert len(library.thumbnails([row.id for row in good])) == 30
    library.close()


def test_an_index_copied_with_the_folder_is_ignored(tmp_path: Path) -> None:
    folder, mine = tmp_path / "recordings", tmp_path / "another program's.sqlite"
    describe(folder, "a")
    with sqlite3.connect(mine) as database:
        database.execute("CREATE TABLE read (theirs)")
    database.close()
    (folder / ".workbench").mkdir()
    (folder / ".workbench" / "library.sqlite").symlink_to(mine)
    before = mine.read_bytes()
    assert [row.name for row in read(folder)] == ["a"]
    assert mine.read_bytes() == before
    assert sorted(path.name for path in (folder / ".workbench").iterdir()) == ["library.sqlite"]


@pytest.mark.slow
def test_the_table_follows_changes_of_the_folder(tmp_path: Path) -> None:
    folder = tmp_path / "later"
    library = Library(folder)
    library.watch()

    def wait_for(names: list[str], problem: bool) -> None:
        def shown() -> bool:
            view = library.view()
            return [row.name for row in view.rows] == names and (view.problem is not None) == problem

        until(shown, str(names), seen=library.view)

    try:
        wait_for([], problem=True)
        describe(folder, "a")
        wait_for(["a"], problem=False)
        describe(folder / "more", "b")
        wait_for(["a", "more/b"], problem=False)
        shutil.rmtree(folder / "more")
        wait_for(["a"], problem=False)
        shutil.rmtree(folder)
        wait_for([], problem=True)
        assert "does not exist" in str(library.view().problem)
    finally:
        library.close()


# --- tags and notes ---------------------------------------------------------------------------------------


def test_tags_and_note_move_with_the_recording_and_change_nothing_else(
    tmp_path: Path, library: Library
) -> None:
    path = describe(tmp_path, "a", id="a1", tags=["old"])
    before = json.loads(path.read_text())
    library.refresh()
    library.set_tags(["a1"], add=["good", "demo"], remove=["old"])
    library.set_note(["a1"], "slips\nat the end")
    row = library.row("a1")
    assert row is not None and (row.tags, row.note) == (("good", "demo"), "slips at the end")
    after = json.loads(path.read_text())
    assert after.pop("workbench") == {
        **before.pop("workbench"),
        "tags": ["good", "demo"],
        "note": "slips at the end",
    }
    assert after == before
    # Moved to another folder, renamed and without the index, the recording still has them.
    for suffix in (".json", ".h5", ".rrd"):
        (tmp_path / "elsewhere").mkdir(exist_ok=True)
        os.rename(path.with_suffix(suffix), tmp_path / "elsewhere" / f"renamed{suffix}")
    (moved,) = read(tmp_path / "elsewhere")
    assert (moved.id, moved.tags, moved.note) == ("a1", ("good", "demo"), "slips at the end")


def test_foreign_files_are_not_modified(tmp_path: Path, maniskill: Path, library: Library) -> None:
    shutil.copytree(maniskill, tmp_path, dirs_exist_ok=True)
    before = tree(tmp_path)
    library.refresh()
    first, second = library.view().rows
    dates = [first.date, second.date]
    library.set_tags([second.id], add=["fast"])
    library.set_note([first.id], "odd")
    assert [(row.tags, row.note) for row in library.view().rows] == [((), "odd"), (("fast",), "")]
    assert tree(tmp_path).keys() - before.keys() == {"demo.notes"}
    assert [row.date for row in library.view().rows] == dates
    assert before.items() <= tree(tmp_path).items()
    assert [(row.tags, row.note) for row in read(tmp_path)] == [((), "odd"), (("fast",), "")]
    library.set_tags([second.id], remove=["fast"])
    library.set_note([first.id], "")
    assert tree(tmp_path) == before


# --- deleting ---------------------------------------------------------------------------------------------


def test_deleting_moves_all_files_and_can_be_undone(tmp_path: Path, library: Library) -> None:
    for name in ("a", "b", "sub/c"):
        path = tmp_path / name
        describe(path.parent, path.name, id=path.name * 4)
    before = tree(tmp_path)
    library.refresh()
    library.delete(["aaaa", "cccc"])
    assert [row.name for row in library.view().rows] == ["b"] == [row.name for row in read(tmp_path)]
    assert {name for name in tree(tmp_path) if not name.startswith(".trash/")} == {"b.json", "b.h5", "b.rrd"}
    assert library.view().trash.files == 6
    library.undo_delete()
    assert tree(tmp_path) == before and [row.name for row in library.view().rows] == ["a", "b", "sub/c"]
    assert library.view().trash.files == 0
    with pytest.raises(LibraryError, match="trash is empty"):
        library.undo_delete()
    library.delete(["aaaa"])
    library.delete(["bbbb"])
    library.undo_delete()
    assert [row.name for row in library.view().rows] == ["b", "sub/c"], "the last deletion is undone first"


def test_the_trash_is_emptied_for_good_and_vanished_files_are_named(tmp_path: Path, library: Library) -> None:
    seen: list[int] = []
    for name in ("a", "b"):
        describe(tmp_path, name, id=name * 4)
    library.refresh()
    library.on_change.add(lambda: seen.append(library.view().serial))
    library.delete(["aaaa"])
    assert seen and seen[-1] == library.view().serial and library.view().trash.files == 3
    library.empty_trash()
    assert library.view().trash.files == 0 and seen[-1] == library.view().serial
    assert not [name for name in tree(tmp_path) if name.startswith(".trash/")]
    with pytest.raises(LibraryError):
        library.undo_delete()
    for file in tmp_path.glob("b.*"):
        file.unlink()
    with pytest.raises(LibraryError):
        library.delete(["bbbb"])
    assert library.view().rows == () and library.row("bbbb") is None


def test_a_copy_of_a_recording_is_a_row_of_its_own(tmp_path: Path, library: Library) -> None:
    for name in ("a", "sub/b"):
        path = tmp_path / name
        describe(path.parent, path.name, id="same")
    library.refresh()
    first, second = library.view().rows
    assert first.id == "same" != second.id and library.row(second.id) is second
    library.set_note([second.id], "the copy")
    assert [row.note for row in library.view().rows] == ["", "the copy"]
    library.set_tags(["same", second.id], add=["x", "y"])
    library.set_tags(["same"], remove=["x"])
    assert [row.tags for row in library.view().rows] == [("y",), ("x", "y")]
    before = tree(tmp_path), {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.json")}
    library.set_tags(["same"], add=["y"], remove=["x"])
    library.set_note(["same"], " ")
    assert before == (tree(tmp_path), {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.json")})
    library.delete([second.id])
    assert [row.id for row in library.view().rows] == ["same"] == [row.id for row in read(tmp_path)]


def test_one_of_several_trajectories_of_a_file_cannot_be_deleted_alone(
    tmp_path: Path, maniskill: Path, library: Library
) -> None:
    shutil.copytree(maniskill, tmp_path, dirs_exist_ok=True)
    library.refresh()
    before = tree(tmp_path)
    first, second = library.view().rows
    for refused in (library.check_delete, library.delete):
        with pytest.raises(LibraryError, match="demo.h5 holds 2 recordings"):
            refused([first.id])
    assert tree(tmp_path) == before
    library.set_note([first.id], "x")
    library.delete([first.id, second.id])
    assert library.view().rows == () and library.view().trash.files == 3


def test_a_note_that_cannot_be_saved_is_an_error_and_leaves_no_partial_file(
    tmp_path: Path, library: Library
) -> None:
    describe(tmp_path, "a", id="a1")
    library.refresh()
    (tmp_path / "a.json").write_text("{}")
    before = tree(tmp_path)
    with pytest.raises(LibraryError, match="a could not be saved .*is not a recording"):
        library.set_note(["a1"], "x")
    assert tree(tmp_path) == before
    with pytest.raises(LibraryError, match="not in the library any more"):
        library.set_tags(["a1", "zz"], add=["x"])


def test_a_requested_scan_is_made_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The next scheduled scan would be in an hour."""
    for name in ("SCAN_SECONDS", "MAX_PAUSE_SECONDS"):
        monkeypatch.setattr(f"workbench.library.folder.{name}", 3600.0)
    library = Library(tmp_path)
    library.watch()
    try:
        until(lambda: library.view().reading is None, "the first look", seen=library.view)
        for count in (1, 2):
            describe(tmp_path, f"r{count}")
            library.request_scan()
            until(lambda count=count: len(library.view().rows) == count, "the row", seen=library.view)
    finally:
        library.close()
