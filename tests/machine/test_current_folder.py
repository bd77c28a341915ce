from __future__ import annotations

import os
from pathlib import Path

import pytest

from workbench.machine.folders import CurrentFolder


def test_again_returns_to_the_folder_even_after_a_rename(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "one").mkdir()
    (tmp_path / "two").mkdir()
    monkeypatch.chdir(tmp_path / "one")
    folder = CurrentFolder()
    os.chdir(tmp_path / "two")
    (tmp_path / "one").rename(tmp_path / "other")
    with folder.again():
        assert Path.cwd() == tmp_path / "other"
        os.chdir("/")
    assert Path.cwd() == tmp_path / "two"


def test_with_stay_the_blocks_folder_is_kept_unless_it_raises(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "one").mkdir()
    monkeypatch.chdir(tmp_path)
    folder = CurrentFolder()
    with folder.again(stay=True):
        os.chdir("one")
    assert Path.cwd() == tmp_path / "one"
    with pytest.raises(ValueError), folder.again(stay=True):
        os.chdir("/")
        raise ValueError
    assert Path.cwd() == tmp_path / "one"


def test_no_descriptor_is_left_open() -> None:
    before = len(os.listdir("/proc/self/fd"))
    for _ in range(10):
        with CurrentFolder().again():
            pass
    assert len(os.listdir("/proc/self/fd")) == before
