"""The timeline on a real session and a real server, drawn without a browser."""

# pyright: reportOptionalMemberAccess=false

from __future__ import annotations

from collections.abc import Iterator

import pytest
import viser

from tests.session.conftest import TASKS, wait_until
from workbench.session.messages import TaskOptions
from workbench.session.session import Session
from workbench.ui import timeline_panel as panels
from workbench.ui.page import Page


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    session = Session(
        str(TASKS / "minimal.py"), TaskOptions(num_envs=3), recordings=tmp_path_factory.mktemp("recordings")
    )
    page = Page(server, session)
    wait_until(session, lambda view: view.timeline.moments == 1, "the first moment")
    yield page
    session.close()
    server.stop()


def drawn(page: Page) -> panels.TimelinePanel:
    panel = page._timeline
    panel._range_at = panel._strip_at = 0.0
    page.redraw()
    return panel


def step(page: Page, count: int) -> None:
    for _ in range(count):
        last = page._session.view().timeline.last
        page._session.step()
        wait_until(page._session, lambda view, n=last: view.timeline.last > n, "a step")


def test_it_is_there_from_the_first_moment_and_offers_only_what_can_be_done(page: Page) -> None:
    panel = page._timeline
    assert not panel._panel.visible, "the page was not drawn yet"
    assert drawn(page)._panel.visible
    step(page, 4)
    drawn(page)
    assert (panel._slider.handle.min, panel._slider.handle.max, panel._slider.handle.value) == (-4, 0, 0)
    assert not panel._travel.visible, "nobody is in the past"
    assert panel._walk.options == panels.WALK, "nothing was before the first reset"
    assert "live" in panel._strip.content


def test_a_past_moment_is_in_the_view_the_numbers_and_the_status_line(page: Page) -> None:
    step(page, 2)
    newest = page._session.view().timeline.last
    drawn(page)
    page._timeline._seek(-2)
    page._numbers._drawn_at = page._status._drawn_at = 0.0
    panel = drawn(page)
    assert page._session.view().timeline.shown == newest - 2
    hand = next(handle for handle in page._scene.handles if "panda_hand" in handle.name)
    moment = page._session._state.timeline.history.at(newest - 2)
    body = page._session.view().task.geometry.body_names.index("panda/panda_hand")
    assert (hand.batched_wxyzs == moment.step.poses[:, body, 3:]).all()
    assert "2 steps ago" in page._status._handle.content
    assert "2 steps ago" in panel._strip.content
    assert panel._travel.options == ("Go on from here: env 0", "all envs", "env 0 into all envs")
    assert panel._travel.visible and panel._slider.handle.value in (-2, 0)
    page._timeline.go_live()
    assert "live" in drawn(page)._strip.content


def test_zoom_to_episode_takes_the_slider_to_where_the_episode_began(page: Page) -> None:
    last = page._session.view().timeline.last
    page._session.reset()
    wait_until(page._session, lambda view: view.timeline.last > last, "the reset")
    step(page, 3)
    page._timeline._on_walk(panels.EPISODE)
    panel = drawn(page)
    assert panel._slider.handle.min == -3
    assert panel._walk.options[-2:] == (panels.EVERYTHING, "undo reset of all")
    page._timeline._on_walk(panels.EVERYTHING)
    assert drawn(page)._slider.handle.min < -3
    page._timeline._on_walk("undo reset of all")
    wait_until(page._session, lambda view: view.step.elapsed_steps[0] > 3, "the episode before")


def test_an_arrow_that_a_slider_took_is_not_taken_twice(page: Page) -> None:
    drawn(page)
    newest = page._session.view().timeline.last
    page._timeline.go_live()
    panels.Control._last_touch = -1e9
    page._timeline.step_by(-1)
    assert page._session.view().timeline.shown == newest - 1
    panels.Control._last_touch = panels.time.monotonic()
    page._timeline.step_by(-1)
    assert page._session.view().timeline.shown == newest - 1
    panels.Control._last_touch = -1e9
    page._timeline.go_live()


def test_a_value_that_no_slider_has_is_refused(page: Page) -> None:
    for value in (1, 10**12, "0", None, True, 0.5):
        with pytest.raises(ValueError, match="step of the past"):
            page._timeline._slider._read(value)
    page._timeline._seek(-(10**8))
    assert page._session.view().timeline.shown == page._session.view().timeline.first
    page._timeline._on_travel("rm -rf")
    page._timeline._on_walk("rm -rf")
    page._timeline.go_live()
