"""The review page on a real server and real files, without a browser."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.drive.episodes import made, write
from tests.drive.panels import difference
from tests.drive.reviewed import Reviewed, review_of
from tests.drive.waiting import until
from tests.episodes.sweep_files import sweep_folder
from workbench.episodes.columns import TextEntry
from workbench.episodes.drawings import DrawingTrack
from workbench.live.commands import SelectBody, TogglePlay
from workbench.live.timeline_commands import Seek
from workbench.page.command import Command
from workbench.page.door.gated_server import GatedServer
from workbench.review.commands import (
    AlignRecordings,
    ChoosePlaybackSpeed,
    ChooseReviewCurve,
    CompareWith,
    LoopPlayback,
    NextRecording,
    PreviousRecording,
    SwapWithFirst,
    ToggleOverlaid,
)
from workbench.review.panel import GHOSTS, GO_LIVE, GRID, TRY_AGAIN


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recordings")
    write(folder, made(10, success_from=7, seed=1))
    write(folder, made(6, seed=2, speed=0.03, source_hash="1" * 12, source={"push.py": "reward = 2\n"}))
    return folder


@pytest.fixture
def shown(child_process: None, folder: Path, gated_server: GatedServer) -> Iterator[Reviewed]:
    with review_of(gated_server, folder) as reviewed:
        yield reviewed


def test_the_view_has_what_the_task_drew_at_the_shown_step(
    child_process: None, gated_server: GatedServer, tmp_path: Path
) -> None:
    for seed in (1, 2):
        places = np.array([(state, 0, seed) for state in range(4)], np.float32)
        colors, sizes = np.zeros((5, 3), np.uint8), np.ones(5, np.float32)
        begins = np.array([0, 1, 2, 3, 4, 4])
        dot = DrawingTrack("dot", "points", np.arange(5), begins, places, colors, sizes, ())
        write(tmp_path, replace(made(4, seed=seed), drawn=(dot,)), pictures=False)
    with review_of(gated_server, tmp_path) as shown:
        shown.open(1, 2)
        for index, state in ((0, 0), (0, 3), (1, 3), (1, 1)):
            shown.select(index)
            shown.seek(state)
            (dot,) = shown.nodes("/drawn/dot")
            np.testing.assert_allclose(dot.points, [[state, 0, index + 1]])
        shown.seek(4)
        assert not shown.nodes("/drawn/")


SLIDER = "step of the timeline"


@pytest.mark.slow
def test_the_results_of_a_sweep_have_a_tab_even_if_they_arrive_later(
    child_process: None, gated_server: GatedServer, tmp_path: Path
) -> None:
    write(tmp_path, made(4, seed=1))
    with review_of(gated_server, tmp_path) as shown:
        shown.draw()
        assert "reach_weight" not in shown.html()
        sweep_folder(tmp_path)
        until(lambda: shown.library.view().sweep, "the results of the sweep")
        until(lambda: shown.draw() or "reach_weight" in shown.part("Sweep").html(), "the points")


CHANGES: dict[str, tuple[Command, Command]] = {
    "another moment": (Seek(step=5), Seek(step=8)),
    "beyond the end of one": (Seek(step=9), Seek(step=8)),
    "the other one selected": (NextRecording(), PreviousRecording()),
    "aligned at the success": (AlignRecordings(at="first success"), AlignRecordings(at="start")),
    "in another order": (SwapWithFirst(index=1), SwapWithFirst(index=1)),
    "another speed": (ChoosePlaybackSpeed(speed=2.0), ChoosePlaybackSpeed(speed=1.0)),
    "round and round": (LoopPlayback(on=True), LoopPlayback(on=False)),
}


def test_a_change_is_shown_and_disappears_when_reverted(shown: Reviewed) -> None:
    shown.open(1, 2)
    shown.review.do(AlignRecordings(at="start"))
    for what, (change, back) in CHANGES.items():
        shown.review.do(change)
        shown.review.do(back)
        shown.review.do(Seek(step=8))
        shown.select(0)
        for _ in range(3):
            shown.draw()
        before = shown.everything()
        shown.review.do(change)
        shown.draw()
        changed = shown.everything()
        assert difference(before, changed), f"{what} is not shown"
        assert difference(changed, shown.all_drawn()) == "", f"a part that shows {what} was not redrawn"
        shown.review.do(back)
        shown.review.do(Seek(step=8))
        for _ in range(3):
            shown.draw()
        assert difference(before, shown.everything()) == "", what


def test_a_closed_recording_leaves_nothing_in_the_next_one(shown: Reviewed) -> None:
    shown.open(2)
    for _ in range(3):
        shown.draw()
    alone = shown.everything()
    shown.open(1, 2)
    shown.seek(5)
    shown.review.do(AlignRecordings(at="first success"))
    shown.draw()
    shown.open(2)
    shown.seek(0)
    for _ in range(3):
        shown.draw()
    assert difference(alone, shown.everything()) == ""


def test_an_opened_recording_fills_every_part(shown: Reviewed) -> None:
    shown.open(1)
    cube = shown.bodies("cube")[0]
    assert np.allclose(cube.batched_positions[:, 0], 0.0)
    shown.seek(7)
    shown.draw()  # the Cameras tab has requested its pictures by now
    assert np.allclose(cube.batched_positions[:, 0], 0.07)
    assert shown.field(SLIDER).bounds == (0, 10) and shown.field(SLIDER).value == 7
    assert "step 7 / 10" in timeline_of(shown) and "success" in timeline_of(shown)
    assert "success" in shown.part("Curves").html("wb-numbers")
    assert shown.chart("reward")
    image = shown.part("Cameras").images()[0]
    assert abs(int(np.asarray(image.image).mean()) - 140) <= 3
    assert shown.shows(GO_LIVE) and not shown.shows("Layout")
    assert "open two" in shown.part("Compare").html().lower()


def test_the_pressed_body_is_marked_and_its_pose_is_that_of_the_shown_step(shown: Reviewed) -> None:
    shown.open(1)
    shown.seek(0)
    shown.do(SelectBody(body="cube"))
    shown.draw()
    assert "cube" in shown.part("Review").html("wb-body") and shown.nodes("/selected_body/box")
    before = shown.part("Review").html("wb-body")
    shown.seek(5)
    assert shown.part("Review").html("wb-body") != before
    shown.do(SelectBody(body=""))
    shown.draw()
    assert shown.part("Review").html("wb-body") == "" and shown.nodes("/selected_body/box") == []


def test_two_recordings_are_compared_and_aligned(shown: Reviewed, monkeypatch: pytest.MonkeyPatch) -> None:
    shown.open(1, 2)
    assert shown.field("Layout").value == GHOSTS
    shown.seek(5)
    ghost = shown.bodies("cube")
    assert sorted(float(h.batched_positions[0, 0]) for h in ghost if h.visible) == pytest.approx([0.05, 0.15])
    assert "They diverge at step 1" in shown.part("Compare").html()
    assert "reward = 2" in shown.part("Compare").html()
    assert shown.chart("reward").names == ["A", "B"]
    shown.do(ToggleOverlaid())
    shown.draw()
    (cubes,) = shown.bodies("cube")
    assert len(cubes.batched_positions) == 2 and sorted(shown.labels()) == ["A, seed 1", "B"]
    (name,) = shown.nodes("/names")
    away = np.linalg.norm(cubes.batched_positions - name.position, axis=1)
    assert away[1] < away[0], "at its own offset"
    shown.select(1)
    shown.draw()
    assert sorted(shown.labels()) == ["A", "B, seed 2"]
    shown.select(0)
    shown.review.do(AlignRecordings(at="first success"))
    shown.draw()
    assert "B has no success" in shown.part("Review").html()
    bounds = shown.field(SLIDER).bounds
    assert bounds is not None and bounds[0] == -7


def test_choices_for_several_recordings_are_shown_and_applied(shown: Reviewed) -> None:
    shown.open(1, 2)
    chosen = {"Speed": "2 ×", "Loop": True, "Layout": GRID, "Align at": "first success", "Tolerance": "1 cm"}
    for label, value in chosen.items():
        shown.set(label, value)
    shown.draw()
    assert {label: shown.field(label).value for label in chosen} == chosen
    view = shown.review.view()
    assert (view.speed, view.loop, view.align) == (2.0, True, "first success")
    assert shown.labels(), "side by side"
    shown.press("Swap A and B")
    assert [one.id for one in shown.review.view().opened] == [one.id for one in reversed(view.opened)]
    shown.press("Play")
    shown.draw()
    assert shown.review.view().playing and shown.shows("Pause")
    for command in (AlignRecordings(at="noon"), CompareWith(index=2), SwapWithFirst(index=2)):
        shown.do(command)
    shown.do(ChooseReviewCurve(curve="noon"))
    assert len(shown.client.notices) == 4


def test_a_press_retries_an_unreadable_recording(shown: Reviewed, folder: Path) -> None:
    write(folder, made(4, seed=3))
    shown.library.refresh()
    (row,) = (row for row in shown.library.view().rows if row.seed == 3)
    files = {path: path.read_bytes() for path in row.paths}
    for path in files:
        path.write_bytes(b"cut off")
    shown.review.open([row.id])
    until(lambda: not shown.review.view().loading, "the failed read")
    shown.draw()
    assert "was not opened" in shown.part("Review").html() and shown.shows(TRY_AGAIN)
    for path, content in files.items():
        path.write_bytes(content)
    # A scan between two of the writes sees another recording.
    until(lambda: shown.library.refresh() or shown.library.row(row.id), "the row of the whole files")
    shown.press(TRY_AGAIN)
    until(
        lambda: len(shown.review.view().opened) == 1,
        "the recording",
        seen=lambda: shown.review.view().problems,
    )
    until(lambda: not shown.review.view().loading, "the end of it")
    shown.draw()
    assert not shown.shows(TRY_AGAIN)
    for path in files:
        path.unlink()
    shown.library.refresh()


def timeline_of(shown: Reviewed) -> str:
    """HTML of the strip and of its legend."""
    return shown.html("wb-timeline") + shown.html("wb-legend-row")


def strip_of(shown: Reviewed) -> dict[str, list[tuple[str, ...]]]:
    """What the strip draws: extents of recordings, marks and vertical lines, with positions in per cent."""
    html = timeline_of(shown)
    extent = r'wb-length" style="left:([-\d.]+)%;width:([-\d.]+)%;background:(#\w+)"'
    mark = r'wb-mark wb-mark-(\w+)" style="left:([-\d.]+)%" data-do="[^"]*" title="([^"]*)"'
    return {
        "extents": re.findall(extent, html),
        "marks": re.findall(mark, html),
        "lines": re.findall(r'<line x1="([-\d.]+)" x2="\1" [^>]*class="([\w -]+)"', html),
        "bands": re.findall(r'<rect x="([-\d.]+)" y="-14" width="([-\d.]+)"', html),
        "legend": re.findall(r'wb-key wb-mark-(\w+)"></i>([^<]*)<', html),
    }


def test_the_strip_shows_each_recording_at_its_alignment(shown: Reviewed) -> None:
    shown.open(1)
    shown.seek(7)
    strip = strip_of(shown)
    assert strip["marks"] == [("success", "70.0", " success, step 7")] and strip["extents"] == []
    assert strip["legend"] == [("success", "success")] and strip["bands"] == [("0.0", "100.0")]
    assert strip["lines"] == [("70.0", "wb-cursor wb-past")]
    html = timeline_of(shown)
    assert ">step 7 / 10<" in html and ">0.35 s<" in html and '<span class="wb-num">success</span>' in html
    assert "stroke:" not in html and "aligned at" not in html
    shown.open(1, 2)
    shown.seek(8)
    assert strip_of(shown)["extents"] == [("0.0", "100.0", "#228be6"), ("0.0", "60.0", "#f08c00")]
    assert ">A: step 8 / 10<" in timeline_of(shown)
    shown.select(1)
    shown.review.do(AlignRecordings(at="first success"))
    shown.draw()
    strip = strip_of(shown)
    assert strip["extents"] == [("0.0", "76.923", "#228be6"), ("53.846", "46.154", "#f08c00")]
    assert strip["marks"] == [("success", "53.846", "A success, step 7")]
    assert strip["bands"] == [("53.846", "46.154")]
    place = shown.review.view().position
    assert strip["lines"][0] == ("53.846", "wb-zero") and len(strip["lines"]) == 2
    assert float(strip["lines"][1][0]) == pytest.approx(100 * (place + 7) / 13, abs=1e-3)
    shown.seek(-3)
    html = timeline_of(shown)
    assert ">B: step 0 / 6<" in html and "(no state there)" in html
    assert "aligned at first success" in html and "stroke:#f08c00" in html
    rows = re.findall(r"<tr data-do.*?</tr>", shown.part("Review").html("wb-opened-list"), re.DOTALL)
    assert len(rows) == 2 and "wb-selected" in rows[1] and "wb-selected" not in rows[0]
    assert "background:#f08c00" in rows[1] and ">B</span>" in rows[1] and "no success" in rows[1]
    status = shown.html("wb-status")
    assert "background:#f08c00" in status and ">B</span>" in status and "no success" in status


def test_the_timeline_has_its_buttons_and_is_not_redrawn_without_a_change(shown: Reviewed) -> None:
    shown.open(1)
    assert shown.shows("Play") and shown.presses(TogglePlay())
    (strip,) = (html for html in shown.htmls() if "wb-timeline" in html.content)
    points = re.findall(r'<polyline points="([^"]*)"', strip.content)
    places = [float(point.partition(",")[0]) for line in points for point in line.split()]
    assert (min(places), max(places)) == (10.0, 100.0), "one reward per step, starting at the first step"
    before = strip.content
    shown.draw()
    assert strip.content is before
    shown.seek(3)
    assert "step 3 / 10" in strip.content
    shown.review.do(TogglePlay())
    shown.draw()
    assert shown.shows("Pause")
    shown.review.do(TogglePlay())


def test_pressing_a_row_of_the_comparison_seeks_its_step(shown: Reviewed) -> None:
    shown.open(1, 2)
    shown.review.do(Seek(step=9))
    shown.part("Compare").ask(Seek(step=1))
    assert shown.review.view().position == 1


def test_a_name_with_markup_in_it_is_text(shown: Reviewed, folder: Path, tmp_path: Path) -> None:
    evil = made(3, seed=9, task="<script>alert(1)</script>")
    write(folder, evil)
    shown.library.refresh()
    shown.open(9)
    shown_html = shown.html()
    assert "<script>alert" not in shown_html and shown_html.count("&lt;script&gt;alert") >= 2


def test_a_value_that_is_not_per_env_is_shown_marked_and_drawn(shown: Reviewed, folder: Path) -> None:
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
    numbers = shown.part("Curves").html("wb-numbers")
    assert "reach" in numbers and numbers.count("not per env</span>") == 3
    shown.seek(3)
    assert "push" in shown.part("Curves").html("wb-numbers") and "0.750" in shown.part("Curves").html(
        "wb-numbers"
    )
    line = "progress: all (not per env)"
    assert {line, "reward (evaluate)"} <= set(shown.field("Also").options)
    shown.set("Also", line)
    shown.seek(4)
    np.testing.assert_allclose(shown.chart(line).lines[0][1][:, 1], np.linspace(0, 1, 5), atol=0.01)
    shown.open(11, 12)
    words = "Not compared, because they are not per env: progress: all, goal, phase."
    assert words in shown.part("Compare").html()


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


def test_a_foreign_recording_with_any_values_is_shown_or_reported(
    child_process: None, gated_server: GatedServer, tmp_path: Path
) -> None:
    path = write(tmp_path, made(6, success_from=3))
    document = json.loads(path.read_text()) | {"workbench_checksum": None}
    for number, change in enumerate(HOSTILE):
        for suffix in (".rrd", ".h5"):
            shutil.copy(path.with_suffix(suffix), tmp_path / f"{number}{suffix}")
        values = {**document, "workbench": {**document["workbench"], "id": str(number), **change}}
        (tmp_path / f"{number}.json").write_text(json.dumps(values))
    path.unlink()
    with review_of(gated_server, tmp_path) as reviewed:
        review, rows = reviewed.review, {row.name: row.id for row in reviewed.library.view().rows}
        shown = []
        for number in range(len(HOSTILE)):
            review.open([rows[str(number)]])
            until(lambda: not review.view().loading, "the end of the opening", seen=review.view)
            for state in (0, 6):
                reviewed.seek(state)
            view, html = review.view(), reviewed.part("Review").html()
            if review.view().problems:
                assert str(number) in " ".join(view.problems) and str(number) in html
            else:
                shown.append(number)
                assert view.opened[0].id == rows[str(number)] and f">{number}<" in html
            assert len(reviewed.html()) < 1 << 20
        assert shown == [1, 2, 3, 4, 5, 6, 7, 8]
