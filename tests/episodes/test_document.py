"""The ``.json`` of a recording: which fields are read, which are refused with their path, and what is written."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

import pytest

from tests.episodes.library_files import describe
from workbench.episodes.document import (
    Document,
    EpisodeJson,
    WrongDocument,
    read_document,
    read_json,
    task_file,
)


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
def test_the_keys_of_a_document_tell_which_program_wrote_it(
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
def test_a_field_of_the_wrong_type_is_named_by_its_path(tmp_path: Path, wrong: Any, at: str) -> None:
    document = read_document(describe(tmp_path, "a", **wrong))
    with pytest.raises(WrongDocument, match=f"^is not in the format of a recording: .*{re.escape(at)}$"):
        document.description()


@pytest.mark.parametrize(
    ("words", "seed"),
    [
        ({"episode_seed": 7, "reset_kwargs": {"seed": 8}}, 7),
        ({"episode_seed": 0, "reset_kwargs": {"seed": 8}}, 0),
        ({"episode_seed": [9, 10]}, 9),
        ({"reset_kwargs": {"seed": [5, 6], "options": {}}}, 5),
        ({}, None),
    ],
)
def test_the_seed_of_a_maniskill_episode_is_found_in_each_place_that_may_hold_it(
    words: dict[str, Any], seed: int | None
) -> None:
    document = Document({"episodes": [{"episode_id": 1}, {"episode_id": 4, **words}]})
    assert document.episode(0) == EpisodeJson(1)
    assert (document.episode(1).episode_id, document.episode(1).seed) == (4, seed)


def test_invalid_json_oversized_files_and_pipes_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    for content in ('{"a": 1', "[" * 100_000, "", b"\xff\xfe\xfa"):
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        with pytest.raises(WrongDocument, match="is not JSON, or was cut short"):
            read_document(path)
    with path.open("wb") as file:
        file.truncate(64 << 20)  # sparse: it takes no space on the disk
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


# --- the task's own file ---------------------------------------------------------------------------


@pytest.fixture
def moved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of a recording that was copied into another project; the search starts in another folder."""
    folder = tmp_path / "project" / "shared" / "recordings"
    folder.mkdir(parents=True)
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    return folder


def put(path: Path, text: str = '@register_env("Push-v1")') -> str:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return str(path)


def test_the_task_file_with_the_longest_matching_path_above_the_recording_is_found(moved: Path) -> None:
    path = "../../me/code/tasks/push.py"
    assert task_file(path, "Push-v1", moved) is None
    short = put(moved.parent / "push.py")
    assert task_file(path, "Push-v1", moved) == short
    longer = put(moved.parent / "tasks" / "push.py")
    assert task_file(path, "Push-v1", moved) == longer
    put(Path(longer), "another task")
    assert task_file(path, "Push-v1", moved) == short
    beside = put(moved / "push.py")
    assert task_file(path, "Push-v1", moved) == beside
    here = put(Path.cwd() / "tasks" / "push.py")
    assert task_file(path, "Push-v1", moved) == here, "the folder where the search starts comes first"
    put(moved / "notes.txt")
    assert task_file("../../me/notes.txt", "Push-v1", moved) is None, "it is no program"
    assert task_file("d/" * 40 + "push.py", "Push-v1", moved) is None, "it has too many parts to search for"
    assert task_file("d/" * 39 + "push.py", "Push-v1", moved) == beside
    given = put(moved.parent / "given.py", "of any content")
    assert task_file("../given.py", "Push-v1", moved) == given, "the recorded path itself is believed"
    assert task_file(None, "Push-v1", moved) is task_file("", "Push-v1", moved) is None
