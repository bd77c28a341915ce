"""Reports computed from hand-checkable pixel counts and depths; `test_visibility` measures real ones."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from workbench.pictures.camera_report import (
    CameraReport,
    DepthReport,
    ObjectSeen,
    join_reports,
    report_text,
    size_text,
)
from workbench.pictures.camera_search import score_of

NAN = float("nan")


def thing(name: str = "cube", **given: Any) -> ObjectSeen:
    """Return an object that is fully visible with 100 pixels in one env; `given` overrides, with one number per env."""
    values: dict[str, Any] = {"pixels": 100, "unhindered": None, "alone": None, "cut": False, "margin": 0.25}
    values |= {"present": True, "never_drawn": False, "scenery": False, **given}
    for less, more in (("pixels", "unhindered"), ("unhindered", "alone")):
        values[more] = values[less] if values[more] is None else values[more]
    never_drawn, scenery = values.pop("never_drawn"), values.pop("scenery")
    count = max(np.size(value) for value in values.values())
    kinds = {"present": bool, "cut": bool}
    arrays: Any = {
        name: np.broadcast_to(np.array(value, kinds.get(name, np.float32)), count)
        for name, value in values.items()
    }
    return ObjectSeen(name, never_drawn, scenery, **arrays)


def depth(nearest: Any = 1.0, farthest: Any = 2.0) -> DepthReport:
    ones = np.ones(np.size(nearest), np.float32)
    near, far = (np.atleast_1d(np.array(value, np.float32)) for value in (nearest, farthest))
    return DepthReport(np.ones((len(ones), 40), np.int64), ones * 0.5, ones * 0.25, near, far)


def report(*objects: ObjectSeen, envs: tuple[int, ...] = (0,), **given: Any) -> CameraReport:
    plain = CameraReport(("sensor", "eye"), (8, 6), (4, 3), envs, objects, depth(), 3, 1.5)
    return replace(plain, **given)


def test_a_summary_covers_the_envs_that_have_the_object() -> None:
    seen = thing(
        pixels=[25, 0, 0, 70, 999],
        unhindered=[50, 0, 40, 70, 999],
        alone=[100, 100, 40, 70, 999],
        cut=[True, False, False, False, True],
        present=[True, True, True, True, False],
    )
    assert seen.summary().__dict__ == {
        "present": 4,
        "seen": 0.5,
        "median_pixels": 12.5,
        "cut": 0.25,
        "hidden": 0.5,  # mean of 0.5, 1 and 0, over the three envs in whose view it is without the robot
        "wholly_hidden": 0.25,
        "covered": 0.375,
    }
    absent = thing(present=False).summary()
    assert absent.present == 0
    assert_array_equal([value for name, value in absent.__dict__.items() if name != "present"], [NAN] * 6)
    away = thing(pixels=0).summary()
    assert (away.seen, away.wholly_hidden) == (0, 0) and np.isnan([away.hidden, away.covered]).all()


def test_an_envs_mark_is_that_of_its_worst_wanted_object() -> None:
    envs = (4, 0, 2, 1)
    cube = thing("cube", pixels=[100, 25, 100, 0], present=[True, True, False, True])
    ball = thing("ball", pixels=[25, 100, 100, 100], present=[True, True, False, True])
    table = thing("table", pixels=[0] * 4, scenery=True)
    goal = thing("goal", pixels=[0] * 4, never_drawn=True)
    found = report(cube, ball, table, goal, envs=envs)
    assert [one.name for one in found.wanted_objects()] == ["cube", "ball"]
    assert_array_equal(found.env_marks(), np.array([0.5, 0.5, NAN, 0], np.float32))
    assert found.worst_first() == (3, 0, 1, 2)
    assert_array_equal(found.env_marks(["ball"]), np.array([0.5, 1, NAN, 1], np.float32))
    assert found.worst_first(["ball"]) == (0, 1, 3, 2)
    assert_array_equal(found.env_marks(["table", "cube"]), np.array([0, 0, 0, 0], np.float32))
    empty = report(table, goal, envs=envs)
    assert_array_equal(empty.env_marks(), [NAN] * 4)
    assert empty.worst_first() == (0, 1, 2, 3)
    with pytest.raises(ValueError, match="no object dragon, fox; there are: cube, ball, table, goal$"):
        found.env_marks(["fox", "cube", "dragon"])
    with pytest.raises(ValueError, match="no object fox; there are: none$"):
        report().wanted_objects(["fox"])


@pytest.mark.parametrize(
    ("nearest", "near"),
    [([0.5, 0.9], 0.25), ([0.129, NAN], 0.064), ([3.99], 1.9), ([0.2], 0.1), ([NAN], None), ([np.inf], None)],
)
def test_the_suggested_near_plane_is_at_half_the_nearest_depth(
    nearest: list[float], near: float | None
) -> None:
    assert depth(nearest).suggested_near == near


@pytest.mark.parametrize(
    ("farthest", "far"),
    [([1.0, 2.0], 3.0), ([0.67, NAN], 1.1), ([67.0], 110.0), ([2.01], 3.1), ([NAN], None)],
)
def test_the_suggested_far_plane_is_at_1_5_times_the_farthest_object(
    farthest: list[float], far: float | None
) -> None:
    assert depth([1.0], farthest).suggested_far == far


def test_joined_reports_are_concatenated() -> None:
    one = report(thing(pixels=[1, 2]), envs=(0, 3), depth=depth([1.0, 2.0], [3.0, 4.0]))
    other = report(thing(pixels=[5], cut=True), envs=(0,), depth=depth([7.0], [8.0]), pictures=4)
    both = join_reports([one, other])
    assert (both.envs, both.pictures, both.milliseconds) == ((0, 3, 0), 7, 3.0)
    assert (both.camera, both.size, both.measured_size) == (("sensor", "eye"), (8, 6), (4, 3))
    assert both.objects[0].pixels.tolist() == [1, 2, 5] and both.objects[0].cut.tolist() == [
        False,
        False,
        True,
    ]
    assert both.depth.nearest.tolist() == [1, 2, 7] and both.depth.counts.shape == (3, 40)
    assert join_reports([one]).objects[0].pixels.tolist() == [1, 2]


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"camera": ("human", "eye")}, "different cameras"),
        ({"size": (8, 8)}, "different sizes"),
        ({"measured_size": (8, 6)}, "different sizes"),
        ({"objects": (thing("ball"),)}, "different scenes"),
    ],
)
def test_reports_of_different_cameras_or_scenes_are_not_joined(changes: Any, says: str) -> None:
    first = report(thing())
    with pytest.raises(ValueError, match=says):
        join_reports([first, first, replace(first, **changes)])


def test_the_text_of_a_report_names_the_wanted_objects_with_their_numbers() -> None:
    cube = thing("cube", pixels=[10, 0, 4], unhindered=[20, 0, 4], cut=[False, False, True])
    ball = thing("ball", pixels=[12, 12, 12], present=[True, False, True])
    absent = thing("absent", pixels=[0] * 3, present=False)
    found = report(cube, ball, absent, thing("table", pixels=[9] * 3), envs=(0, 1, 2))
    first, second = report_text(found, ("ball", "cube", "absent")).split("; ")
    assert first.startswith("cube: ") and second.startswith("ball: ")
    assert re.findall(r"\d+(?:\.\d+)?", first) == ["2", "3", "4", "8.3", "33", "25"]
    assert re.findall(r"\d+(?:\.\d+)?", second) == ["2", "2", "12", "25"]


@pytest.mark.parametrize(
    ("pixels", "text"), [(0, "0 %"), (0.5, "< 0.01 %"), (21, "0.21 %"), (990, "9.9 %"), (1234, "12 %")]
)
def test_a_small_share_has_two_digits(pixels: float, text: str) -> None:
    assert size_text(pixels, (200, 50)) == text


def test_a_score_is_between_the_mean_and_the_worst_env_less_near_a_border_or_an_obstacle() -> None:
    def score(nearest: list[float] | float = 1.0, wanted: tuple[str, ...] = ("cube",), **given: Any) -> float:
        cube = thing("cube", **given)
        ball = thing("ball", pixels=[25.0] * len(cube.pixels))
        return score_of(report(cube, ball, envs=tuple(range(len(cube.pixels))), depth=depth(nearest)), wanted)

    assert score() == 1.0
    assert score([1.0, 1.0], pixels=[100, 25]) == pytest.approx((0.75 + 0.5) / 2)
    assert score([1.0, 1.0], pixels=[100, 25], present=[True, False]) == 1.0, "only envs that have it"
    assert score([1.0, 1.0], pixels=[100, 0]) == pytest.approx(0.25)
    assert score(wanted=("cube", "ball")) == 0.5, "the worst of the wanted objects"
    assert score(margin=0.05) == pytest.approx(0.9) and score(margin=0.0) == pytest.approx(0.8)
    assert score(0.05) == pytest.approx(0.5) and score(NAN) == 0.0
    assert score([0.05, 1.0], pixels=[100, 100]) == pytest.approx((0.75 + 0.5) / 2), (
        "each env has its own room"
    )
    assert score(present=False) == 0.0
