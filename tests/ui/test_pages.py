"""The live page and the review on one server, swapped over and over; nothing is left behind."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import viser

from tests.session.conftest import TASKS, wait_until
from tests.session.recordings import begin, made, write
from workbench.session.messages import TaskOptions
from workbench.session.session import Session
from workbench.ui.page import Page
from workbench.ui.put_together import Workplace
from workbench.ui.review_page import ReviewPage

SWAPS = 20


@pytest.fixture
def place(tmp_path: Path, server: viser.ViserServer) -> Iterator[Workplace]:
    write(tmp_path, made(5))
    session = Session(str(TASKS / "minimal.py"), TaskOptions(num_envs=2), recordings=tmp_path)
    place = Workplace(server, tmp_path, session)
    yield place
    place.close()
    session.close()


def counts(server: viser.ViserServer) -> dict[str, int]:
    # viser keeps a word for each thing that went until the next page comes, and sweeps them together then.
    server._run_garbage_collector(force=True)
    gui = server.gui
    return {
        "inputs": len(gui._gui_input_handle_from_uuid),
        "containers": len(gui._container_handle_from_uuid),
        "panels": len(gui._panel_handle_from_uuid),
        "commands": len(gui._command_handle_from_uuid),
        "nodes": len(server.scene._handle_from_node_name),
        "clicks": len(server.scene._scene_pointer_cb),
        "messages": len(server._websock_server._broadcast_buffer.message_from_id),
    }


@pytest.mark.slow
def test_twenty_swaps_leave_nothing_and_the_session_lives_on(
    place: Workplace, server: viser.ViserServer
) -> None:
    session = place.session
    assert session is not None
    wait_until(session, lambda view: view.task is not None, "the task")
    place.pages.start("live")
    session.play()
    seen: dict[str, list[dict[str, int]]] = {"live": [], "review": []}
    threads: list[int] = []
    for number in range(SWAPS):
        which = "review" if number % 2 == 0 else "live"
        place.pages.show(which)
        assert place.pages.wait_for(which, timeout=60)
        page = place.pages._page
        assert isinstance(page, (Page, ReviewPage))
        page.redraw()
        seen[which].append(counts(server))
        threads.append(threading.active_count())
    for found in seen.values():
        # The first of each may draw what the next ones have at once.
        for name, count in found[-1].items():
            # What a part draws some moments later is there or not yet.
            assert count <= found[1][name] + (40 if name == "messages" else 0), (name, found)
    assert max(threads[4:]) <= max(threads[:4])
    before = session.view().step_serial
    wait_until(session, lambda view: view.step_serial > before, "a step of the env that plays on")


def test_an_episode_whose_writer_was_killed_is_mended_and_said(
    tmp_path: Path, server: viser.ViserServer
) -> None:
    begin(tmp_path, made(5, seed=8))
    place = Workplace(server, tmp_path)
    place.pages.start("review")
    try:
        until(lambda: "can be seen again" in " ".join(place.shelf.review.view().problems), "the word for it")
        until(lambda: [row.seed for row in place.shelf.library.rows()] == [8], "its row")
    finally:
        place.close()


def test_serving_the_pages_needs_no_simulator() -> None:
    said = subprocess.run(
        [sys.executable, "-c", "import sys, workbench.page_command; print(*sys.modules)"],
        check=True,
        capture_output=True,
        text=True,
    ).stdout.split()
    assert not {"torch", "sapien", "mani_skill", "libcst"} & set(said)


def until(reached: Callable[[], bool], what: str) -> None:
    deadline = time.monotonic() + 60
    while not reached():
        assert time.monotonic() < deadline, f"{what} did not come"
        time.sleep(0.02)


def test_what_is_open_in_the_review_is_open_when_one_comes_back(place: Workplace) -> None:
    place.pages.start("review")
    review, library = place.shelf.review, place.shelf.library
    library.refresh()
    review.open([library.rows()[0].id])
    place.pages.show("live")
    assert place.pages.wait_for("live", timeout=60)
    place.pages.show("review")
    assert place.pages.wait_for("review", timeout=60)
    assert place.shelf.review is review
