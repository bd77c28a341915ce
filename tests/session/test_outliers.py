"""Every kind of outlier, provoked in a real task by a real worker; and the quiet of a task that is well."""

# The fixture hands over a session whose task is loaded: what may be None before is not here.
# pyright: reportOptionalMemberAccess=false

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.session.conftest import TASKS, wait_until
from tests.ui.scenes import description, step_of, table_scene
from workbench.session.env_table import EnvTable, Outcome
from workbench.session.history import NOT_A_NUMBER
from workbench.session.messages import Stepped, TaskOptions
from workbench.session.outliers import FASTEST, Kind, OutlierWatch, lowest_still_point
from workbench.session.session import Session

BROKEN = '''
import sapien
import torch
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.utils.building.ground import build_ground
from mani_skill.utils.registration import register_env
from mani_skill.utils.structs import Pose


@register_env("OneOfEach-v1", max_episode_steps=200)
class OneOfEachEnv(BaseEnv):
    """Env 0 is well; each of the others does one thing wrong."""

    SUPPORTED_REWARD_MODES = ("normalized_dense", "none")

    def __init__(self, *args, robot_uids="panda", **kwargs):
        super().__init__(*args, robot_uids=robot_uids, **kwargs)

    def _load_agent(self, options):
        super()._load_agent(options, sapien.Pose(p=[-0.6, 0, 0]))

    def _load_scene(self, options):
        build_ground(self.scene)
        builder = self.scene.create_actor_builder()
        builder.add_box_collision(half_size=[0.03] * 3)
        builder.add_box_visual(half_size=[0.03] * 3)
        builder.initial_pose = sapien.Pose(p=[0.3, 0, 0.03])
        self.cube = builder.build(name="cube")
        # What collides of it is 50 m over its visual: it falls through the ground.
        builder = self.scene.create_actor_builder()
        builder.add_sphere_collision(pose=sapien.Pose([0, 0, 50]), radius=0.01)
        builder.add_box_visual(half_size=[0.03] * 3)
        builder.initial_pose = sapien.Pose(p=[0.3, 0.5, 0.03])
        builder.set_scene_idxs([3])
        self.ghost = builder.build(name="ghost")

    def _initialize_episode(self, env_idx, options):
        self.agent.reset(self.agent.keyframes["rest"].qpos)
        p = torch.tensor([[0.3, 0.0, 0.03]]).repeat(len(env_idx), 1)
        p[env_idx == 4, 2] = 1.0
        self.cube.set_pose(Pose.create_from_pq(p=p))
        thrown = torch.zeros(len(env_idx), 3)
        thrown[env_idx == 1, 2] = 60.0
        self.cube.set_linear_velocity(thrown)

    def evaluate(self):
        distance = torch.linalg.norm(self.cube.pose.p[:, :2], dim=1)
        late = self.elapsed_steps >= 3
        distance[2] = torch.where(late[2], torch.nan, distance[2])
        return {"success": torch.zeros(self.num_envs, dtype=torch.bool), "distance": distance}

    def compute_dense_reward(self, obs, action, info):
        reward = torch.zeros(self.num_envs)
        reward[6] = torch.nan
        reward[5] = 1.5 * (self.elapsed_steps[5] >= 3)
        return reward

    compute_normalized_dense_reward = compute_dense_reward

    def _get_obs_extra(self, info):
        seen = self.cube.pose.p.clone()
        seen[7, 1] = torch.inf if self.elapsed_steps[7] >= 2 else 0.0
        return {"seen": seen}
'''


@pytest.fixture(scope="module")
def one_of_each(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Session]:
    folder: Path = tmp_path_factory.mktemp("author")
    (folder / "one_of_each.py").write_text(BROKEN)
    session = Session(
        str(folder / "one_of_each.py"), TaskOptions(num_envs=8, env_kwargs={"render_backend": "none"}),
        recordings=folder / "kept",
    )  # fmt: skip
    session.set_action_source("hold")
    try:
        view = wait_until(session, lambda v: v.task is not None or v.problem is not None, "the load")
        assert view.task is not None, view.problem
        for count in range(1, 13):
            session.step()
            view = wait_until(
                session, lambda v, n=count: v.step.elapsed_steps[0] == n or v.problem is not None, "a step"
            )
            assert view.problem is None, view.problem
        yield session
    finally:
        session.close()


def test_each_kind_is_found_in_the_env_that_does_it_and_nowhere_else(one_of_each: Session) -> None:
    found = {env: {o.kind for o in outliers} for env, outliers in one_of_each.env_rows().outliers.items()}
    assert found == {
        1: {Kind.FAST},
        2: {Kind.NOT_A_NUMBER},
        3: {Kind.UNDER_FLOOR, Kind.DROPPED},
        4: {Kind.DROPPED},
        5: {Kind.REWARD},
        6: {Kind.NOT_A_NUMBER},
        7: {Kind.NOT_A_NUMBER},
    }


def test_the_reason_says_what_and_when(one_of_each: Session) -> None:
    outliers = one_of_each.env_rows().outliers
    assert outliers[1][0].reason.startswith("cube moved at ") and outliers[1][0].step == 1
    assert outliers[2][0].reason == "distance is NaN" and outliers[2][0].step == 3
    assert any(o.reason == "ghost is under the floor" for o in outliers[3])
    assert outliers[4][0].reason.startswith("cube dropped 0.")
    assert outliers[5][0].reason == "the reward is 1.5, above 1"
    assert (outliers[6][0].reason, outliers[6][0].step) == ("the reward is NaN", 1)
    assert (outliers[7][0].reason, outliers[7][0].step) == ("the observation is NaN or infinite", 2)
    one_of_each.select_env(6)
    [odd] = [what for what in one_of_each.past.strip(0, 10**6).events if what[1] & NOT_A_NUMBER]
    assert odd[0] == one_of_each.view().timeline.first + 1


def test_outliers_of_an_episode_are_those_of_the_last_one_after_a_reset(one_of_each: Session) -> None:
    before = one_of_each.env_rows()
    one_of_each.reset((2,))
    wait_until(one_of_each, lambda v: v.step.elapsed_steps[2] == 0, "the reset")
    rows = one_of_each.env_rows()
    assert 2 not in rows.outliers and rows.last.outliers[2] == before.outliers[2]
    assert rows.last.outcome[2] == Outcome.RUNNING and rows.last.steps[2] == before.steps[2]
    assert rows.outliers.keys() == before.outliers.keys() - {2}


def test_a_healthy_task_played_hard_has_none(tmp_path: Path) -> None:
    session = Session(str(TASKS / "push_cube.py"), TaskOptions(num_envs=4), recordings=tmp_path)
    try:
        wait_until(session, lambda v: v.task is not None, "the load")
        session.set_speed(math.inf)
        session.play()
        wait_until(session, lambda v: session.env_rows().ended.sum() >= 8, "eight episodes")
        rows = session.env_rows()
        assert not rows.outliers and not rows.last.outliers
        assert session.term_curves().terms.keys() == {"reach", "push", "end"}
    finally:
        session.close()


def test_a_body_that_a_reset_puts_elsewhere_has_not_moved() -> None:
    geometry, poses = table_scene(2)
    table = EnvTable(description(geometry), step_of(poses))
    there = poses.copy()
    there[0, 3, 0] += 100.0
    moved = replace(step_of(there), elapsed_steps=np.array([0, 7], np.int32))
    table.add(Stepped(moved, np.array([True, False])))
    table.add(Stepped(replace(moved, elapsed_steps=np.array([1, 8], np.int32)), np.zeros(2, bool)))
    assert not table.rows().outliers
    back = replace(step_of(poses), elapsed_steps=np.array([2, 9], np.int32))
    table.add(Stepped(back, np.zeros(2, bool)))
    assert [o.kind for o in table.rows().outliers[0]] == [Kind.FAST]


def test_poses_that_are_lost_are_named_and_bodies_that_were_never_there_are_not() -> None:
    geometry, poses = table_scene(2)
    poses[0, 2] = np.nan  # env 0 has no hand
    watch = OutlierWatch(geometry, step_of(poses), 0.05, "dense")
    assert watch.look(step_of(poses)) == []
    lost = poses.copy()
    lost[1, 3] = np.nan
    [sight] = watch.look(step_of(lost))
    assert sight.envs.tolist() == [False, True] and sight.reason(1) == "the pose of cube is NaN"


def test_a_speed_below_the_limit_is_none() -> None:
    geometry, poses = table_scene(1)
    for speed, expected in ((0.99 * FASTEST, []), (1.01 * FASTEST, [Kind.FAST])):
        watch = OutlierWatch(geometry, step_of(poses), 0.05, "dense")
        there = poses.copy()
        there[0, 3, 1] += speed * 0.05
        assert [sight.kind for sight in watch.look(step_of(there))] == expected


def test_the_lowest_still_point_is_the_ground_whichever_way_its_mesh_is_turned() -> None:
    geometry, poses = table_scene(1)
    assert lowest_still_point(geometry, poses) == pytest.approx(-0.9205)
    poses[0, 0] = [0, 0, 0.5, 0, 1, 0, 0]  # half a turn about x
    assert lowest_still_point(geometry, poses) == pytest.approx(0.5 + 0.9195)
    loose = replace(geometry, body_kinds=("kinematic",) * 4)
    assert lowest_still_point(loose, poses) == -np.inf
