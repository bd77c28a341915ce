"""The choices of code for rescoring recordings."""

from __future__ import annotations

from pathlib import Path

import pytest

from workbench.episodes.episode import EpisodeInfo
from workbench.rescore.recordings_panel import RECORDED, TODAYS, codes_for
from workbench.task.content import source_hash

TASK = '@register_env("Push-v1")\nclass Push(BaseEnv):\n    pass\n'


@pytest.fixture
def file(tmp_path: Path) -> Path:
    file = tmp_path / "push.py"
    file.write_text(TASK)
    return file


def recorded(file: Path | None, task: str = "Push-v1") -> EpisodeInfo:
    return EpisodeInfo(
        task=task,
        env_index=0,
        seed=1,
        source_file=None if file is None else str(file),
        source_hash="0a1b2c",
        source={} if file is None else {str(file): file.read_text()},
        control_dt=0.05,
        control_mode=None,
        backend="cpu",
    )


def test_the_file_that_a_recording_names_is_named(file: Path) -> None:
    todays, text = codes_for([recorded(file)], [file])
    assert (todays.label, text.label) == (TODAYS, RECORDED)
    assert f"{file}" in todays.source_text and todays.file is None and text.recorded
    held = source_hash({file.name: file.read_text()}, Path())
    assert f"(version {held})" in text.source_text, (
        "the version is that of the held text, whatever the recording claims"
    )
    assert "Push-v1 as a package registers it" in codes_for([recorded(None)], [])[0].source_text


def test_a_copy_with_that_task_is_a_choice_and_other_files_are_not(file: Path, tmp_path: Path) -> None:
    copy, other = tmp_path / "mine" / "push.py", tmp_path / "other.py"
    copy.parent.mkdir()
    copy.write_text(TASK)
    other.write_text(TASK.replace("Push", "Pull"))
    found = codes_for([recorded(file)], [file, copy, other, tmp_path / "gone.py"])
    assert [(code.label, code.file) for code in found[2:]] == [("push.py", copy)]
    assert str(copy) in found[2].source_text


def test_for_unopened_recordings_every_known_file_is_a_choice(file: Path) -> None:
    assert [code.file for code in codes_for([], [file])[2:]] == [file]
