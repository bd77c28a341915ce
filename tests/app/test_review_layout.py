"""What the review page makes room for, and what it does with a command."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.drive.episodes import made, write
from tests.drive.reviewed import Reviewed, review_of
from tests.drive.waiting import until
from tests.episodes.sweep_files import sweep_folder
from workbench.app.review_page import (
    LIBRARY,
    MIN_VIEW_BY_SWEEP_PIXELS,
    MIN_VIEW_PIXELS,
    NARROW_VIEW_PIXELS,
)
from workbench.page.commands import (
    FrameScene,
    ShowFrustums,
    ShowLive,
    ShowTab,
    TellUnfolded,
    ToggleTable,
    ToggleTimeline,
)
from workbench.page.door.gated_server import GatedServer
from workbench.page.widgets.templates import render
from workbench.review.commands import OpenSweepEpisode


class Narrow:
    """The widths of the views of the open pages."""

    def __init__(self) -> None:
        self.widths: list[int] = []

    def clients(self) -> dict[int, Any]:
        def one(number: int, width: int) -> Any:
            place = {"position": np.zeros(3), "look_at": np.ones(3), "wxyz": np.array([1.0, 0, 0, 0])}
            camera = SimpleNamespace(image_width=width, image_height=500, fov=0.75, **place)
            return SimpleNamespace(client_id=number, camera=camera)

        return {number: one(number, width) for number, width in enumerate(self.widths)}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recordings")
    write(folder, made(6, seed=1))
    write(folder, made(4, seed=2), pictures=False)
    return folder


@pytest.fixture
def view(gated_server: GatedServer, monkeypatch: pytest.MonkeyPatch) -> Narrow:
    view = Narrow()
    monkeypatch.setattr(gated_server.server, "get_clients", view.clients)
    return view


@pytest.fixture
def shown(child_process: None, view: Narrow, folder: Path, gated_server: GatedServer) -> Iterator[Reviewed]:
    with review_of(gated_server, folder) as reviewed:
        reviewed.draw()
        yield reviewed


def test_the_library_makes_way_for_the_first_recording_where_the_view_is_narrow(
    shown: Reviewed, view: Narrow
) -> None:
    view.widths = [NARROW_VIEW_PIXELS, 0, 2000]
    shown.open(1)
    assert not shown.is_folded("Library")
    view.widths = [2000, NARROW_VIEW_PIXELS - 1]
    shown.open(2)
    assert shown.is_folded("Library")
    shown.do(ToggleTable())
    assert not shown.is_folded("Library")
    shown.draw()
    assert not shown.is_folded("Library"), "the user has opened it"
    shown.do(ToggleTable())
    shown.do(TellUnfolded(panel=LIBRARY))
    shown.do(ToggleTable())
    assert shown.is_folded("Library")


def test_two_open_panels_that_leave_no_view_are_reduced_to_the_newest(shown: Reviewed, view: Narrow) -> None:
    view.widths = [MIN_VIEW_PIXELS - 1]
    shown.draw()
    assert not shown.is_folded("Library"), "nothing was unfolded"
    shown.do(TellUnfolded(panel="Rerun"))
    shown.clock.passes(1.0)
    shown.page.redraw()
    assert shown.is_folded("Library")
    view.widths = [MIN_VIEW_PIXELS]
    shown.do(ToggleTable())
    shown.do(TellUnfolded(panel="Rerun"))
    shown.clock.passes(1.0)
    shown.page.redraw()
    assert not shown.is_folded("Library"), "there is room"
    view.widths = [MIN_VIEW_PIXELS - 1]
    shown.draw()
    assert not shown.is_folded("Library"), "it became narrow long after"


def test_commands_of_the_page_itself(shown: Reviewed) -> None:
    sent = shown.client.sent
    shown.do(ToggleTimeline())
    shown.do(ShowTab(tab="Curves", fold="reward"))
    assert sent == [render("toggle_timeline"), render("open_tab", tab="Curves", fold="reward")]
    shown.do(ShowLive())
    assert len(shown.client.notices) == 1, "no task is open"
    assert FrameScene.help() in shown.commands() and ShowLive.help() not in shown.commands()
    shown.open(1)
    shown.draw()
    assert shown.nodes("/cameras/sensor")
    shown.do(ShowFrustums(on=False))
    shown.draw()
    assert not shown.nodes("/cameras/sensor")
    shown.do(FrameScene())
    assert len(shown.client.notices) == 1


def test_pictures_and_cameras_are_those_of_the_selected_recording(shown: Reviewed) -> None:
    def grey() -> int | None:
        shown.draw()
        shown.draw()
        images = [one for one in shown.part("Cameras").images() if one.visible]
        return int(np.asarray(images[0].image).mean()) if images else None

    shown.open(1, 2)
    greys = []
    for state in (1, 5):
        shown.seek(state)
        greys.append(grey())
    assert None not in greys and greys[0] != greys[1]
    shown.select(1)
    assert grey() is None
    shown.select(0)
    assert grey() == greys[1]


def test_the_library_stays_beside_a_watched_episode_of_a_sweep_where_there_is_room(
    child_process: None, gated_server: GatedServer, view: Narrow, tmp_path: Path
) -> None:
    sweep_folder(tmp_path)
    for length in (4, 5):
        write(tmp_path, made(length, seed=length), pictures=False)
    with review_of(gated_server, tmp_path) as shown:
        for length, width in ((4, MIN_VIEW_BY_SWEEP_PIXELS), (5, MIN_VIEW_BY_SWEEP_PIXELS - 1)):
            view.widths = [width]
            shown.draw()
            (row,) = (row for row in shown.library.view().rows if row.length == length)
            shown.do(OpenSweepEpisode(id=row.id))
            until(lambda id=row.id: [one.id for one in shown.review.view().opened] == [id], "the episode")
            shown.draw()
            assert shown.is_folded("Library") is (length == 5)
