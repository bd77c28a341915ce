"""What the live page does by itself with a command, and what it draws at once."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import viser

from tests.drive.live import Live
from tests.drive.panels import Clock
from tests.drive.scenes import camera, problem, running
from tests.drive.waiting import until
from workbench.app.live_page import WIDE_PIXELS
from workbench.cameras.commands import SelectCamera
from workbench.envs.camera_data import Picture
from workbench.live.events import PagesCounted
from workbench.live.messages import CameraRequest
from workbench.live.process.heartbeat import Busy
from workbench.live.view import SessionView
from workbench.machine.preferences import preferences
from workbench.page.commands import (
    CloseHints,
    OpenInEditor,
    ShowRecordings,
    ShowTab,
    TellOpenTab,
    ToggleTable,
    ToggleTimeline,
)
from workbench.page.widgets.editor_links import editor_link
from workbench.page.widgets.templates import render

pytestmark = pytest.mark.thorough

TEMPLATE = "vscode://file{file}:{line}"
KEY = ("sensor", "base_camera")


@pytest.fixture(scope="module")
def reviews() -> list[str]:
    """One entry for each time that the page asked for the recordings."""
    return []


@pytest.fixture(scope="module")
def page(reviews: list[str]) -> Iterator[Live]:
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    yield Live(server, Clock(), editor=TEMPLATE, on_review=lambda: reviews.append("review"))
    server.stop()


@pytest.fixture
def live(page: Live) -> Live:
    page.client.sent.clear()
    page.client.notices.clear()
    page.asked.clear()
    return page


def test_a_tab_is_opened_on_the_page_that_asks_and_the_left_dock_with_its_own(live: Live) -> None:
    live.show(running(3))
    assert live.is_folded("Envs")
    live.do(ShowTab(tab="Reward", fold="Numbers"))
    assert live.client.sent == [render("open_tab", tab="Reward", fold="Numbers")] and live.is_folded("Envs")
    for tab in ("Envs", "Episodes"):
        live.do(ShowTab(tab=tab))
        assert live.client.sent[-1] == render("open_tab", tab=tab, fold="") and not live.is_folded("Envs")
        live.do(ToggleTable())
        assert live.is_folded("Envs")


def test_commands_of_the_page_itself(live: Live, reviews: list[str]) -> None:
    live.show(running(3))
    live.do(ToggleTimeline())
    assert live.client.sent == [render("toggle_timeline")]
    live.do(ShowRecordings())
    assert reviews == ["review"]
    live.do(SelectCamera(kind="sensor", name="base_camera"))
    assert live.asked == [SelectCamera(kind="sensor", name="base_camera")]
    assert live.client.sent[-1] == render("open_tab", tab="Cameras", fold="")


def test_a_file_opens_in_the_editor_of_the_page_that_asks(live: Live) -> None:
    live.do(OpenInEditor(file="/home/me/push.py"))
    link = editor_link(TEMPLATE, "/home/me/push.py", None, lambda file: True)
    assert live.client.sent == [render("open_address", link=link)] and live.client.notices == []
    live.do(OpenInEditor(file=""))
    assert len(live.client.sent) == len(live.client.notices) == 1


def test_closed_hints_stay_closed(live: Live) -> None:
    assert live.presses(CloseHints())
    live.do(CloseHints())
    assert not live.presses(CloseHints())
    until(lambda: preferences().hints_closed, "the stored choice")


@pytest.mark.parametrize(
    ("num_envs", "width", "opens"),
    [(3, WIDE_PIXELS, True), (1, WIDE_PIXELS, False), (3, WIDE_PIXELS - 1, False), (3, 0, False)],
)
def test_the_table_of_envs_opens_by_itself_where_there_is_room(
    live_page: Live, num_envs: int, width: int, opens: bool
) -> None:
    live_page.visitor.page_width = width
    live_page.show(running(num_envs))
    assert live_page.is_folded("Envs") is not opens
    live_page.do(ToggleTable())
    assert live_page.is_folded("Envs") is opens
    if opens:
        live_page.show(running(num_envs + 1, task_serial=2))
        assert live_page.is_folded("Envs"), "the user has closed it"


def test_the_session_knows_how_many_pages_show_it(live: Live) -> None:
    for visitors in (2, 2, 1):
        live.page.counted(visitors)
    assert live.asked == [PagesCounted(2), PagesCounted(1)]


def with_picture(grey: int, serial: int) -> dict[str, Any]:
    pixels = np.full((6, 8, 3), grey, np.uint8)
    pose = np.array([0, 0, 1, 1, 0, 0, 0], np.float32)
    return {"pictures": {KEY: Picture(KEY[1], "sensor", 0, pose, pixels)}, "pictures_serial": serial}


def playing(**changes: Any) -> SessionView:
    view = running(3, **changes)
    assert view.task is not None
    return replace(view, task=replace(view.task, cameras=(camera(),)), cameras_serial=3)


def test_the_pictures_that_the_page_shows_are_requested_once(live: Live) -> None:
    asked: list[Any] = []
    for number in range(3):
        live.show(playing(step_serial=number))
        asked += [one for one in live.asked_by_drawing if isinstance(one, tuple) and one[0] == "change"]
    assert asked == [("change", {"cameras": (CameraRequest("base_camera", "sensor", ("rgb",)),)})]


BUSY = Busy(6.4, "in evaluate", "/home/me/push.py", 88, "while True:")
SOON: dict[str, dict[str, Any]] = {
    "a setting": {"selected_env": 1},
    "a long call": {"busy": BUSY},
    "a version": {"task_serial": 5, "task": "another"},
    "a problem": {"problem": problem(), "problem_serial": 5},
    "old code": {"stale": True},
    "activity": {"activity": "importing"},
    "a picture": with_picture(200, 5),
    "a pause": {"playing": False, "state": "paused"},
    "the past": {"past": True},
}


@pytest.mark.parametrize("what", SOON)
def test_while_steps_advance_only_what_a_person_waits_for_is_drawn_at_once(live: Live, what: str) -> None:
    def panels() -> dict[str, object]:
        return {name: one for name, one in live.everything().items() if "in the view" not in name}

    def view(number: int, **changes: Any) -> SessionView:
        made = playing(step_serial=number, **{**with_picture(50, 1), **changes})
        assert made.step is not None
        return replace(made, step=replace(made.step, reward=np.full(3, number, np.float32)))

    live.do(TellOpenTab(tab="Cameras"))
    live.show(view(1))
    live.show(view(1))
    before = panels()
    live.show(view(2), seconds=0.0)
    assert panels() == before, "numbers that change in every frame cannot be read"
    changes = dict(SOON[what])
    past, other = changes.pop("past", False), changes.pop("task", "")
    after = view(3, **changes)
    if past:
        after = replace(after, timeline=replace(after.timeline, shown=2))
    if other:
        assert after.task is not None
        after = replace(after, task=replace(after.task, env_id="Other-v1"))
    live.show(after, seconds=0.0)
    assert panels() != before


def test_a_closed_page_shows_nothing_any_more(page: Live) -> None:
    page.asked.clear()
    page.page.counted(3)
    page.page.close()
    assert page.asked == [PagesCounted(3), PagesCounted(0)]
