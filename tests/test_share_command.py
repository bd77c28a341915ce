"""``workbench share`` and ``workbench export`` say in one sentence what is wrong, and exit with 2."""

from __future__ import annotations

import io
from pathlib import Path

import pytest
from rich.console import Console

from tests.drive.episodes import made, write
from workbench.share_command import export_in_terminal, share_in_terminal

pytestmark = pytest.mark.usefixtures("child_process")


@pytest.fixture
def said() -> list[str]:
    return []


def share(paths: list[Path], said: list[str], out: Path, **what: object) -> int:
    asked = {"mp4": (), "html": False, "sheet": False, **what}

    def refuse(message: str) -> int:
        said.append(message)
        return 2

    return share_in_terminal(
        paths, asked["mp4"], asked["html"], asked["sheet"], out, Console(file=io.StringIO()), refuse
    )  # type: ignore[arg-type]


def test_what_cannot_be_shared_is_said(tmp_path: Path, said: list[str]) -> None:
    (tmp_path / "broken.json").write_text('{"workbench": {}}')
    (tmp_path / "broken.rrd").write_bytes(b"no recording")
    assert share([tmp_path / "none"], said, tmp_path, sheet=True) == 2
    assert share([tmp_path / "broken.rrd"], said, tmp_path) == 2
    assert share([tmp_path / "broken.rrd"], said, tmp_path, sheet=True) == 2
    assert "nothing at" in said[0] and "--mp4" in said[1] and "broken" in said[2]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["broken.json", "broken.rrd"]


def test_one_that_is_broken_takes_no_other_along(tmp_path: Path, said: list[str]) -> None:
    whole = write(tmp_path, made(5))
    (tmp_path / "broken.json").write_text('{"workbench": {}}')
    (tmp_path / "broken.rrd").write_bytes(b"no recording")
    assert share([tmp_path], said, tmp_path / "out", sheet=True) == 2
    assert [path.name for path in (tmp_path / "out").iterdir()] == [f"{whole.stem}.sheet.png"]
    assert len(said) == 1 and said[0].startswith("broken")


def test_what_cannot_be_exported_is_said(
    tmp_path: Path, said: list[str], capsys: pytest.CaptureFixture
) -> None:
    def refuse(message: str) -> int:
        said.append(message)
        return 2

    err = Console(file=io.StringIO())
    (tmp_path / "broken.json").write_text('{"workbench": {}}')
    for fps in (0, None):
        code = export_in_terminal(
            [tmp_path], tmp_path / "set", False, False, None, fps, None, (), (), err, refuse
        )
        assert code == 2
    assert "--fps" in said[0] and said[1]
    assert not (tmp_path / "set").exists() and capsys.readouterr().out == ""
