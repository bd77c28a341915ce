"""Edits on real files are applied completely or not at all; encoding, line ends and mode are kept."""

from __future__ import annotations

import dataclasses
import errno
import os
import stat
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.cameras.edit.real_cameras import FILE, real_settings, run_class
from tests.cameras.edit.shapes import WRITTEN
from workbench.cameras.edit.plan import plan_edit
from workbench.source.parsed import RefusedEdit, plain_line_ends
from workbench.task.modules import exact_text
from workbench.task.write_edits import FileChange, SourceEdit, apply, revert

SOURCE = WRITTEN["one argument per line, with comments"]


def planned(path: Path) -> SourceEdit:
    text, _ = exact_text(str(path), path.read_bytes())
    before = real_settings({FILE: SOURCE}, "cam")
    after = dataclasses.replace(before, fov=0.9, near=0.05, shader_pack="default")
    plan = plan_edit({str(path): text}, ("sensor", "cam"), before, after, run_class)
    assert isinstance(plan, SourceEdit), plan
    return plan


def refusal(do: Callable[[SourceEdit], None], edit: SourceEdit) -> str:
    with pytest.raises(RefusedEdit) as caught:
        do(edit)
    return caught.value.reason


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "latin-1"])
@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_line_ends_encoding_and_mode_are_kept(tmp_path: Path, encoding: str, end: str) -> None:
    path = tmp_path / "task.py"
    head = "# -*- coding: latin-1 -*-\n" if encoding == "latin-1" else ""
    old = f"{head}# Größe\n{SOURCE}".replace("\n", end).encode(encoding)
    path.write_bytes(old)
    path.chmod(0o640)
    edit = planned(path)
    apply(edit)
    assert path.read_bytes() == edit.new_text.encode(encoding) != old
    assert edit.new_text == plain_line_ends(edit.new_text).replace("\n", end)
    assert stat.S_IMODE(path.stat().st_mode) == 0o640
    revert(edit)
    assert path.read_bytes() == old
    assert os.listdir(tmp_path) == ["task.py"]


def test_a_read_only_file_is_not_edited_even_by_root(tmp_path: Path) -> None:
    path = tmp_path / "task.py"
    path.write_text(SOURCE)
    path.chmod(0o444)
    assert "read-only" in refusal(apply, planned(path))
    assert path.read_text() == SOURCE


def test_two_files_are_changed_together_or_not_at_all(tmp_path: Path) -> None:
    one, other = tmp_path / "one.py", tmp_path / "other.py"
    one.write_text("a = 1\n")
    other.write_text("b = 1\n")
    edit = SourceEdit(
        str(one), "a = 1\n", "a = 2\n", (), None, (FileChange(str(other), "b = 1\n", "b = 2\n"),)
    )
    apply(edit)
    assert (one.read_text(), other.read_text()) == ("a = 2\n", "b = 2\n")
    revert(edit)
    assert (one.read_text(), other.read_text()) == ("a = 1\n", "b = 1\n")
    other.write_text("b = 3\n")
    before = one.stat().st_ctime_ns
    assert "other.py was edited" in refusal(apply, edit)
    assert (one.read_text(), other.read_text()) == ("a = 1\n", "b = 3\n")
    assert one.stat().st_ctime_ns == before, "it must not be written and then restored"


def test_a_file_changed_meanwhile_is_not_edited(tmp_path: Path) -> None:
    path = tmp_path / "task.py"
    path.write_text(SOURCE)
    edit = planned(path)
    path.write_text(SOURCE + "# more\n")
    assert "was edited since the change was shown" in refusal(apply, edit)
    assert path.read_text() == SOURCE + "# more\n"
    path.write_text(SOURCE)
    apply(edit)
    path.write_text(path.read_text() + "# more\n")
    assert "was edited since" in refusal(revert, edit)
    assert path.read_text() == edit.new_text + "# more\n"


def test_a_link_to_the_file_stays_a_link(tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    path, link = tmp_path / "real" / "task.py", tmp_path / "task.py"
    path.write_text(SOURCE)
    link.symlink_to(path)
    edit = planned(link)
    apply(edit)
    assert link.is_symlink() and path.read_text() == edit.new_text


def test_an_installed_file_is_not_edited_through_a_link(tmp_path: Path) -> None:
    path = tmp_path / "site-packages" / "tasks" / "task.py"
    path.parent.mkdir(parents=True)
    path.write_text(SOURCE)
    (tmp_path / "task.py").symlink_to(path)
    assert "installed" in refusal(apply, planned(tmp_path / "task.py"))
    assert path.read_text() == SOURCE


def test_a_save_during_the_edit_is_not_lost(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "task.py"
    path.write_text(SOURCE)
    edit = planned(path)
    sync = os.fsync

    def saved_meanwhile(descriptor: int) -> None:
        sync(descriptor)
        path.write_text(SOURCE + "# more\n")

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", saved_meanwhile)
        assert "saved by another program just now" in refusal(apply, edit)
    assert path.read_text() == SOURCE + "# more\n"
    assert os.listdir(tmp_path) == ["task.py"]


@pytest.mark.parametrize(
    ("call", "number"),
    [("fsync", errno.ENOSPC), ("replace", errno.EIO), ("chmod", errno.EROFS), ("chown", errno.EIO)],
)
def test_a_failed_edit_leaves_the_file_unchanged_and_no_other_file(
    tmp_path: Path, call: str, number: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "task.py"
    path.write_text(SOURCE)
    edit = planned(path)
    with monkeypatch.context() as patch:
        patch.setattr(os, call, failing(number))
        for _ in range(2):
            assert os.strerror(number) in refusal(apply, edit)
    assert path.read_text() == SOURCE and os.listdir(tmp_path) == ["task.py"]
    apply(edit)
    assert path.read_text() == edit.new_text
    with monkeypatch.context() as patch:
        patch.setattr(os, call, failing(number))
        assert refusal(revert, edit)
    assert path.read_text() == edit.new_text and os.listdir(tmp_path) == ["task.py"]


@pytest.mark.parametrize("taken_back", [True, False])
def test_the_first_of_two_files_is_restored_when_the_second_fails(
    tmp_path: Path, taken_back: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    one, other = tmp_path / "one.py", tmp_path / "other.py"
    one.write_text("a = 1\n")
    other.write_text("b = 1\n")
    edit = SourceEdit(
        str(one), "a = 1\n", "a = 2\n", (), None, (FileChange(str(other), "b = 1\n", "b = 2\n"),)
    )
    calls, replace = [], os.replace

    def fail_later(source: str, target: Path) -> None:
        calls.append(target.name)
        if target == other or (len(calls) > 1 and not taken_back):
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        replace(source, target)

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", fail_later)
        refused = refusal(apply, edit)
    assert calls == ["one.py", "other.py", "one.py"]
    assert "other.py cannot be written" in refused
    assert ("one.py could not be restored" in refused) is not taken_back
    assert one.read_text() == ("a = 1\n" if taken_back else "a = 2\n")
    assert other.read_text() == "b = 1\n" and sorted(os.listdir(tmp_path)) == ["one.py", "other.py"]


def failing(number: int) -> Callable[..., None]:
    def fail(*_: object, **__: object) -> None:
        raise OSError(number, os.strerror(number))

    return fail
