"""viser does not send a value that equals the current one: panels assign freely and rely on it.

A page is drawn many times a second. Equal values would be most of the traffic, and the browser rebuilds resent HTML
under the pointer of a user who is about to press it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
import viser
import viser.uplot as uplot

from tests.drive.panels import messages_sent

Make = Callable[[viser.ViserServer], Any]
LINES = np.zeros((2, 2, 3), np.float32)
MAKERS: dict[str, Make] = {
    "html": lambda s: s.gui.add_html("some"),
    "button": lambda s: s.gui.add_button("some", icon=viser.Icon.X),
    "group": lambda s: s.gui.add_button_group("", ("one", "two")),
    "slider": lambda s: s.gui.add_slider("some", min=0, max=9, step=1, initial_value=1),
    "vector": lambda s: s.gui.add_vector3("some", (0.0, 0.0, 0.0)),
    "text": lambda s: s.gui.add_text("some", ""),
    "dropdown": lambda s: s.gui.add_dropdown("some", ("one", "two")),
    "checkbox": lambda s: s.gui.add_checkbox("some", False),
    "folder": lambda s: s.gui.add_folder("some"),
    "panel": lambda s: s.gui.add_panel(),
    "command": lambda s: s.gui.add_command("some"),
    "chart": lambda s: s.gui.add_uplot((np.arange(2.0), np.arange(2.0)), (uplot.Series(), uplot.Series())),
    "image": lambda s: s.gui.add_image(np.zeros((2, 2, 3), np.uint8)),
    "lines": lambda s: s.scene.add_line_segments("/some", LINES, (0, 0, 0)),
    "label": lambda s: s.scene.add_label("/some", "some"),
    "arrows": lambda s: s.scene.add_arrows("/some", LINES, (0, 0, 0)),
    "frustum": lambda s: s.scene.add_camera_frustum("/some", fov=1.0, aspect=1.0),
    "handles": lambda s: s.scene.add_transform_controls("/some"),
}
HALF = np.full(3, 0.5)
TURNED = np.array([0.0, 1.0, 0.0, 0.0])
SKIPPED: tuple[tuple[str, str, object], ...] = (
    ("html", "content", "another"),
    ("html", "visible", False),
    ("button", "label", "another"),
    ("button", "icon", viser.Icon.CHECK),
    ("button", "disabled", True),
    ("button", "visible", False),
    ("group", "options", ("one", "three")),
    ("group", "visible", False),
    ("slider", "min", -3),
    ("slider", "max", 5),
    ("slider", "value", 2),
    ("slider", "disabled", True),
    ("vector", "value", (1.0, 2.0, 3.0)),
    ("text", "value", "typed"),
    ("text", "label", "another"),
    ("dropdown", "value", "two"),
    ("checkbox", "value", True),
    ("folder", "visible", False),
    ("folder", "order", 7.0),
    ("panel", "visible", False),
    ("command", "disabled", True),
    ("chart", "visible", False),
    ("chart", "title", "another"),
    ("image", "format", "png"),
    ("image", "image", np.ones((2, 2, 3), np.uint8)),  # not sent again, but encoded each time
    ("lines", "points", LINES + 1),
    ("lines", "visible", False),
    ("label", "text", "another"),
    ("label", "position", HALF),
    ("arrows", "points", LINES + 1),
    ("frustum", "position", HALF),
    ("frustum", "wxyz", TURNED),
    ("frustum", "fov", 0.5),
    ("handles", "position", HALF),
    ("handles", "wxyz", TURNED),
    ("handles", "scale", 2.0),
    ("handles", "disable_sliders", True),
)
SENT_AGAIN: tuple[tuple[str, str, object], ...] = (
    ("dropdown", "options", ("one", "three")),
    ("chart", "data", (np.arange(2.0), np.ones(2))),
    ("chart", "series", (uplot.Series(), uplot.Series(label="b"))),
)


@pytest.fixture(scope="module")
def server() -> Iterator[viser.ViserServer]:
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    yield server
    server.stop()


def sent_by(server: viser.ViserServer, handle: Any, name: str, value: object) -> int:
    before = messages_sent(server)
    setattr(handle, name, value)
    return messages_sent(server) - before


@pytest.mark.parametrize(("kind", "name", "value"), SKIPPED)
def test_an_equal_value_is_not_sent(server: viser.ViserServer, kind: str, name: str, value: object) -> None:
    handle = MAKERS[kind](server)
    assert sent_by(server, handle, name, value) >= 1
    again = value.copy() if isinstance(value, np.ndarray) else value
    assert sent_by(server, handle, name, again) == 0
    handle.remove()


@pytest.mark.parametrize(("kind", "name", "value"), SENT_AGAIN)
def test_values_that_viser_resends_are_assigned_only_on_change(
    server: viser.ViserServer, kind: str, name: str, value: object
) -> None:
    handle = MAKERS[kind](server)
    assert sent_by(server, handle, name, value) >= 1
    assert sent_by(server, handle, name, value) >= 1
