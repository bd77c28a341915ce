"""The review's page on a real server and real files, drawn without a browser."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import viser

from tests.session.recordings import made, write
from workbench.core.step import OtherEntry
from workbench.recording.library import Library
from workbench.session.review import Review
from workbench.ui.review_page import ReviewOffers, ReviewPage

Opener = Callable[..., None]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recordings")
    write(folder, made(10, success_from=7, seed=1))
    write(folder, made(6, seed=2, speed=0.03, source_hash="1" * 12, source={"push.py": "reward = 2\n"}))
    return folder


@pytest.fixture
def page(folder: Path, server: viser.ViserServer) -> Iterator[ReviewPage]:
    library = Library(folder)
    library.refresh()
    review = Review(library)
    page = ReviewPage(server, review, library, ReviewOffers(on_step_back=lambda id, state: None))
    yield page
    review.close()
    library.close()


def library_of(page: ReviewPage) -> Library:
    assert page._library is not None
    return page._library._library


def open_seeds(page: ReviewPage, *seeds: int) -> None:
    rows = {row.seed: row.id for row in library_of(page).rows()}
    page._review.open([rows[seed] for seed in seeds])
    deadline = time.monotonic() + 60
    while len(page._review.view().opened) != len(seeds) or page._review.view().loading:
        assert time.monotonic() < deadline, page._review.view().problems
        time.sleep(0.01)
    draw(page)


def draw(page: ReviewPage) -> None:
    # Each part is drawn as often as can be read; a test does not wait for that.
    page._curves._drawn_at = page._curves._numbers_at = 0.0
    page._cameras._drawn_at = page._told_at = 0.0
    page.redraw()


def test_says_what_to_do_while_nothing_is_open(page: ReviewPage) -> None:
    page.redraw()
    assert "Choose one in the library" in page._panel._list.content
    assert not page._timeline._panel.visible and not page._panel._play.visible
    assert page._library_open and "nothing open" in page._status.content


def test_an_opened_recording_fills_every_part(page: ReviewPage) -> None:
    open_seeds(page, 1)
    cube = next(handle for handle in page._in_3d.bodies.handles if "cube" in handle.name)
    assert np.allclose(cube.batched_positions[:, 0], 0.0)
    page._review.seek(7)
    draw(page)
    draw(page)  # the Cameras tab has asked for its pictures meanwhile
    assert np.allclose(cube.batched_positions[:, 0], 0.07)
    assert page._timeline._slider.handle.max == 10 and page._timeline._slider.handle.value == 7
    assert "step 7 / 10" in page._timeline._strip.content and "success" in page._timeline._strip.content
    assert "success" in page._curves._numbers.content
    chart = page._curves._charts["reward"].handle
    assert chart is not None and chart.title == "reward"
    image = next(iter(page._cameras._cameras.values())).images["rgb"]
    assert abs(int(np.asarray(image.image).mean()) - 140) <= 3
    assert page._panel._live.visible and not page._panel._arrange.visible
    assert "open two" in page._compare._html.content.lower()


def test_two_recordings_are_compared_and_aligned(page: ReviewPage) -> None:
    open_seeds(page, 1, 2)
    assert page._panel.ghosts and page._panel._arrange.visible
    page._review.seek(5)
    draw(page)
    ghost = [h for h in page._in_3d.bodies.handles if "cube" in h.name]
    assert sorted(float(h.batched_positions[0, 0]) for h in ghost if h.visible) == pytest.approx([0.05, 0.15])
    assert "They part at step 1" in page._compare._html.content
    assert "reward = 2" in page._compare._html.content
    chart = page._curves._charts["reward"].handle
    assert chart is not None and len(chart.series) == 4, "step, two lines and the dot"
    page._panel.toggle_arrangement()
    draw(page)
    (cubes,) = (h for h in page._in_3d.bodies.handles if "cube" in h.name)
    assert len(cubes.batched_positions) == 2 and page._in_3d._mark._label is not None
    assert page._in_3d._mark._label.text == "A, seed 1"
    numbers = page._in_3d._numbers
    assert numbers._drawn is not None and numbers._drawn[1] == ("", "B")
    page._review.align("first success")
    draw(page)
    assert "B has no success" in page._panel._never.content
    assert page._timeline._slider.handle.min == -7


def test_pressing_a_row_of_the_comparison_goes_there(page: ReviewPage) -> None:
    open_seeds(page, 1, 2)
    assert re.search(r'data-press="[^"]+"', page._compare._html.content)
    page._review.seek(9)
    page._compare._go(0)
    assert page._review.view().position == 1


def test_a_name_with_markup_in_it_is_text(page: ReviewPage, folder: Path, tmp_path: Path) -> None:
    evil = made(3, seed=9, task="<script>alert(1)</script>")
    write(folder, evil)
    library_of(page).refresh()
    open_seeds(page, 9)
    for html in (page._panel._list, page._status, page._panel._facts, page._timeline._strip):
        assert "<script>alert" not in html.content


def test_what_is_not_per_env_is_shown_marked_and_drawn(page: ReviewPage, folder: Path) -> None:
    for seed in (11, 12):
        odd = made(4, seed=seed)
        odd.batch = {"progress: all": np.linspace(0, 1, 5), "goal": np.ones((5, 2)) * seed}
        odd.texts = {"phase": ((0, OtherEntry("str", ("reach",))), (2, OtherEntry("str", ("push",))))}
        odd.evaluate["reward"] = np.arange(5.0)
        write(folder, odd, pictures=False)
    library_of(page).refresh()
    open_seeds(page, 11)
    numbers = page._curves._numbers.content
    assert "reach" in numbers and numbers.count("not per env</span>") == 3
    page._review.seek(3)
    draw(page)
    assert "push" in page._curves._numbers.content and "0.750" in page._curves._numbers.content
    line = "progress: all (not per env)"
    assert {line, "reward (evaluate)"} <= set(page._curves._entry.options)
    page._curves._wish, page._curves._entry.value = line, line
    page._review.seek(4)
    draw(page)
    chart = page._curves._charts["also"].handle
    assert chart is not None and chart.title == line
    np.testing.assert_array_equal(chart.data[1], np.linspace(0, 1, 5))
    open_seeds(page, 11, 12)
    words = "Not compared, since they are not numbers of this env alone: progress: all, goal, phase."
    assert words in page._compare._html.content


def test_many_recordings_stand_side_by_side(page: ReviewPage, folder: Path) -> None:
    for seed in range(20, 26):
        write(folder, made(3, seed=seed), pictures=False)
    library_of(page).refresh()
    open_seeds(page, *range(20, 26))
    assert not page._panel.ghosts and not page._panel._arrange.visible
    (cubes,) = (h for h in page._in_3d.bodies.handles if "cube" in h.name)
    assert len(cubes.batched_positions) == 6
