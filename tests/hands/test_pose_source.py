"""The smallest edit of a body's first pose, planned from the text alone."""

from __future__ import annotations

import ast

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from workbench.hands.pose_source import plan_pose
from workbench.source.parsed import RefusedEdit

FILE = "/tasks/push.py"
STILL = (1.0, 0.0, 0.0, 0.0)
BEFORE = (0.1, 0.0, 0.02, *STILL)
TASK = """import sapien
HEIGHT = 0.02
class PushEnv(BaseEnv):
    def _load_scene(self, options):
        builder = self.scene.create_actor_builder()
        builder.initial_pose = sapien.Pose(p=[1, 1, 1])
        self.other = builder.build(name="other")
        builder = self.scene.create_actor_builder()
        BUILT
    def _initialize_episode(self, env_idx, options):
        b = len(env_idx)
        RESET
"""
POSE = "sapien.Pose(p=[0.1, 0, HEIGHT])"
BUILT = f'builder.initial_pose = {POSE}\n        self.cube = builder.build(name="cube")'


def task(built: str = BUILT, reset: str = "pass") -> str:
    return TASK.replace("BUILT", built).replace("RESET", reset)


def plan(text: str, *, x: float = 0.1, y: float = 0.0, z: float = 0.02, q: tuple[float, ...] = STILL) -> str:
    return plan_pose({FILE: text}, FILE, "PushEnv", "cube", BEFORE, (x, y, z, *q)).new_text


coordinates = st.floats(-9, 9).map(lambda value: round(value, 3))
WAYS = {
    "an attribute of the builder": task(),
    "an argument": task(f'self.cube = actors.build_cube(self.scene, name="cube", initial_pose={POSE})'),
    "a pose at each reset": task(reset=f"self.cube.set_pose({POSE})"),
    "a row for each env": task(
        reset="p = torch.tensor([0.1, 0, 0.02]).repeat(b, 1)\n        self.cube.set_pose(Pose.create_from_pq(p=p))"
    ),
    "an assigned pose": task(reset=f"self.cube.pose = {POSE}  # where it begins"),
}


@pytest.mark.parametrize("text", WAYS.values(), ids=WAYS)
@given(x=coordinates, y=coordinates)
def test_only_the_numbers_that_change_are_replaced(text: str, x: float, y: float) -> None:
    if abs(x - 0.1) < 1e-3 and abs(y) < 1e-3:
        return
    new = plan(text, x=x, y=y)
    ast.parse(new)
    spot = text.rindex("[0.1, 0, ")
    assert new.startswith(text[:spot]) and new.endswith(text[spot + len("[0.1, 0, ") :])
    written = ast.literal_eval(new[spot : len(new) - len(text) + spot + len("[0.1, 0, ")] + "0]")
    np.testing.assert_allclose(written[:2], (x, y), atol=1e-4)


def test_a_turned_body_gets_a_quaternion_and_a_changed_constant_is_told() -> None:
    turned = (0.7071068, 0.0, 0.0, 0.7071068)
    assert "sapien.Pose(p=[0.1, 0, HEIGHT], q=[0.7071068, 0.0, 0.0, 0.7071068])" in plan(task(), q=turned)
    edit = plan_pose({FILE: task()}, FILE, "PushEnv", "cube", BEFORE, (0.1, 0.0, 0.05, *STILL))
    assert "sapien.Pose(p=[0.1, 0, 0.05])" in edit.new_text and "HEIGHT" in edit.notes[0]
    with_q = task(BUILT.replace("HEIGHT]", "HEIGHT], q=[1, 0, 0, 0]"))
    assert "q=[0.7071068, 0, 0, 0.7071068]" in plan(with_q, q=turned)


RANDOM = "p = torch.zeros((b, 3))\n        p[:, 0] = torch.rand(b)\n        self.cube.set_pose(Pose.create_from_pq(p=p))"
REFUSED = {
    "a random pose": (task(reset=RANDOM), "computed"),
    "a name that is set in parts": (task(reset="self.cube.set_pose(pose)"), "not written with numbers"),
    "two places": (
        task(reset=f"self.cube.set_pose({POSE})\n        self.cube.set_pose({POSE})"),
        "several places",
    ),
    "another number in the file": (task(BUILT.replace("0.1", "0.3")), "something else"),
    "no such body": (task('self.cube = builder.build(name="box")'), 'name="cube"'),
    "two bodies of the name": (
        task(BUILT + '\n        self.twin = builder.build(name="cube")'),
        "both build",
    ),
    "a computed name": (task(BUILT.replace('"cube"', "NAME")), 'name="cube"'),
    "no pose": (task('self.cube = builder.build(name="cube")'), "0 places"),
    "a pose by **": (task(BUILT.replace(POSE, "sapien.Pose(**POSE)")), "not written with numbers"),
    "a computed orientation": (task(BUILT.replace("HEIGHT]", "HEIGHT], q=turn()")), "computed"),
}


@pytest.mark.parametrize(("text", "why"), REFUSED.values(), ids=REFUSED)
def test_what_cannot_be_matched_is_refused_with_lines_to_copy(text: str, why: str) -> None:
    with pytest.raises(RefusedEdit, match=why) as refused:
        plan(text, x=0.25)
    assert "sapien.Pose(p=[0.25, 0.0, 0.02], q=[1.0, 0.0, 0.0, 0.0])" in refused.value.snippet


def test_a_body_that_was_hardly_moved_changes_nothing() -> None:
    with pytest.raises(RefusedEdit, match="less than the precision"):
        plan(task(), x=0.10003)


def test_a_file_of_an_installed_package_is_refused() -> None:
    path = "/venv/lib/python3.11/site-packages/mani_skill/push.py"
    with pytest.raises(RefusedEdit, match="installed package"):
        plan_pose({path: task()}, path, "PushEnv", "cube", BEFORE, (0.2, 0.0, 0.02, *STILL))
