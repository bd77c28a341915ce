"""The live page and the review on one server, swapped repeatedly; nothing is left behind."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import viser

from tests.drive.episodes import begin, made, write
from tests.drive.panels import Panels, held_by
from tests.drive.session import wait_until
from tests.drive.tabs import tabs_of
from tests.drive.waiting import until
from workbench.app.server import App
from workbench.app.session import Session
from workbench.live.commands import PlayRun
from workbench.page.door.gated_server import GatedServer
from workbench.task.description import TaskOptions

SWAPS = 20


@pytest.fixture
def server(gated_server: GatedServer) -> viser.ViserServer:
    """The server of both pages."""
    return gated_server.server


def no_session(task: object, options: object) -> Session:
    raise AssertionError("no test here goes live from a recording")


@pytest.fixture
def app(
    child_process: None, tmp_path: Path, gated_server: GatedServer, scripted_session: Callable[..., Session]
) -> Iterator[App]:
    write(tmp_path, made(5))
    app = App(gated_server, tmp_path, no_session, TaskOptions(), scripted_session(2))
    yield app
    app.close()


@pytest.mark.slow
# A page may close while its viewpoint is sent.
@pytest.mark.filterwarnings("ignore:Queued a SetCamera:UserWarning")
def test_twenty_swaps_leave_nothing_behind_and_the_session_keeps_running(
    app: App, gated_server: GatedServer, server: viser.ViserServer, panels: Panels
) -> None:
    session = app.shared.session
    assert session is not None
    app.shared.pages.start("live")
    session.do(PlayRun())
    seen: dict[str, list[dict[str, int]]] = {"live": [], "review": []}
    threads: list[int] = []
    for number in range(SWAPS):
        which = "review" if number % 2 == 0 else "live"
        app.shared.pages.show(which).result(60)
        with tabs_of(gated_server.url) as tabs:
            tab = tabs.open()
            until(lambda tab=tab: tab.open and panels.html("wb-status"), f"the {which} page, drawn")
            if number < 4 or number >= SWAPS - 2:
                seen[which].append(drawn_whole(server))
        threads.append(threading.active_count())
    for found in seen.values():
        for name, count in found[-1].items():
            # A busy machine can pause for as long as `drawn_whole` waits; then an early count lacks some parts.
            early = max(counts[name] for counts in found[:2])
            assert count <= early + (40 if name == "messages" else 0), (name, found)
    assert max(threads[4:]) <= max(threads[:4])
    before = session.view().step_serial
    wait_until(session, lambda view: view.step_serial > before, "a step of the playing env")


def drawn_whole(server: viser.ViserServer) -> dict[str, int]:
    """What the server holds once it stops changing: some parts are drawn shortly after the page."""
    looks: list[dict[str, int]] = []

    def unchanged() -> bool:
        looks.append(held_by(server))
        time.sleep(0.5)
        return len(looks) > 1 and {**looks[-1], "messages": 0} == {**looks[-2], "messages": 0}

    until(unchanged, "a page that is drawn whole", seen=lambda: looks)
    return looks[-1]


def test_an_episode_whose_writer_was_killed_is_recovered_and_reported(
    child_process: None, tmp_path: Path, gated_server: GatedServer
) -> None:
    begin(tmp_path, made(5, seed=8))
    app = App(gated_server, tmp_path, no_session, TaskOptions())
    app.shared.pages.start("review")
    try:
        until(
            lambda: "is back in the library" in " ".join(app.shared.recordings.review.view().problems),
            "the report",
        )
        until(lambda: [row.seed for row in app.shared.recordings.library.view().rows] == [8], "its row")
    finally:
        app.close()


@pytest.mark.slow
def test_serving_the_pages_needs_no_simulator(child_process: None) -> None:
    output = subprocess.run(
        [sys.executable, "-c", "import sys, workbench.cli.page; print(*sys.modules)"],
        check=True,
        capture_output=True,
        text=True,
    ).stdout.split()
    assert not {"torch", "sapien", "mani_skill"} & set(output)


def test_a_requested_recording_is_opened_even_if_it_is_not_the_newest(
    app: App, gated_server: GatedServer, tmp_path: Path
) -> None:
    (older,) = tmp_path.glob("*.rrd")
    write(tmp_path, made(4, seed=9))
    app.shared.pages.start("live")
    app.shared.look_at(older)
    until(lambda: app.shared.pages.shown == "review", "the page")
    review = app.shared.recordings.review
    with tabs_of(gated_server.url) as tabs:
        tabs.open()
        opened = until(lambda: review.view().opened, "an open recording", seen=lambda: review.view().problems)
    assert [one.episode.info.seed for one in opened] == [3]


def test_a_page_requested_after_the_end_is_not_waited_for(app: App) -> None:
    """Otherwise a task that is being opened as the program ends would delay its end."""
    app.shared.pages.start("live")
    app.shared.pages.stop()
    assert app.shared.pages.show("review").cancelled()
