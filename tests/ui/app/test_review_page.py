"""The review's page on a real server and real files, drawn without a browser."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import viser

from tests.drive.episodes import made, write
from tests.drive.panels import Clock, Panels
from tests.drive.waiting import until
from tests.recording.sweep_files import sweep_folder
from workbench.jobs.task import TaskOptions
from workbench.recording.episode.columns import TextEntry
from workbench.recording.library.library import Library
from workbench.session.live.session import Session
from workbench.session.review.review import Review
from workbench.ui.app.review_page import ReviewPage, walk
from workbench.ui.app.workplace import Workplace
from workbench.ui.review.panel import GHOSTS, GO_LIVE, TRY_AGAIN
from workbench.ui.review.scene import MOST_NAMED
from workbench.ui.server.gated_server import GatedServer


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recordings")
    write(folder, made(10, success_from=7, seed=1))
    write(folder, made(6, seed=2, speed=0.03, source_hash="1" * 12, source={"push.py": "reward = 2\n"}))
    return folder


@dataclass
class Shown:
    """The review on a page."""

    page: ReviewPage
    review: Review
    library: Library
    panels: Panels
    clock: Clock

    def draw(self) -> None:
        self.clock.passes()
        self.page.redraw()

    def open(self, *seeds: int) -> None:
        rows = {-1 if row.seed is None else row.seed: row.id for row in self.library.view().rows}
        self.review.open([rows[seed] for seed in seeds])
        until(
            lambda: len(self.review.view().opened) == len(seeds) and not self.review.view().loading,
            "what was opened",
            seen=lambda: self.review.view().problems,
        )
        self.draw()

    def chart(self, title: str) -> viser.GuiUplotHandle:
        (chart,) = (chart for chart in self.panels.part("Curves").charts() if chart.title == title)
        return chart


@pytest.fixture
def server(gated_server: GatedServer) -> viser.ViserServer:
    return gated_server.server


def no_session(task: object, options: object) -> Session:
    raise AssertionError("nobody goes live from a recording")


@pytest.fixture
def shown(
    child_process: None, folder: Path, gated_server: GatedServer, panels: Panels, clock: Clock
) -> Iterator[Shown]:
    place = Workplace(gated_server, folder, no_session, TaskOptions())
    place.shelf.library.refresh()
    yield Shown(ReviewPage(place, clock=clock), place.shelf.review, place.shelf.library, panels, clock)
    place.close()


SLIDER = "step of the timeline"


def test_the_results_of_a_sweep_have_a_tab_also_if_they_come_later(
    child_process: None, gated_server: GatedServer, panels: Panels, clock: Clock, tmp_path: Path
) -> None:
    write(tmp_path, made(4, seed=1))
    place = Workplace(gated_server, tmp_path, no_session, TaskOptions())
    place.shelf.library.refresh()
    page = ReviewPage(place, clock=clock)
    clock.passes()
    page.redraw()
    assert "reach_weight" not in panels.html()
    sweep_folder(tmp_path)

    def has_points() -> bool:
        clock.passes()
        page.redraw()
        return "reach_weight" in panels.part("Sweep").html()

    until(has_points, "the points")
    place.close()


def test_an_opened_recording_fills_every_part(shown: Shown) -> None:
    shown.open(1)
    cube = shown.panels.bodies("cube")[0]
    assert np.allclose(cube.batched_positions[:, 0], 0.0)
    shown.review.seek(7)
    shown.draw()
    shown.draw()  # the Cameras tab has asked for its pictures meanwhile
    assert np.allclose(cube.batched_positions[:, 0], 0.07)
    assert shown.panels.control(SLIDER).max == 10 and shown.panels.control(SLIDER).value == 7
    assert "step 7 / 10" in shown.panels.html("wb-timeline") and "success" in shown.panels.html("wb-timeline")
    assert "success" in shown.panels.part("Curves").html("wb-numbers")
    assert shown.chart("reward")
    image = shown.panels.part("Cameras").images()[0]
    assert abs(int(np.asarray(image.image).mean()) - 140) <= 3
    assert shown.panels.shows(GO_LIVE) and not shown.panels.shows("Layout")
    assert "open two" in shown.panels.part("Compare").html().lower()


def test_two_recordings_are_compared_and_aligned(shown: Shown, monkeypatch: pytest.MonkeyPatch) -> None:
    shown.open(1, 2)
    assert shown.panels.control("Layout").value == GHOSTS and shown.panels.shows("Layout")
    shown.review.seek(5)
    shown.draw()
    ghost = shown.panels.bodies("cube")
    assert sorted(float(h.batched_positions[0, 0]) for h in ghost if h.visible) == pytest.approx([0.05, 0.15])
    assert "They diverge at step 1" in shown.panels.part("Compare").html()
    assert "reward = 2" in shown.panels.part("Compare").html()
    assert len(shown.chart("reward").series) == 4, "step, two lines and the dot"
    shown.panels.command("Overlaid or side by side")
    shown.draw()
    (cubes,) = shown.panels.bodies("cube")
    assert len(cubes.batched_positions) == 2 and sorted(shown.panels.labels()) == ["A, seed 1", "B"]
    (name,) = shown.panels.nodes("/names")
    away = np.linalg.norm(cubes.batched_positions - name.position, axis=1)
    assert away[1] < away[0], "at its own place"
    shown.review.select(1)
    shown.draw()
    assert sorted(shown.panels.labels()) == ["A", "B, seed 2"]
    shown.review.select(0)
    shown.review.align("first success")
    shown.draw()
    assert "B has no success" in shown.panels.part("Review").html()
    assert shown.panels.control(SLIDER).min == -7


def test_what_could_not_be_read_is_tried_again_with_a_press(shown: Shown, folder: Path) -> None:
    write(folder, made(4, seed=3))
    shown.library.refresh()
    (row,) = (row for row in shown.library.view().rows if row.seed == 3)
    files = {path: path.read_bytes() for path in row.paths}
    for path in files:
        path.write_bytes(b"cut off")
    shown.review.open([row.id])
    until(lambda: not shown.review.view().loading, "that it cannot be read")
    shown.draw()
    assert "was not opened" in shown.panels.part("Review").html() and shown.panels.shows(TRY_AGAIN)
    for path, content in files.items():
        path.write_bytes(content)
    shown.panels.press(TRY_AGAIN)
    until(
        lambda: len(shown.review.view().opened) == 1,
        "the recording",
        seen=lambda: shown.review.view().problems,
    )
    until(lambda: not shown.review.view().loading, "the end of it")
    shown.draw()
    assert not shown.panels.shows(TRY_AGAIN)
    for path in files:
        path.unlink()
    shown.library.refresh()


def strip_of(shown: Shown) -> dict[str, list[tuple[str, ...]]]:
    """What the strip draws: extents of recordings, marks, and upright lines, with their places in per cent."""
    html = shown.panels.html("wb-timeline")
    extent = r'wb-length" style="left:([-\d.]+)%;width:([-\d.]+)%;background:(#\w+)"'
    mark = r'wb-mark wb-mark-(\w+)" style="left:([-\d.]+)%" data-at="-?\d+" title="([^"]*)"'
    return {
        "extents": re.findall(extent, html),
        "marks": re.findall(mark, html),
        "lines": re.findall(r'<line x1="([-\d.]+)" x2="\1" [^>]*class="([\w -]+)"', html),
        "bands": re.findall(r'<rect x="([-\d.]+)" y="-14" width="([-\d.]+)"', html),
        "legend": re.findall(r'wb-key wb-mark-(\w+)"></i>([^<]*)<', html),
    }


def test_the_strip_has_each_recording_where_it_is_aligned(shown: Shown) -> None:
    shown.open(1)
    shown.review.seek(7)
    shown.draw()
    strip = strip_of(shown)
    assert strip["marks"] == [("success", "70.0", " success, step 7")] and strip["extents"] == []
    assert strip["legend"] == [("success", "success")] and strip["bands"] == [("0.0", "100.0")]
    assert strip["lines"] == [("70.0", "wb-cursor wb-past")]
    html = shown.panels.html("wb-timeline")
    assert ">step 7 / 10, 0.35 s<" in html and '<span class="wb-num">success</span>' in html
    assert "stroke:" not in html and "aligned at" not in html
    shown.open(1, 2)
    shown.review.seek(8)
    shown.draw()
    assert strip_of(shown)["extents"] == [("0.0", "100.0", "#228be6"), ("0.0", "60.0", "#f08c00")]
    assert ">A: step 8 / 10, 0.40 s<" in shown.panels.html("wb-timeline")
    shown.review.select(1)
    shown.review.align("first success")
    shown.draw()
    strip = strip_of(shown)
    assert strip["extents"] == [("0.0", "76.923", "#228be6"), ("53.846", "46.154", "#f08c00")]
    assert strip["marks"] == [("success", "53.846", "A success, step 7")]
    assert strip["bands"] == [("53.846", "46.154")]
    place = shown.review.view().position
    assert strip["lines"][0] == ("53.846", "wb-zero") and len(strip["lines"]) == 2
    assert float(strip["lines"][1][0]) == pytest.approx(100 * (place + 7) / 13, abs=1e-3)
    shown.review.seek(-3)
    shown.draw()
    html = shown.panels.html("wb-timeline")
    assert ">B: step 0 / 6, 0.00 s<" in html and "(no state there)" in html
    assert "aligned at first success" in html and "stroke:#f08c00" in html
    rows = re.findall(
        r"<tr data-press.*?</tr>", shown.panels.part("Review").html("wb-opened-list"), re.DOTALL
    )
    assert len(rows) == 2 and "wb-selected" in rows[1] and "wb-selected" not in rows[0]
    assert "background:#f08c00" in rows[1] and ">B</span>" in rows[1] and "no success" in rows[1]
    status = shown.panels.html("wb-status")
    assert "background:#f08c00" in status and ">B</span>" in status and "no success" in status


def test_the_timeline_has_its_buttons_and_is_not_drawn_again_where_nothing_moved(shown: Shown) -> None:
    shown.open(1)
    buttons = shown.panels.control("step to take")
    assert buttons.options == walk(playing=False) and "play" in buttons.options
    (strip,) = (html for html in shown.panels.htmls() if "wb-timeline" in html.content)
    points = re.findall(r'<polyline points="([^"]*)"', strip.content)
    places = [float(point.partition(",")[0]) for line in points for point in line.split()]
    assert (min(places), max(places)) == (10.0, 100.0), "a reward of each step, the first with the first"
    before = strip.content
    shown.draw()
    assert strip.content is before
    shown.review.seek(3)
    shown.draw()
    assert "step 3 / 10" in strip.content
    shown.review.toggle_play()
    shown.draw()
    assert buttons.options == walk(playing=True) and "pause" in buttons.options
    shown.review.toggle_play()


def test_pressing_a_row_of_the_comparison_goes_there(shown: Shown) -> None:
    shown.open(1, 2)
    assert re.search(r'data-press="[^"]+"', shown.panels.part("Compare").html())
    shown.review.seek(9)
    shown.panels.part("Compare").press("0")
    assert shown.review.view().position == 1


def test_a_name_with_markup_in_it_is_text(shown: Shown, folder: Path, tmp_path: Path) -> None:
    evil = made(3, seed=9, task="<script>alert(1)</script>")
    write(folder, evil)
    shown.library.refresh()
    shown.open(9)
    said = shown.panels.html()
    assert "<script>alert" not in said and said.count("&lt;script&gt;alert") >= 2


def test_what_is_not_per_env_is_shown_marked_and_drawn(shown: Shown, folder: Path) -> None:
    for seed in (11, 12):
        odd = made(4, seed=seed)
        odd.batch = {"progress: all": np.linspace(0, 1, 5), "goal": np.ones((5, 2)) * seed}
        odd.texts = {
            "phase": ((0, TextEntry("str", "reach", False, True)), (2, TextEntry("str", "push", False, True)))
        }
        odd.evaluate["reward"] = np.arange(5.0)
        write(folder, odd, pictures=False)
    shown.library.refresh()
    shown.open(11)
    numbers = shown.panels.part("Curves").html("wb-numbers")
    assert "reach" in numbers and numbers.count("not per env</span>") == 3
    shown.review.seek(3)
    shown.draw()
    assert "push" in shown.panels.part("Curves").html("wb-numbers") and "0.750" in shown.panels.part(
        "Curves"
    ).html("wb-numbers")
    line = "progress: all (not per env)"
    assert {line, "reward (evaluate)"} <= set(shown.panels.control("Also").options)
    shown.panels.set("Also", line)
    shown.review.seek(4)
    shown.draw()
    np.testing.assert_array_equal(shown.chart(line).data[1], np.linspace(0, 1, 5))
    shown.open(11, 12)
    words = "Not compared, because they are not per env: progress: all, goal, phase."
    assert words in shown.panels.part("Compare").html()


def test_of_too_many_recordings_only_the_selected_one_is_named(shown: Shown, folder: Path) -> None:
    several = range(40, 40 + MOST_NAMED + 1)
    for seed in several:
        write(folder, made(1, seed=seed), pictures=False)
    shown.library.refresh()
    shown.open(*several)
    assert shown.panels.labels() == ["A, seed 40"]
    shown.review.close_one(MOST_NAMED)
    shown.draw()
    assert len(shown.panels.labels()) == MOST_NAMED


LONG, PATH = "x" * 1000, "y/" * 2000
HOSTILE: tuple[dict[str, Any], ...] = (
    {"source_file": "x" * 5000},
    {"source_file": PATH, "source_path": PATH, "source": {PATH: "x = 1\n", "../a.py": "\0"}, "side_files": {PATH: "0"}},
    {"source_file": "a\0b.py", "source_path": "a\0b.py", "source": {"a\0b.py": ""}, "side_files": {"a\0b": ""}},
    {"task": LONG, "id": LONG, "backend": LONG, "control_mode": LONG, "source_hash": LONG, "versions": {LONG: LONG}},
    {"written_at": "9999-12-31T23:59:59+00:00", "control_dt": 1e-4, "env_index": 2**62, "max_episode_steps": -1, "seed": 2**62},
    {"written_at": "<script>", "control_dt": 1e3, "acted_by": [[-(2**60), LONG]] * 1000},
    {"env_kwargs": {LONG: [[[[LONG]]]], "control_mode": {}}, "reset_options": {"\u202e": [float("nan"), 10**15]}},
    {"texts": {LONG: [[-5, ["a", LONG, True, True]], [10**9, None]], "": [[0, ["", "", False, False]]]}},
    {"segmentation": {str(-(2**40)): LONG}, "action_names": [LONG, LONG], "evaluate": {"a/" * 400: ["<f8", []]}},
    {"length": 10**7, "control_dt": 0},
    {"env_kwargs": "no object"},
)  # fmt: skip


def test_a_foreign_recording_of_any_values_is_shown_or_named(
    child_process: None, gated_server: GatedServer, panels: Panels, clock: Clock, tmp_path: Path
) -> None:
    path = write(tmp_path, made(6, success_from=3))
    document = json.loads(path.read_text()) | {"workbench_checksum": None}
    for number, change in enumerate(HOSTILE):
        for suffix in (".rrd", ".h5"):
            shutil.copy(path.with_suffix(suffix), tmp_path / f"{number}{suffix}")
        values = {**document, "workbench": {**document["workbench"], "id": str(number), **change}}
        (tmp_path / f"{number}.json").write_text(json.dumps(values))
    path.unlink()
    place = Workplace(gated_server, tmp_path, no_session, TaskOptions())
    place.shelf.library.refresh()
    page, review = ReviewPage(place, clock=clock), place.shelf.review
    rows = {row.name: row.id for row in place.shelf.library.view().rows}
    page.redraw()  # it opens the newest by itself, once
    shown = []
    for number in range(len(HOSTILE)):
        review.open([rows[str(number)]])
        until(lambda: not review.view().loading, "the end of the opening", seen=review.view)
        for state in (0, 6):
            review.seek(state)
            clock.passes()
            page.redraw()
        view, html = review.view(), panels.part("Review").html()
        if review.view().problems:
            assert str(number) in " ".join(view.problems) and str(number) in html
        else:
            shown.append(number)
            assert view.opened[0].id == rows[str(number)] and f">{number}<" in html
        assert len(panels.html()) < 1 << 20
    assert shown == [1, 2, 3, 4, 5, 6, 7, 8]
    place.close()
