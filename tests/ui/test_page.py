"""The whole page on a real session and a real server, drawn without a browser."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
import viser
import websockets.sync.client

from tests.session.conftest import TASKS, wait_until
from tests.ui.tabs import handshake, messages_in
from workbench.session.messages import TaskOptions
from workbench.session.session import Session
from workbench.ui.page import Page


@pytest.fixture(scope="module")
def task_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return Path(shutil.copy(TASKS / "minimal.py", tmp_path_factory.mktemp("author") / "minimal.py"))


@pytest.fixture(scope="module")
def page(task_file: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    session = Session(
        str(task_file), TaskOptions(num_envs=3), recordings=tmp_path_factory.mktemp("recordings")
    )
    page = Page(server, session)
    page.redraw()
    yield page
    session.close()
    server.stop()


def test_says_what_it_waits_for_and_then_shows_the_scene(page: Page) -> None:
    # The fixture drew it before there was a task.
    assert page._run._play.disabled
    assert not page._run._transport.visible
    view = wait_until(page._session, lambda view: view.task is not None, "the first load")
    page.redraw()
    assert not page._run._play.disabled
    assert page._run._transport.visible
    assert page._run._env.handle.max == 2
    names = " ".join(handle.name for handle in page._scene.handles)
    assert "cube" in names and "panda_hand" in names and "ground" in names
    assert "3 envs" in page._status._handle.content
    assert view.task is not None and len(page._run._sliders._controls) == len(view.task.actions)


def test_a_step_moves_the_robots_and_fills_the_numbers(page: Page) -> None:
    wait_until(page._session, lambda view: view.task is not None, "the load")
    page.redraw()
    hand = next(handle for handle in page._scene.handles if "panda_hand" in handle.name)
    before = hand.batched_positions.copy()
    page._session.set_action_source("random")
    serial = page._session.view().step_serial
    page._session.step()
    wait_until(page._session, lambda view: view.step_serial > serial, "a step")
    page._numbers._drawn_at = 0.0
    page.redraw()
    assert (hand.batched_positions != before).any(axis=1).all()
    assert "success" in page._numbers._handle.content
    assert "of 3" in page._numbers._handle.content


def test_selecting_an_env_moves_its_mark(page: Page) -> None:
    wait_until(page._session, lambda view: view.task is not None, "the load")
    page._session.select_env(2)
    page.redraw()
    assert page._mark._label is not None and page._mark._label.text == "env 2"
    assert page._run._env.handle.value == 2
    page._run.select_neighbour(1)
    assert page._session.view().selected_env == 0


def test_what_a_press_changes_on_the_panels_comes_apart_from_the_view(
    page: Page, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A browser applies a batch with anything of the view in it at its next frame of the view, which may take long.
    wait_until(page._session, lambda view: view.task is not None, "the load")
    monkeypatch.setattr("workbench.ui.drawn_apart.SENT_WITHIN", 10.0)
    page._session.select_env(0)
    page.redraw()
    address, options = handshake(f"http://127.0.0.1:{page._server.get_port()}")
    with websockets.sync.client.connect(address, **options) as connection:

        def kinds_until(last: str) -> list[set[str]]:
            batches: list[set[str]] = []
            while not batches or last not in batches[-1]:
                frame = connection.recv(timeout=30)
                assert isinstance(frame, bytes)
                batches.append({message["type"] for message in messages_in(frame)})
            return batches

        kinds_until("ReplayDoneMessage")
        page._session.select_env(1)
        page.redraw()
        *panels, view = kinds_until("SceneNodeUpdateMessage")
    assert any("GuiUpdateMessage" in batch for batch in panels)
    assert "GuiUpdateMessage" not in view


def test_one_env_alone_is_one_instance_of_each_shape(page: Page) -> None:
    wait_until(page._session, lambda view: view.task is not None, "the load")
    page._view_panel.toggle_only_selected()
    page.redraw()
    hand = next(handle for handle in page._scene.handles if "panda_hand" in handle.name)
    assert hand.batched_positions.shape == (1, 3)
    assert page._mark._label is None
    page._view_panel.toggle_only_selected()
    page.redraw()
    assert all(len(h.batched_positions) == 3 for h in page._scene.handles if "panda_hand" in h.name)


def test_broken_file_is_said_and_the_scene_stays(page: Page, task_file: Path) -> None:
    good = task_file.read_text(encoding="utf-8")
    wait_until(page._session, lambda view: view.task is not None, "the load")
    page.redraw()
    shown = page._scene.handles
    task_file.write_text(good.replace("self.cube.pose.p", "self.cube.pose.nothing"), encoding="utf-8")
    view = wait_until(page._session, lambda view: view.problem is not None, "the problem")
    page.redraw()
    assert page._banner._panel.visible
    assert view.problem is not None and f"minimal.py:{view.problem.line}" in page._banner._html.content
    assert "nothing" in page._banner._html.content
    assert all(new is old for new, old in zip(page._scene.handles, shown, strict=True))
    task_file.write_text(good, encoding="utf-8")
    wait_until(
        page._session, lambda view: view.problem is None and view.task_serial > 1, "the mended version"
    )
    page.redraw()
    assert not page._banner._panel.visible
    # The same shapes are not sent again.
    assert all(new is old for new, old in zip(page._scene.handles, shown, strict=True))
