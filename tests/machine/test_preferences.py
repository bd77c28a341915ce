"""The user's choices that are stored between runs."""

from __future__ import annotations

from pathlib import Path

import pytest

from workbench.machine.folders import read_private, user_folder, write_private
from workbench.machine.preferences import (
    FILE,
    MAX_FOLDERS,
    MAX_POLICIES,
    Preferences,
    close_hints,
    keep_check_after_save,
    keep_policy,
    preferences,
    used_policies,
)


@pytest.fixture(autouse=True)
def own_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))


def test_policies_are_stored_by_folder_newest_first() -> None:
    here, there = Path("/home/me/lab"), Path("/home/me/other")
    for reference in ("a.py:act", "b.py:act", "a.py:act"):
        keep_policy(here, reference)
    keep_policy(there, "c.py:act")
    assert used_policies(here) == ("a.py:act", "b.py:act")
    assert used_policies(there) == ("c.py:act",) and used_policies(Path("/")) == ()


def test_stored_choices_are_bounded() -> None:
    for number in range(MAX_FOLDERS + 5):
        keep_policy(Path(f"/{number}"), "a.py:act")
    for number in range(MAX_POLICIES + 5):
        keep_policy(Path("/last"), f"{number}.py:act")
    kept = preferences().policies
    assert len(kept) == MAX_FOLDERS and "/0" not in kept
    assert len(kept["/last"]) == MAX_POLICIES and kept["/last"][0] == f"{MAX_POLICIES + 4}.py:act"


@pytest.mark.parametrize("content", [b"", b"[]", b'{"hints_closed": 3}', b"\xff", b"[" * 100_000])
def test_a_corrupt_file_gives_defaults_and_is_logged(
    content: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    write_private(FILE, content)
    assert not preferences().hints_closed
    assert [one.levelname for one in caplog.records] == ["WARNING"]
    close_hints()
    assert preferences().hints_closed


def test_a_failed_write_is_logged_and_not_raised(caplog: pytest.LogCaptureFixture) -> None:
    close_hints()
    user_folder().chmod(0o777)
    before = (user_folder() / FILE).read_bytes()
    keep_policy(Path("/lab"), "a.py:act")
    assert [one.levelname for one in caplog.records] == ["WARNING"]
    user_folder().chmod(0o700)
    assert read_private(FILE) == before


def test_each_choice_is_stored_and_keeps_the_others() -> None:
    assert preferences() == Preferences(hints_closed=False, check_after_save=True, policies={})
    keep_policy(Path("/lab"), "a.py:act")
    close_hints()
    for wanted in (False, True, False):
        keep_check_after_save(wanted)
        assert preferences() == Preferences(True, wanted, {"/lab": ["a.py:act"]})
