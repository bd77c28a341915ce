"""Suggested placements see the wanted objects in all envs and are reproducible."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from mani_skill.utils.structs import Pose

from tests.drive.envs import batched
from workbench.envs.camera_data import CameraSettings
from workbench.pictures.camera_conventions import axes_of
from workbench.pictures.camera_report import CameraReport, SearchSpace, join_reports
from workbench.pictures.camera_search import score_of, suggest_cameras
from workbench.pictures.render import segmentation_names
from workbench.pictures.visibility import Placement, measure_placement, objects_to_see

N = 2
LENS = CameraSettings((0, 0, 0), (1, 0, 0, 0), 0.9, None, 96, 64, 0.01, 100, "minimal")
LOW, HIGH = (-0.8, -0.8, 0.1), (0.8, 0.8, 1.0)


@pytest.fixture(scope="module")
def env(renderer: None) -> Iterator[Any]:
    env = batched("PushCube-v1", N, render=True)
    env.reset(seed=3)
    yield env
    env.close()


def measured(env: Any, placement: Placement, size: tuple[int, int]) -> CameraReport:
    return join_reports([measure_placement(env, e, placement, size=size) for e in range(N)])


def test_a_cancelled_search_ends_at_once_with_its_results(env: Any) -> None:
    looks: list[int] = []
    space = SearchSpace(("cube",), LOW, HIGH, LENS, candidates=1000)
    assert (
        suggest_cameras(
            env, space, [0], progress=lambda done, total: looks.append(done), cancelled=lambda: len(looks) > 4
        )
        == ()
    )
    assert len(looks) == 6, "five candidates, and the final progress call"


def test_a_placement_that_sees_nothing_is_not_suggested(env: Any) -> None:
    under_the_table = SearchSpace(("cube",), (0, 0, -0.5), (0, 0, -0.5), LENS, candidates=4)
    assert suggest_cameras(env, under_the_table, [0]) == ()


def test_a_placement_whose_object_the_robot_hides_is_not_suggested(env: Any) -> None:
    inside_the_base = torch.tensor([[-0.615, 0.0, 0.07, 1.0, 0.0, 0.0, 0.0]] * N)
    env.obj.set_pose(Pose(inside_the_base))
    try:
        assert suggest_cameras(env, SearchSpace(("cube",), LOW, HIGH, LENS, candidates=4, best=1), [0]) == ()
    finally:
        env.reset(seed=3)


def test_suggestions_for_a_mounted_camera_are_upright_and_in_the_links_frame(
    env: Any,
) -> None:
    mount, low, high = "panda/panda_hand", (-0.12, -0.12, -0.05), (0.12, 0.12, 0.1)
    # The top of its picture points along the hand's x.
    lens = replace(LENS, quaternion=(math.sqrt(0.5), 0, -math.sqrt(0.5), 0), fov=1.4)
    assert np.allclose(axes_of(lens.quaternion)[0], [0, 0, 1])
    space = SearchSpace(("cube",), low, high, lens, candidates=12, best=1, mount=mount)
    (found,) = suggest_cameras(env, space, range(N))
    eye = np.array(found.settings.position)
    assert (eye >= low).all() and (eye <= high).all()
    forward, left, up = axes_of(found.settings.quaternion)
    assert abs(left @ axes_of(lens.quaternion)[2]) < 1e-6 and up @ axes_of(lens.quaternion)[2] > 0
    assert np.allclose(np.cross(np.subtract(found.target, eye), forward), 0, atol=1e-6)
    placement = Placement(found.settings, mount=mount)
    again = measured(env, placement, found.report.measured_size)
    assert score_of(again, ("cube",)) == pytest.approx(found.score, abs=1e-6) and found.score > 0.1
    with pytest.raises(ValueError, match="no body 'panda/tail'"):
        suggest_cameras(env, replace(space, mount="panda/tail"), [0])


def test_placements_are_searched_in_the_given_env_only(env: Any) -> None:
    space = SearchSpace(("cube",), LOW, HIGH, LENS, candidates=6, best=2, apart=0.2)
    progress: list[tuple[int, int]] = []
    found = suggest_cameras(env, space, [1], progress=lambda done, total: progress.append((done, total)))
    assert found and [one.score for one in found] == sorted((one.score for one in found), reverse=True)
    eyes = [np.array(one.settings.position) for one in found]
    assert all(np.linalg.norm(a - b) >= 0.2 for i, a in enumerate(eyes) for b in eyes[:i])
    for one, eye in zip(found, eyes, strict=True):
        assert one.report.envs == (1,) and one.picture.env == 1
        assert (
            (eye >= LOW).all()
            and (eye <= HIGH).all()
            and one.report.wanted_objects(["cube"])[0].pixels[0] > 0
        )
        assert one.score == score_of(one.report, ("cube",))
        assert one.picture.rgb is not None and one.picture.rgb.shape == (64, 96, 3)
    assert progress[-1][0] == progress[-1][1] and [done for done, _ in progress[:3]] == [1, 2, 3]


@pytest.mark.parametrize(
    ("change", "envs", "says"),
    [
        ({"objects": ("dragon",)}, [0], "'dragon'.*cube, goal_region"),
        ({"objects": ("ground",)}, [0], "'ground'"),
        ({"objects": ("panda",)}, [0], "name links of it"),
        ({"objects": ()}, [0], "at least one object"),
        ({"low": (1.0, 0.0, 0.0), "high": (0.5, 1.0, 1.0)}, [0], "lower corner"),
        ({"high": (math.nan, 1.0, 1.0)}, [0], "finite"),
        ({"candidates": 0}, [0], "at least 1"),
        ({"best": 0}, [0], "at least 1"),
        ({}, [], "at least one env"),
    ],
)
def test_a_search_that_can_find_nothing_is_refused(
    env: Any, change: dict[str, Any], envs: list[int], says: str
) -> None:
    space = replace(SearchSpace(("cube",), LOW, HIGH, LENS), **change)
    with pytest.raises(ValueError, match=says):
        suggest_cameras(env, space, envs)
    with pytest.raises(IndexError):
        suggest_cameras(env, SearchSpace(("cube",), LOW, HIGH, LENS), [N])


def test_objects_to_see_are_the_tasks_and_the_robots_links_from_the_hand(env: Any) -> None:
    *objects, robot = objects_to_see(env)
    assert [(thing.name, thing.hidden, thing.links, thing.robot) for thing in objects] == [
        ("cube", False, (), False),
        ("goal_region", False, (), False),
    ]
    assert robot.robot and robot.name == "panda" and robot.links[0] == "panda/panda_hand"
    assert set(robot.links[1:3]) == {"panda/panda_leftfinger", "panda/panda_rightfinger"}
    assert "panda/panda_link0" in robot.links
    assert "panda/panda_hand_tcp" not in robot.links, "a link without visual shapes"


@pytest.mark.slow
def test_the_robots_hand_can_be_a_wanted_object_that_the_arm_hides(env: Any) -> None:
    hand = "panda/panda_hand"
    space = SearchSpace((hand, "cube"), LOW, HIGH, LENS, candidates=16, best=1)
    (found,) = suggest_cameras(env, space, range(N))
    seen = {thing.name: thing for thing in found.report.wanted_objects(space.objects)}
    assert set(seen) == {hand, "cube"} and found.picture.segmentation is not None
    number = next(n for n, name in segmentation_names(env).items() if name == hand)
    e = found.report.envs.index(found.picture.env)
    # Counted in a smaller picture, whose pixels each stand for several of the camera's own.
    assert (found.picture.segmentation == number).sum() == pytest.approx(seen[hand].pixels[e], rel=0.4)
    # From behind the arm's base, the arm hides part of the hand.
    behind = SearchSpace((hand,), (-1.2, 0.0, 0.2), (-1.2, 0.0, 0.2), LENS, candidates=1, best=1)
    for thing in suggest_cameras(env, behind, range(N))[0].report.wanted_objects((hand,)):
        assert (thing.pixels < thing.alone).all() and (thing.hidden_share > 0).all()
