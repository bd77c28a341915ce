"""Exports in the same folder as their source recordings."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.drive.episodes import made, write
from tests.drive.panels import Panels
from workbench.cli.main import main
from workbench.library.folder import Library
from workbench.library.panel import LibraryPanel


@pytest.mark.usefixtures("child_process")
def test_an_export_counts_as_no_new_recording_and_shows_its_sources_facts(
    tmp_path: Path, panels: Panels
) -> None:
    write(tmp_path, made(10, success_from=7, seed=1))
    write(tmp_path, made(6, seed=-1))
    for option, out in (("--lerobot", tmp_path / "set"), ("--maniskill", tmp_path / "demos.h5")):
        with pytest.raises(SystemExit) as ended:
            main(["export", *map(str, tmp_path.glob("Push*.json")), option, str(out)])
        assert not ended.value.code
    library = Library(tmp_path)
    library.refresh()
    rows = library.view().rows
    assert len(rows) == 6 and not any(row.problem for row in rows)
    assert sorted(str(row.seed) for row in rows) == ["1", "1", "1", "None", "None", "None"]
    pictures = library.thumbnails([row.id for row in rows])
    by_steps = {length: {pictures[row.id] for row in rows if row.length == length} for length in (10, 6)}
    assert all(len(alike) == 1 for alike in by_steps.values()) and by_steps[10] != by_steps[6]
    panel = LibraryPanel(panels.server, library, lambda ids: None)
    panel.draw()
    text = re.sub(r"<[^>]*>", " ", panels.html("wb-library-pills"))
    assert re.findall(r"(all|no success|success) (\d+)", text) == [
        ("all", "2"),
        ("success", "1"),
        ("no success", "1"),
    ]
    assert len(re.findall("export", panels.html('wb-library"'))) == 4
    library.close()
