"""The whole page on a real session and a real server, without a browser."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
import viser
import websockets.sync.client

from tests.drive.panels import Clock, Panels
from tests.drive.session import TASKS, wait_until
from tests.drive.tabs import handshake, messages_in
from workbench.app.live_page import Page
from workbench.app.session import Session
from workbench.live.commands import PauseRun, PlayRun, ResetAll, Step
from workbench.live.env_commands import ToggleOnlySelected
from workbench.live.view import SessionView
from workbench.task.description import TaskOptions

WAITS = """

import pathlib, time
while not pathlib.Path(__file__).with_name("drawn").exists():
    time.sleep(0.01)
"""
"""Delays the load: a forked worker would load the task before a busy page is drawn for the first time."""


@pytest.fixture(scope="module")
def task_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("author") / "minimal.py"
    file.write_text((TASKS / "minimal.py").read_text() + WAITS)
    return file


@dataclass
class Opened:
    """A page, its session and its contents."""

    page: Page
    session: Session
    panels: Panels
    clock: Clock

    def draw(self) -> None:
        self.clock.passes()
        self.page.redraw()

    def load(self) -> SessionView:
        # The heartbeat of a slow load is read for a moment longer.
        loaded = lambda view: view.task is not None and view.busy is None  # noqa: E731
        view = wait_until(self.session, loaded, "the load")
        self.draw()
        return view

    def banner(self) -> bool:
        return self.panels.part("Problem").seen


@pytest.fixture(scope="module")
def opened(
    child_process: None, task_file: Path, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Opened]:
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    session = Session(
        str(task_file), TaskOptions(num_envs=3), recordings=tmp_path_factory.mktemp("recordings")
    )
    panels, clock = Panels(server), Clock()
    page = Page(server, panels.visitors, session, clock=clock)
    panels.visitors.do = page.do
    panels.do(ToggleOnlySelected())
    page.redraw()
    task_file.with_name("drawn").touch()
    yield Opened(page, session, panels, clock)
    session.close()
    server.stop()


def test_the_page_names_what_it_waits_for_and_then_shows_the_scene(opened: Opened) -> None:
    # The fixture drew the page before the task was loaded.
    run = opened.panels.part("Run")
    transport = opened.panels
    assert transport.button("Play").command is None and not run.presses(ResetAll())
    view = opened.load()
    assert transport.button("Play").command is not None and run.presses(ResetAll())
    assert "env 0" in opened.panels.html("wb-view-icons")
    assert all(opened.panels.bodies(name) for name in ("cube", "panda_hand", "ground"))
    assert "3 envs" in opened.panels.html("wb-status")
    run.set("Source", "sliders")
    wait_until(opened.session, lambda view: view.settings.action_source == "sliders", "the sliders")
    opened.draw()
    assert view.task is not None and all(run.shows(action.name) for action in view.task.actions)
    run.set("Source", "hold still")
    opened.panels.set("Pictures", "fast")
    assert opened.session.view().settings.pictures == "fast"
    opened.draw()
    assert opened.panels.field("Pictures").value == "fast"
    opened.panels.set("Pictures", "auto")


def test_a_step_moves_the_robots_and_fills_the_numbers(opened: Opened) -> None:
    opened.load()
    hand = opened.panels.bodies("panda_hand")[0]
    before = hand.batched_positions.copy()
    opened.session.change(action_source="random")
    serial = opened.session.view().step_serial
    opened.session.do(Step())
    wait_until(opened.session, lambda view: view.step_serial > serial, "a step")
    opened.draw()
    assert (hand.batched_positions != before).any(axis=1).all()
    assert "success" in opened.panels.part("Reward").html()
    assert "of 3" in opened.panels.part("Reward").html()


def test_while_playing_a_press_is_shown_at_once_and_the_robots_move_every_frame(
    opened: Opened,
) -> None:
    # The page's clock stands still, so the panels are not due.
    opened.load()
    hand, session = opened.panels.bodies("panda_hand")[0], opened.session
    session.change(action_source="random")
    session.do(PlayRun())
    wait_until(session, lambda view: view.state == "running" and view.steps_per_second > 0, "the play")
    for _ in range(2):
        opened.page.redraw()
        assert opened.panels.shows("Pause")
        before, serial = hand.batched_positions.copy(), session.view().step_serial
        wait_until(session, lambda view, serial=serial: view.step_serial > serial + 5, "further steps")
        opened.page.redraw()
        assert (hand.batched_positions != before).any()
    session.change(selected_env=1)
    opened.page.redraw()
    assert "env 1" in opened.panels.html("wb-view-icons")
    session.do(PauseRun())
    opened.page.redraw()
    assert opened.panels.shows("Play")
    wait_until(session, lambda view: view.state == "paused", "the pause")


def test_panel_changes_of_a_press_are_sent_separately_from_the_view(
    opened: Opened, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A browser applies a batch with any view message at the view's next frame, which may take long.
    opened.load()
    monkeypatch.setattr("workbench.app.pages.PANELS_TIMEOUT_SECONDS", 10.0)
    opened.session.change(selected_env=0)
    opened.draw()
    address, options = handshake(f"http://127.0.0.1:{opened.panels.server.get_port()}")
    with websockets.sync.client.connect(address, **options) as connection:

        def kinds_until(last: str) -> list[set[str]]:
            batches: list[set[str]] = []
            while not batches or last not in batches[-1]:
                frame = connection.recv(timeout=30)
                assert isinstance(frame, bytes)
                batches.append({message["type"] for message in messages_in(frame)})
            return batches

        kinds_until("ReplayDoneMessage")
        opened.session.change(selected_env=1)
        opened.draw()
        *panels, view = kinds_until("SceneNodeUpdateMessage")
    assert any("GuiUpdateMessage" in batch for batch in panels)
    assert "GuiUpdateMessage" not in view


def test_a_broken_file_is_reported_and_the_scene_stays(opened: Opened, task_file: Path) -> None:
    good = task_file.read_text(encoding="utf-8")
    opened.load()
    shown = opened.panels.bodies("")
    task_file.write_text(good.replace("self.cube.pose.p", "self.cube.pose.nothing"), encoding="utf-8")
    view = wait_until(opened.session, lambda view: view.problem is not None, "the problem")
    opened.draw()
    assert opened.banner()
    assert (
        view.problem is not None and f"minimal.py:{view.problem.line}" in opened.panels.part("Problem").html()
    )
    assert "nothing" in opened.panels.part("Problem").html()
    assert all(new is old for new, old in zip(opened.panels.bodies(""), shown, strict=True))
    task_file.write_text(good, encoding="utf-8")
    wait_until(
        opened.session, lambda view: view.problem is None and view.task_serial > 1, "the fixed version"
    )
    opened.draw()
    assert not opened.banner()
    # The same meshes are not sent again.
    assert all(new is old for new, old in zip(opened.panels.bodies(""), shown, strict=True))
