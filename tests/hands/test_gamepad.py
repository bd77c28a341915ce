"""Driving by gamepad: what its controls do, and what a page reports."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.drive.live import Live
from tests.drive.scenes import running
from workbench.hands.commands import DriveRobot
from workbench.hands.drive_keys import GRIPPER_KEY, PAIRS, driven_action
from workbench.hands.gamepad import LABELS, pad_amounts, pad_grips
from workbench.hands.state import Driven
from workbench.task.description import ActionDimension

ARM = tuple(ActionDimension(f"arm/{axis}", -1.0, 1.0) for axis in ("x", "y", "z", "rx", "ry", "rz"))
REST = (0.0,) * 4
UNIT = st.floats(-1, 1)


def buttons(*held: int, by: float = 1.0) -> tuple[float, ...]:
    return tuple(by if k in held else 0.0 for k in range(17))


@given(st.lists(UNIT, max_size=8), st.lists(st.floats(0, 1), max_size=20), st.floats(-math.pi, math.pi))
def test_any_deflection_gives_an_action_within_the_bounds(
    axes: list[float], held: list[float], yaw: float
) -> None:
    amounts = pad_amounts(axes, held)
    assert len(amounts) == len(PAIRS) == len(LABELS) and all(-1 <= amount <= 1 for amount in amounts)
    assert all(-1 <= value <= 1 for value in driven_action(ARM, ("w", "e"), yaw, amounts)[1])


@pytest.mark.parametrize(
    ("axes", "held", "which", "sign"),
    [
        ((0, -1, 0, 0), buttons(), "x", 1),
        ((-1, 0, 0, 0), buttons(), "y", 1),
        ((0, 0, 0, -1), buttons(), "z", 1),
        (REST, buttons(7), "z", 1),
        (REST, buttons(6), "z", -1),
        (REST, buttons(5), "rx", 1),
        (REST, buttons(4), "rx", -1),
        (REST, buttons(12), "ry", 1),
        ((0, 0, -1, 0), buttons(), "rz", 1),
    ],
)
def test_each_control_moves_one_axis(
    axes: tuple[float, ...], held: tuple[float, ...], which: str, sign: int
) -> None:
    values = driven_action(ARM, (), 0.0, pad_amounts(axes, held))[1]
    assert values == tuple(float(sign) if one.name == f"arm/{which}" else 0.0 for one in ARM)


def test_the_left_stick_moves_as_the_person_sees_it() -> None:
    values = driven_action(ARM, (), math.pi / 2, pad_amounts((0, -1, 0, 0), ()))[1]
    assert values[:2] == pytest.approx((0, 1), abs=1e-9)


def test_a_stick_at_rest_or_slightly_off_moves_nothing_and_half_way_moves_slower() -> None:
    assert not any(pad_amounts((0.1, -0.1, 0.05, 0.1), buttons(6, 7, by=0.1)))
    assert not any(pad_amounts((), ()))
    assert 0.3 < pad_amounts((0, -0.5, 0, 0), ())[0] < 0.6
    assert pad_grips(buttons(0)) and not pad_grips(buttons(1)) and not pad_grips(())


def test_a_page_reports_keys_and_gamepad_together(live_page: Live) -> None:
    view = running(2)
    assert view.task is not None
    live_page.show(replace(view, task=replace(view.task, actions=ARM)))
    live_page.do(DriveRobot(keys=("w", "unknown"), axes=(0, 0, 0, -1), buttons=buttons(0)))
    driven = live_page.asked[-1]
    assert isinstance(driven, Driven) and driven.keys == ("w", GRIPPER_KEY)
    assert driven.sticks == (0, 0, 1, 0, 0, 0, 0)
    live_page.do(DriveRobot(keys=()))
    assert live_page.asked[-1].keys == () and live_page.asked[-1].sticks == ()
