"""The box of the spawn range on a page: where it is drawn, and what a drag of its sides asks of the session."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.drive.hands import OFFSET, PAGE, Hands
from tests.drive.live import Live
from tests.drive.panels import Panels
from tests.drive.scenes import running
from workbench.hands.commands import HideSpawn, SetSpawnSide, ShowSpawn
from workbench.hands.spawn import SpawnAsked, SpawnBox, SpawnDragged
from workbench.live.commands import SelectBody

RANGES = (-0.1, 0.3), (-0.2, 0.2)
BOX = SpawnBox("measured", 1, "cube", RANGES, RANGES, RANGES)


class Page:
    """The panel with a cube selected in env 1, and this box in the session."""

    def __init__(self, panels: Panels, box: SpawnBox = BOX) -> None:
        self.panels, self.hands = panels, Hands(panels)
        self.show(box)

    def show(self, box: SpawnBox) -> None:
        self.hands.view = replace(self.hands.view, features={**self.hands.view.features, SpawnBox: box})
        self.hands.session.shown = self.hands.view
        self.hands.redraw()

    def gizmo(self, side: str) -> Any:
        (gizmo,) = self.panels.nodes(f"/hands/spawn/{side}")
        return gizmo

    @property
    def spawn(self):  # type: ignore[no-untyped-def]
        return self.hands.panel.spawn


@pytest.fixture
def page(panels: Panels) -> Page:
    return Page(panels)


def test_the_handles_are_at_the_sides_of_the_box_in_the_selected_env(page: Page) -> None:
    height = page.hands.pose[2]
    for side, at in {
        "x_min": (-0.1, 0),
        "x_max": (0.3, 0),
        "y_min": (0.1, -0.2),
        "y_max": (0.1, 0.2),
    }.items():
        np.testing.assert_allclose(page.gizmo(side).position, np.array([*at, height]) + OFFSET, atol=1e-6)
        assert page.gizmo(side).visible


def test_the_box_of_another_body_and_a_side_that_is_not_drawn_have_no_handles(page: Page) -> None:
    page.show(replace(BOX, measured=(RANGES[0], None), wanted=(RANGES[0], None)))
    assert page.gizmo("x_min").visible and not page.gizmo("y_min").visible
    page.show(replace(BOX, body="table"))
    assert not page.gizmo("x_min").visible


def test_a_drag_reports_the_side_in_the_frame_of_the_env_and_belongs_to_one_page(page: Page) -> None:
    to = np.array([0.5, 0.7, 0.9]) + OFFSET
    page.spawn.drag(PAGE, "x_max", "start", to)
    page.spawn.drag(PAGE + 1, "x_max", "update", to + 1)
    page.spawn.drag(PAGE, "y_min", "update", to + 1)
    page.spawn.drag(PAGE, "x_max", "end", to)
    page.spawn.drag(PAGE, "y_min", "end", to)
    assert page.hands.session.asked == [
        SpawnDragged("x_max", pytest.approx(0.5)),  # type: ignore[arg-type]
        SpawnDragged("x_max", pytest.approx(0.5)),  # type: ignore[arg-type]
        SpawnDragged("y_min", pytest.approx(0.7)),  # type: ignore[arg-type]
    ]


def test_a_dragged_handle_stays_under_the_pointer_until_its_page_lets_go(page: Page) -> None:
    wider = replace(BOX, wanted=((-0.1, 0.5), RANGES[1]))
    page.spawn.drag(PAGE, "x_max", "start", np.zeros(3))
    page.show(wider)
    assert page.gizmo("x_max").position[0] == pytest.approx(0.3 + OFFSET[0])
    page.spawn.end_lost_drag()  # the page has closed
    page.show(wider)
    assert page.gizmo("x_max").position[0] == pytest.approx(0.5 + OFFSET[0])


def test_the_tool_asks_for_the_range_of_the_selected_body_and_hides_it(live_page: Live) -> None:
    live_page.do(SelectBody(body="cube"))
    view = replace(running(3, selected_env=1), playing=False)
    live_page.show(view)
    live_page.do(ShowSpawn())
    assert live_page.asked[-1] == SpawnAsked("cube")
    live_page.show(replace(view, features={SpawnBox: BOX}))
    inspect = live_page.part("Inspect")
    assert inspect.shows("x from, to")
    live_page.do(SetSpawnSide("x_min", 0.05))
    assert live_page.asked[-1] == SetSpawnSide("x_min", 0.05)
    live_page.do(HideSpawn())
    assert live_page.asked[-1] == HideSpawn()
