"""Opening an empty file: the page offers to write the minimal task into it, and then runs that task."""

from __future__ import annotations

from pathlib import Path

import pytest
import viser

from tests.drive.panels import Clock, Panels
from tests.drive.session import wait_until
from workbench.app.live_page import Page
from workbench.app.session import Session
from workbench.live.panels.banners import FILL
from workbench.task.description import TaskOptions


@pytest.mark.slow
def test_a_press_turns_an_empty_file_into_a_running_task(child_process: None, tmp_path: Path) -> None:
    file = tmp_path / "stack_two.py"
    file.write_text("# to be written\n")
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    session = Session(str(file), TaskOptions(num_envs=2), recordings=tmp_path / "recordings")
    try:
        panels, clock = Panels(server), Clock()
        page = Page(server, panels.visitors, session, clock=clock)
        panels.visitors.do = page.do
        view = wait_until(session, lambda view: view.problem is not None, "the problem")
        assert view.problem is not None and "`workbench new`" in view.problem.message
        clock.passes()
        page.redraw()
        assert file.read_text() == "# to be written\n"
        panels.press(FILL)
        view = wait_until(session, lambda view: view.task is not None, "the task")
        assert view.task is not None and view.task.env_id == "StackTwo-v1"
        clock.passes()
        page.redraw()
        assert not panels.part("Problem").seen
    finally:
        session.close()
        server.stop()
