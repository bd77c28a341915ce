"""Pictures of two versions held against each other: what is said, what is left, how it ends."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.browser.tab_pictures import compare


@pytest.fixture
def folders(tmp_path: Path) -> tuple[Path, Path]:
    """The same picture and text in both."""
    pixels = np.random.default_rng(0).integers(0, 255, (40, 50, 3), np.uint8)
    for name in ("old", "new"):
        (tmp_path / name).mkdir()
        Image.fromarray(pixels).save(tmp_path / name / "live-run.png")
        (tmp_path / name / "live-run.txt").write_text("Play\nStep\n")
    return tmp_path / "old", tmp_path / "new"


def paint(path: Path, rows: int, by: int) -> None:
    """Every pixel of so many rows is another by so much in one channel."""
    pixels = np.asarray(Image.open(path)).astype(int)
    pixels[:rows, :, 1] += np.where(pixels[:rows, :, 1] > 127, -by, by)
    Image.fromarray(pixels.astype(np.uint8)).save(path)


def test_the_same_twice_differs_nowhere(
    folders: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    paint(folders[1] / "live-run.png", 40, 5)  # less than anybody sees
    assert compare(*folders, tmp_path / "out", 0.0) == 0
    assert "0.000%" in capsys.readouterr().out and not (tmp_path / "out").exists()


def test_a_share_is_told_and_ends_with_1_only_above_what_is_allowed(
    folders: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    paint(folders[1] / "live-run.png", 4, 100)
    (folders[1] / "live-run.txt").write_text("Play\nStep on\n")
    assert compare(*folders, tmp_path / "out", 0.11) == 0
    assert compare(*folders, tmp_path / "out", 0.09) == 1
    said = capsys.readouterr().out
    assert "10.000%" in said and "-Step" in said and "+Step on" in said
    sheet = np.asarray(Image.open(tmp_path / "out" / "live-run.png"))
    assert sheet.shape == (40, 150, 3)
    marked = (sheet[:, 100:] == (255, 0, 0)).all(axis=2)
    assert marked[:4].all() and not marked[4:].any()


def test_a_picture_of_another_size_or_of_one_folder_alone_is_another(
    folders: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    picture = Image.open(folders[1] / "live-run.png")
    picture.crop((0, 0, 50, 30)).save(folders[1] / "live-run.png")
    assert compare(*folders, None, 0.2) == 1 and "25.000%" in capsys.readouterr().out
    (folders[1] / "live-run.png").rename(folders[1] / "live-log.png")
    assert compare(*folders, None, 1.0) == 1
    assert capsys.readouterr().out.count("is not in") == 2
