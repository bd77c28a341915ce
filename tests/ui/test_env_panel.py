"""The table's HTML and what its hidden buttons do, on a real session without a browser."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
import viser

from tests.session.conftest import TASKS, wait_until
from workbench.session.messages import TaskOptions
from workbench.session.session import Session
from workbench.ui.env_panel import MOST_ROWS, EnvPanel
from workbench.ui.viser_seam import element_id


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Session]:
    folder = tmp_path_factory.mktemp("author")
    file = Path(shutil.copy(TASKS / "minimal.py", folder / "minimal.py"))
    file.write_text(
        file.read_text().replace('{"success":', '{"<b>odd</b>": self.elapsed_steps % 2 == 1, "success":')
    )
    options = TaskOptions(num_envs=MOST_ROWS + 6, env_kwargs={"render_backend": "none"})
    session = Session(str(file), options, recordings=folder / "kept")
    view = wait_until(session, lambda v: v.task is not None or v.problem is not None, "the load")
    assert view.task is not None, view.problem
    yield session
    session.close()


def press(panel: EnvPanel, server: viser.ViserServer, key: object) -> None:
    """As the browser does: the button with this id."""
    uuid = panel._presses._ids[key]  # type: ignore[index]
    handle = server.gui._gui_input_handle_from_uuid[uuid]
    assert element_id(handle) == uuid  # type: ignore[arg-type]
    for callback in handle._impl.update_cb:
        callback(viser.GuiEvent(None, None, handle))  # type: ignore[arg-type]


def shown(panel: EnvPanel, session: Session) -> list[int]:
    panel.draw(session.view())
    return [int(env) for env in re.findall(r'data-env="(\d+)"', panel._handle.content)]


def test_pages_filters_and_rows_are_pressed(server: viser.ViserServer, session: Session) -> None:
    panel = EnvPanel(server, session)
    assert shown(panel, session) == list(range(MOST_ROWS))
    press(panel, server, "on")
    assert shown(panel, session) == list(range(MOST_ROWS, MOST_ROWS + 6))
    press(panel, server, ("env", MOST_ROWS + 2))
    assert session.view().selected_env == MOST_ROWS + 2
    # Nothing ended and nothing is odd, so there is no moment to go to.
    assert session.view().timeline.shown is None
    press(panel, server, "on")
    assert shown(panel, session) == list(range(MOST_ROWS, MOST_ROWS + 6))
    press(panel, server, ("filter", "failed"))
    assert shown(panel, session) == [] and "In no env did the last episode fail" in panel._handle.content
    press(panel, server, ("filter", "all"))
    press(panel, server, ("sort", "env"))
    assert shown(panel, session) == list(range(MOST_ROWS + 5, 5, -1))


def test_names_of_entries_are_escaped(server: viser.ViserServer, session: Session) -> None:
    panel = EnvPanel(server, session)
    panel.draw(session.view())
    assert "&lt;b&gt;odd" in panel._handle.content and "<b>odd" not in panel._handle.content


def test_a_table_that_has_not_changed_is_not_sent_again(
    server: viser.ViserServer, session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    panel = EnvPanel(server, session)
    panel.draw(session.view())
    panel._drawn_at = 0.0
    monkeypatch.setattr(session, "env_rows", lambda: pytest.fail("asked for rows again"))
    panel.draw(session.view())
