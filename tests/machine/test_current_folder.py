from __future__ import annotations

import os
from pathlib import Path

import pytest

from workbench.machine.folders import CurrentFolder


def test_one_comes_back_to_it_also_where_it_was_renamed(
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


def test_a_folder_that_the_block_goes_to_stays_unless_it_fails(
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
