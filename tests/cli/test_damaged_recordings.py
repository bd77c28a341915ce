"""Commands on recordings name the damaged ones, exit with code 1, and process the others, whatever their names."""

from __future__ import annotations

import json
import os
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.drive.commands import exit_code
from tests.drive.episodes import made, write
from tests.episodes.foreign_h5 import write as write_foreign
from workbench.episodes.reader.reading import find_all_sources
from workbench.library.folder import Library
from workbench.share.make import MakeRequest, make

pytestmark = pytest.mark.usefixtures("child_process")

Damage = Callable[[Path], None]


def halve(file: Path) -> None:
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])


def empty(file: Path) -> None:
    file.write_bytes(b"")


def as_pipe(file: Path) -> None:
    file.unlink()
    os.mkfifo(file)


def as_loop(file: Path) -> None:
    file.unlink()
    file.symlink_to(file.name)


DAMAGES: dict[str, Damage] = {
    "cut": halve,
    "empty": empty,
    "gone": Path.unlink,
    "pipe": as_pipe,
    "loop": as_loop,
}


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The .json of a workbench recording."""
    return write(tmp_path_factory.mktemp("ours"), made(4, seed=3, task="PickCube-v1")).with_suffix(".json")


def ours(recording: Path, folder: Path, name: str) -> Path:
    """Copy the recording under this name; returns its .json."""
    folder.mkdir(exist_ok=True)
    for suffix in (".rrd", ".h5", ".json"):
        shutil.copy(recording.with_suffix(suffix), folder / f"{name}{suffix}")
    return folder / f"{name}.json"


CASES = [
    *[("ours.h5", kind) for kind in DAMAGES],
    *[
        (name, kind)
        for name in ("ours.rrd", "ours.json", "theirs.h5", "theirs.json")
        for kind in ("cut", "gone")
    ],
    *[(name, "cut") for name in ("set/meta/info.json", "set/data")],
]


@pytest.mark.parametrize(("broken", "kind"), CASES)
def test_each_command_names_the_damaged_recording(
    tmp_path: Path, recording: Path, capsys: pytest.CaptureFixture[str], broken: str, kind: str
) -> None:
    folder = tmp_path / "recordings"
    folder.mkdir()
    stem = broken.partition("/")[0].partition(".")[0]
    if stem == "ours":
        ours(recording, folder, "ours")
    elif stem == "theirs":
        write_foreign(folder)
    else:
        assert exit_code("export", recording, "--lerobot", folder / "set") == 0
    file = folder / broken
    DAMAGES[kind](next(file.rglob("*.parquet")) if file.is_dir() else file)
    # Make the files old: for a new .h5, a .json might still be written.
    for path in folder.iterdir():
        os.utime(path, (1e9, 1e9), follow_symlinks=False)

    library = Library(folder)
    library.refresh()
    assert any(row.problem for row in library.view().rows)
    library.close()

    out = tmp_path / "out"
    commands: dict[str, list[object]] = {
        "share": ["share", folder, "--sheet", "--out", out],
        "lerobot": ["export", folder, "--lerobot", out / "set"],
        "maniskill": ["export", folder, "--maniskill", out / "demos.h5"],
    }
    # Rescoring skips LeRobot datasets, and our recordings need their task, which takes seconds to open.
    if stem == "theirs" or (stem == "ours" and kind == "cut"):
        commands["rescore"] = ["rescore", folder, "--json", "--trust"]
    for name, command in commands.items():
        capsys.readouterr()
        code = exit_code(*command)
        printed = capsys.readouterr()
        assert code == 1, (name, printed)
        if name == "rescore":
            (row,) = [row for row in json.loads(printed.out) if row["damaged"]]
            assert stem in row["episode"] and stem in row["not_judged"] + row["not_carried"]
        else:
            assert stem in printed.err, (name, printed)
        if name != "share":
            assert not out.exists() or not any(out.rglob("*")), name
        shutil.rmtree(out, ignore_errors=True)


def test_the_other_recordings_of_the_folder_are_used(
    tmp_path: Path, recording: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, out = tmp_path / "recordings", tmp_path / "out"
    ours(recording, folder, "whole")
    halve(ours(recording, folder, "half").with_suffix(".h5"))
    halve(write_foreign(folder))
    assert exit_code("share", folder, "--sheet", "--out", out) == 1
    assert {path.name for path in out.iterdir()} == {"whole.sheet.png", "half.sheet.png"}
    printed = capsys.readouterr().err
    assert "half.h5" in printed and "theirs.h5" in printed and "whole" not in printed
    for option, made_of in (("--lerobot", out / "set"), ("--maniskill", out / "demos.h5")):
        assert exit_code("export", folder, option, made_of) == 1 and not made_of.exists()
        capsys.readouterr()
        # Skipped as requested, and named.
        assert exit_code("export", folder, option, made_of, "--only-fitting") == 0 and made_of.exists()
        printed = capsys.readouterr()
        assert "half.h5" in printed.err and "theirs.h5" in printed.err and "1 episode" in printed.out


@pytest.mark.slow
def test_a_file_name_that_is_not_utf_8_works(
    tmp_path: Path, recording: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, out = tmp_path / "recordings", tmp_path / "out"
    odd = os.fsdecode(b"od\xffd")
    ours(recording, folder, odd)
    theirs = write_foreign(folder)
    for suffix in (".h5", ".json"):
        shutil.copy(theirs.with_suffix(suffix), folder / f"by {odd}{suffix}")
    assert exit_code("share", folder / f"{odd}.json", "--sheet", "--html", "--out", out) == 0
    assert {path.name for path in out.iterdir()} == {f"{odd}.sheet.png", f"{odd}.html"}
    assert exit_code("export", folder / f"{odd}.h5", "--lerobot", out / "set") == 0
    for option, made_of in (("--lerobot", out / "sets"), ("--maniskill", out / "demos.h5")):
        capsys.readouterr()
        assert exit_code("export", folder, option, made_of, "--only-fitting") == 0
        printed = capsys.readouterr()
        assert "2 episodes" in printed.out and "od\\udcffd" in printed.err and "theirs" not in printed.err
    made_of = [source for source in find_all_sources([folder]) if source.part is None]
    (archive,) = make(MakeRequest("zip", tuple(made_of), out)).paths
    with zipfile.ZipFile(archive) as opened:
        assert sorted(opened.namelist()) == [f"od\\udcffd{suffix}" for suffix in (".h5", ".json", ".rrd")]
    table = tmp_path / "table"
    arguments = "--trust", "--workers", 2, "--num-envs", 1
    assert exit_code("rescore", folder, "--csv-file", table, "--json-file", f"{table}.json", *arguments) == 0
    names = [row["episode"] for row in json.loads(Path(f"{table}.json").read_text())]
    assert names == [f"by {odd}#traj_0", odd, "theirs#traj_0"]
    assert all(name in table.read_text() for name in ("by od\\udcffd#traj_0", "theirs#traj_0"))
    assert exit_code("record", "PickCube-v1", "--episodes", 1, "--out", tmp_path / odd) == 2
    assert not (tmp_path / odd).exists() and "UTF-8" in capsys.readouterr().err
