"""The ``.json`` of a recording: what is read of it, what is refused with its path, and what is written."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.recording.library_files import describe
from tests.ui.scenes import camera
from workbench.core.camera_data import CameraInfo
from workbench.recording.episode.document import (
    CameraJson,
    Checksum,
    Document,
    EpisodeJson,
    WrongDocument,
    as_json,
    read_document,
    read_json,
    task_file,
)
from workbench.recording.episode.episode import Seal


def said(tmp_path: Path, **fields: Any) -> Document:
    return read_document(describe(tmp_path, "a", **fields))


def why(document: Document) -> str:
    with pytest.raises(WrongDocument) as told:
        document.description()
    return str(told.value)


@pytest.mark.parametrize(
    ("content", "is_ours", "is_maniskill"),
    [
        ('{"workbench": {}, "episodes": []}', True, True),
        ('{"workbench": [], "episodes": {}}', False, False),
        ("{}", False, False),
        ("[1]", False, False),
        ("NaN", False, False),
    ],
)
def test_whose_it_is_is_told_by_its_keys(
    tmp_path: Path, content: str, is_ours: bool, is_maniskill: bool
) -> None:
    (tmp_path / "a.json").write_text(content)
    document = read_document(tmp_path / "a.json")
    assert (document.is_ours, document.is_maniskill) == (is_ours, is_maniskill)


@pytest.mark.parametrize(
    ("wrong", "at"),
    [
        ({"seed": "three"}, "expected `int | null`, got `str` at $.workbench.seed"),
        ({"seed": 2**63}, "expected `int` <= 9223372036854775807 at $.workbench.seed"),
        ({"length": -(2**63) - 1}, "expected `int` >= -9223372036854775808 at $.workbench.length"),
        ({"scene": {}}, "object missing required field `body_names` at $.workbench.scene"),
        ({"control_dt": 10**400}, "number out of range at $.workbench.control_dt"),
    ],
)
def test_what_is_of_another_type_is_named_by_its_path(tmp_path: Path, wrong: Any, at: str) -> None:
    told = why(said(tmp_path, **wrong))
    assert told.startswith("is not as a recording is described: ") and told.endswith(at), told


def test_what_may_lack_is_not_there_and_what_is_there_is_said(tmp_path: Path) -> None:
    plain = said(tmp_path).description()
    assert (plain.format, plain.side_files, plain.acted_by, plain.batch, plain.texts) == (1, {}, (), {}, {})
    info = plain.info()
    assert info.seal is None and info.source_file == "push_cube.py"
    assert info.source == {"push_cube.py": "class Task: ...\n"}
    files = {".h5": {"bytes": 3, "xxh3_128": "ab"}}
    full = said(tmp_path, files=files, made_here={"content": "c", "place": "p"}, source=None).description()
    assert full.files == {".h5": Checksum(3, "ab")}
    assert full.info().seal == Seal("c", "p", "push_cube.py", files) and full.info().source == {}
    assert said(tmp_path, made_here=None).description().info().seal is None
    without = said(tmp_path, made_here={"content": "c", "place": "p"}).description().info().seal
    assert without is not None and without.files == {}


def test_the_tasks_own_file_is_looked_for_from_the_recordings_folder(tmp_path: Path) -> None:
    (tmp_path / "tasks").mkdir()
    task = tmp_path / "tasks" / "push_cube.py"
    task.write_text("PushCube-v1")
    described = said(tmp_path / "recordings", source_path="../tasks/push_cube.py").description()
    assert described.info(tmp_path / "recordings").source_file == str(task)
    assert described.info().source_file == "push_cube.py"
    unsaid = said(tmp_path / "recordings").description()
    assert unsaid.info(tmp_path / "recordings").source_file == "push_cube.py"


@pytest.mark.parametrize(
    ("words", "seed"),
    [
        ({"episode_seed": 7, "reset_kwargs": {"seed": 8}}, 7),
        ({"episode_seed": 0, "reset_kwargs": {"seed": 8}}, 0),
        ({"episode_seed": [9, 10]}, 9),
        ({"episode_seed": []}, None),
        ({"reset_kwargs": {"seed": [5, 6], "options": {}}}, 5),
        ({"reset_kwargs": {}}, None),
        ({}, None),
    ],
)
def test_a_seed_of_maniskills_is_where_it_is_said(words: dict[str, Any], seed: int | None) -> None:
    document = Document({"episodes": [{"episode_id": 1}, {"episode_id": 4, **words}]})
    assert document.episode(0) == EpisodeJson(1)
    assert (document.episode(1).episode_id, document.episode(1).seed) == (4, seed)


def test_what_is_no_json_or_too_long_or_no_file_is_said(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    for content in ('{"a": 1', "[" * 100_000, "", b"\xff\xfe\xfa"):
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        with pytest.raises(WrongDocument, match="is not JSON, or was cut short"):
            read_document(path)
    with path.open("wb") as file:
        file.truncate(64 << 20)  # with nothing in it: it takes no place on the disk
    with pytest.raises(WrongDocument, match="is not JSON"):
        read_document(path)
    with path.open("ab") as file:
        file.truncate((64 << 20) + 1)
    with pytest.raises(WrongDocument, match="^is longer than 64 MB$"):
        read_document(path)
    with pytest.raises(WrongDocument, match="^is longer than 3 MB$"):
        read_json(path, 3 << 20)
    path.unlink()
    os.mkfifo(path)
    with pytest.raises(WrongDocument, match="^is a named pipe, not a regular file$"):
        read_document(path)
    with pytest.raises(FileNotFoundError):
        read_document(tmp_path / "none.json")


def test_a_camera_comes_back_from_its_words() -> None:
    info = replace(
        camera("hand", "human"),
        fovy=0.75,
        near=0.5,
        far=7.0,
        mount="panda/hand",
        intrinsic=np.arange(9, dtype=np.float32).reshape(3, 3),
        replaced_shader="rt",
    )
    words = CameraJson.of(info)
    assert as_json(words) == {
        "name": "hand",
        "kind": "human",
        "width": 8,
        "height": 6,
        "fovy": 0.75,
        "near": 0.5,
        "far": 7.0,
        "intrinsic": [[0.0, 1.0, 2.0], [3.0, 4.0, 5.0], [6.0, 7.0, 8.0]],
        "mount": "panda/hand",
        "modalities": ["rgb", "depth", "segmentation"],
        "replaced_shader": "rt",
    }
    again = words.info()
    assert isinstance(again, CameraInfo) and again.intrinsic.dtype == np.float32
    np.testing.assert_array_equal(again.intrinsic, info.intrinsic)
    same = replace(again, intrinsic=info.intrinsic)
    assert same == info


# --- the task's own file ---------------------------------------------------------------------------


@pytest.fixture
def moved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of a recording that was copied into somebody's project, which is not where one looks from."""
    folder = tmp_path / "project" / "shared" / "recordings"
    folder.mkdir(parents=True)
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    return folder


def put(path: Path, text: str = '@register_env("Push-v1")') -> str:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return str(path)


def test_where_the_path_leads_it_need_not_name_the_task(moved: Path) -> None:
    there = put(moved.parent / "a.txt", "something else")
    assert task_file("../a.txt", "Push-v1", moved) == there
    assert task_file(None, "Push-v1", moved) is None and task_file("", "Push-v1", moved) is None


def test_the_longest_end_of_the_path_that_names_the_task_is_found_above_the_recording(moved: Path) -> None:
    path = "../../me/code/tasks/push.py"
    assert task_file(path, "Push-v1", moved) is None
    short = put(moved.parent / "push.py")
    assert task_file(path, "Push-v1", moved) == short
    longer = put(moved.parent / "tasks" / "push.py")
    assert task_file(path, "Push-v1", moved) == longer
    put(Path(longer), "another task")
    assert task_file(path, "Push-v1", moved) == short
    here = put(Path.cwd() / "tasks" / "push.py")
    assert task_file(path, "Push-v1", moved) == here, "where one looks from comes first"


# --- checksums -------------------------------------------------------------------------------------
