from __future__ import annotations

from dataclasses import dataclass

import pytest

from tests.drive.panels import Clock, Panels
from workbench.ui.widgets.inputs import HANDS_OFF, Control


@dataclass
class Slider:
    """A slider for an env, with what the session was asked for."""

    control: Control
    panels: Panels
    clock: Clock
    sent: list[int]

    @property
    def value(self) -> int:
        return self.panels.control("env").value


def make(panels: Panels, clock: Clock, settle: float) -> Slider:
    sent: list[int] = []
    slider = panels.server.gui.add_slider("env", min=0, max=15, step=1, initial_value=0)
    control = Control(slider, sent.append, settle=settle, clock=clock)
    return Slider(control, panels, clock, sent)


@pytest.fixture
def slider(panels: Panels, clock: Clock) -> Slider:
    return make(panels, clock, 0.0)


def test_what_the_session_says_is_shown_and_not_sent_back(slider: Slider) -> None:
    slider.control.show(5)
    slider.panels.settle()
    assert slider.value == 5 and slider.sent == []


def test_slider_in_someone_s_hand_is_left_alone_for_a_moment(slider: Slider) -> None:
    slider.panels.set("env", 7)
    slider.clock.passes(HANDS_OFF - 0.01)
    slider.control.show(3)
    assert slider.value == 7
    slider.clock.passes(0.02)
    slider.control.show(3)
    assert slider.value == 3


def test_value_out_of_range_is_refused_with_a_word_and_taken_back(slider: Slider) -> None:
    slider.panels.claim("env", 99999)
    assert slider.sent == [] and "0 to 15" in slider.panels.client.notices[0]
    slider.control.show(2)
    assert slider.value == 2


def test_what_is_half_typed_stays_until_it_was_sent(panels: Panels, clock: Clock) -> None:
    slider = make(panels, clock, 0.75)
    panels.set("env", 12)
    began = clock.now
    for after in (0.0, 0.625, 0.7421875):  # longer than hands are kept off an input that does not settle
        clock.now = began + after
        slider.control.show(3)
        assert (slider.value, slider.sent) == (12, [])
    clock.now = began + 0.75
    slider.control.show(3)
    assert (slider.value, slider.sent) == (12, [12])
    clock.now = began + 1.125
    slider.control.show(3)
    assert (slider.value, slider.sent) == (12, [12]), "the session has not taken it yet"
    clock.now = began + 1.375
    slider.control.show(3)
    assert (slider.value, slider.sent) == (3, [12])
