"""``workbench share`` and ``workbench export`` say in one sentence what is wrong: 1 for a damaged recording, 2 for a wrong request."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from tests.drive.episodes import made, write
from workbench.cli.main import main
from workbench.cli.share import export_in_terminal, share_in_terminal
from workbench.recording.lerobot.export import ExportOptions

pytestmark = pytest.mark.usefixtures("child_process")


def share(paths: list[Path], out: Path, **what: Any) -> int:
    asked = {"mp4": (), "html": False, "sheet": False, **what}
    return share_in_terminal(paths, asked["mp4"], asked["html"], asked["sheet"], out)


def test_what_cannot_be_shared_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "broken.json").write_text('{"workbench": {}}')
    (tmp_path / "broken.rrd").write_bytes(b"no recording")
    for path, what, says, code in (
        ("none", {"sheet": True}, "nothing at", 2),
        ("broken.rrd", {}, "--mp4", 2),
        ("broken.rrd", {"sheet": True}, "broken", 1),
    ):
        assert share([tmp_path / path], tmp_path, **what) == code
        assert says in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["broken.json", "broken.rrd"]


def test_one_that_is_broken_takes_no_other_along(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = write(tmp_path, made(5))
    (tmp_path / "broken.json").write_text('{"workbench": {}}')
    (tmp_path / "broken.rrd").write_bytes(b"no recording")
    assert share([tmp_path], tmp_path / "out", sheet=True) == 1
    assert [path.name for path in (tmp_path / "out").iterdir()] == [f"{whole.stem}.sheet.png"]
    said = [line for line in capsys.readouterr().err.splitlines() if line and "━" not in line]
    assert len(said) == 1 and said[0].startswith("broken")


def test_what_cannot_be_exported_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "broken.json").write_text('{"workbench": {}}')
    assert export_in_terminal([tmp_path], tmp_path / "set", ExportOptions()) == 1
    said = capsys.readouterr()
    assert said.err and not said.out and not (tmp_path / "set").exists()
    with pytest.raises(SystemExit) as ended:
        main(["export", str(tmp_path), "--lerobot", str(tmp_path / "set"), "--fps", "0"])
    assert ended.value.code == 2 and "--fps" in capsys.readouterr().err
