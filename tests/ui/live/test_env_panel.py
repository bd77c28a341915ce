"""The table's HTML and what its hidden buttons do, on a session with a hand-made scene, without a browser."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest

from tests.drive.panels import Clock, Panels
from tests.drive.session import wait_until
from workbench.session.live.session import Session
from workbench.session.live.view import SessionView
from workbench.ui.live.env_panel import MOST_ROWS, EnvPanel
from workbench.ui.widgets.parts import Parts


def odd(elapsed: np.ndarray) -> dict[str, np.ndarray]:
    return {"<b>odd</b>": elapsed % 2 == 1, "success": np.zeros(len(elapsed), bool)}


@pytest.fixture
def session(scripted_session: Callable[..., Session]) -> Session:
    return scripted_session(MOST_ROWS + 6, odd)


@dataclass
class Envs:
    """The table on a page."""

    parts: Parts[SessionView]
    panels: Panels
    session: Session

    def shown(self) -> list[int]:
        self.parts.draw(self.session.view())
        return [int(env) for env in re.findall(r'data-env="(\d+)"', self.panels.html())]


@pytest.fixture
def envs(panels: Panels, session: Session, clock: Clock) -> Envs:
    envs = Envs(Parts((EnvPanel(panels.server, session),), clock), panels, session)
    panels.press("unfolded")
    return envs


def test_pages_filters_and_rows_are_pressed(envs: Envs) -> None:
    view = envs.session.view
    assert envs.shown() == list(range(MOST_ROWS))
    envs.panels.press("on")
    assert envs.shown() == list(range(MOST_ROWS, MOST_ROWS + 6))
    envs.panels.press(f"env {MOST_ROWS + 2}")
    assert view().selected_env == MOST_ROWS + 2
    # Nothing ended and nothing is odd, so there is no moment to go to.
    assert view().timeline.shown is None
    envs.panels.claim(
        "on", True, "button"
    )  # it is pressed on a page that was drawn before the last one was shown
    assert envs.shown() == list(range(MOST_ROWS, MOST_ROWS + 6))
    envs.panels.press("filter failed")
    assert envs.shown() == [] and "last episode failed." in envs.panels.html()
    envs.panels.press("filter all")
    envs.shown()
    envs.panels.press("sort env")
    assert envs.shown() == list(range(MOST_ROWS + 5, 5, -1))


def test_names_of_entries_are_escaped(envs: Envs) -> None:
    envs.shown()
    assert "&lt;b&gt;odd" in envs.panels.html() and "<b>odd" not in envs.panels.html()


def test_a_table_that_has_not_changed_is_not_sent_again(
    envs: Envs, clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    envs.shown()
    clock.passes()
    monkeypatch.setattr(envs.session, "env_rows", lambda: pytest.fail("asked for rows again"))
    envs.shown()


def test_a_step_is_in_the_table_a_moment_later_and_a_chosen_env_at_once(envs: Envs, clock: Clock) -> None:
    envs.shown()
    before = envs.panels.html()
    envs.session.step()
    wait_until(envs.session, lambda view: view.timeline.last == 1, "a step")
    envs.shown()
    assert envs.panels.html() == before, "it was drawn a moment ago"
    envs.panels.press("env 3")
    envs.shown()
    assert "wb-selected" in envs.panels.html() and envs.panels.html() != before
    envs.session.step()
    wait_until(envs.session, lambda view: view.timeline.last == 2, "another step")
    before = envs.panels.html()
    clock.passes()
    envs.shown()
    assert envs.panels.html() != before


def test_a_folded_table_is_not_drawn_while_steps_go_on(
    panels: Panels, session: Session, clock: Clock
) -> None:
    panel = EnvPanel(panels.server, session)
    envs = Envs(Parts((panel,), clock), panels, session)

    def stepped() -> str:
        last = session.view().timeline.last
        session.step()
        wait_until(session, lambda view: view.timeline.last == last + 1, "a step")
        clock.passes()
        envs.shown()
        return panels.html()

    assert envs.shown() == list(range(MOST_ROWS))  # it does not open empty
    before = panels.html()
    assert stepped() == before
    panel.unfold()
    envs.shown()
    shown = panels.html()
    assert shown != before and stepped() != shown
    panel.fold()
    envs.shown()
    before = panels.html()
    assert stepped() == before
