"""Our own input fields: what a browser gets of them."""

from __future__ import annotations

import json
import re
from html import unescape
from typing import Any

import pytest

from tests.drive.panels import Panels
from workbench.cameras.commands import ChooseLensForm, SetCameraPosition, SetFieldOfView, SetPictureSize
from workbench.live.commands import SetPolicy, SetSeed, SetSpeed, Step
from workbench.page.commands import ShowFrames
from workbench.page.widgets.fields import Field, choice, slider, tick


@pytest.mark.parametrize(
    ("kind", "field", "numbers"),
    [
        (SetSeed, "seed", [0, 2**31 - 1, 1.0, True]),
        (SetFieldOfView, "degrees", [1.0, 175.0, 1.0, False]),
        (SetPictureSize, "to", [8, 4096, 1.0, True]),
        (SetSpeed, "speed", [0, None, 1.0, False]),
        (SetPolicy, "policy", None),
    ],
)
def test_a_browser_refuses_numbers_outside_of_the_commands_bounds(
    panels: Panels, kind: Any, field: str, numbers: list[object] | None
) -> None:
    Field(panels.server, "It", kind, field, "", given=[{"of": "width"} if field == "to" else {}])
    found = re.search('data-number="([^"]*)"', panels.html("data-field"))
    assert (None if found is None else json.loads(unescape(found[1]))) == numbers


def test_a_row_has_an_input_for_each_part_and_is_sent_with_it(panels: Panels) -> None:
    given = [{"of": "x"}, {"of": "y"}]
    row = Field(panels.server, "Position", SetCameraPosition, "to", (1.0, 2.0), given=given, step=0.5)
    field = panels.field("Position")
    assert field.value == (1.0, 2.0) and field.command(7.0, 1) == SetCameraPosition(of="y", to=7.0)
    row.show((3.0, 4.0), off=True)
    assert panels.field("Position").value == (3.0, 4.0) and panels.field("Position").off
    assert json.loads(unescape(re.findall('data-number="([^"]*)"', panels.html())[1]))[2] == 0.5
    row.visible = False
    assert not panels.shows("Position") and not row.visible
    row.visible = True
    row.remove()
    assert not panels.shows("Position")


def test_a_sliders_bounds_stay_until_others_are_shown(panels: Panels) -> None:
    made = slider(panels.server, "Degrees", SetFieldOfView, "degrees")
    assert panels.field("Degrees").bounds == (1.0, 175.0) and panels.field("Degrees").value == 1.0
    made.show(20.0, bounds=(10.0, 30.0))
    made.show(25.0)
    assert panels.field("Degrees").bounds == (10.0, 30.0) and panels.field("Degrees").value == 25.0
    other = slider(panels.server, "Narrow", SetFieldOfView, "degrees", (40.0, 50.0), done=SetFieldOfView)
    assert (
        panels.field("Narrow").bounds == (40.0, 50.0) and panels.field("Narrow").done == "set_field_of_view"
    )
    assert other.order > made.order


def test_a_choice_and_a_tick_send_their_value(panels: Panels) -> None:
    lens = choice(
        panels.server,
        "Lens",
        ChooseLensForm,
        "form",
        {"angle": "field of view", "matrix": "intrinsic matrix"},
        "intrinsic matrix",
    )
    field = panels.field("Lens")
    assert field.value == "matrix" and field.command("angle") == ChooseLensForm(form="field of view")
    lens.show("field of view", options={"other": "field of view"})
    assert panels.field("Lens").value == "other" and list(panels.field("Lens").options) == ["other"]
    shown = tick(panels.server, "Frames", ShowFrames, "on", True)
    assert panels.field("Frames").value is True and panels.field("Frames").command(False) == ShowFrames(
        on=False
    )
    shown.show(False)
    assert panels.field("Frames").value is False


def test_a_text_may_be_long_or_live_and_enter_may_send_another_command(panels: Panels) -> None:
    Field(panels.server, "Policy", SetPolicy, "policy", "a<b", longest=50, live=True, enter=Step())
    html = panels.html("data-field")
    assert 'maxlength="50"' in html and "data-live" in html and "a&lt;b" in html
    assert re.findall('data-enter="([^"]*)"', html) and panels.field("Policy").value == "a<b"
    box = Field(panels.server, "Text", SetPolicy, "policy", lines=4)
    assert 'rows="4"' in panels.html("<textarea") and box.name.startswith("text.set_policy")
