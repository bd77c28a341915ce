"""Each kind of outlier, provoked in a real task by a real worker; a correct task has none."""

# The fixture hands over a session whose task is loaded: what may be None before is not here.
# pyright: reportOptionalMemberAccess=false

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.drive.session import live_session, wait_until
from workbench.app.session import Session
from workbench.envs.outliers import OUTLIER_RULES, OutlierKind
from workbench.live.commands import Step

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
def one_of_each(child_process: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Session]:
    folder: Path = tmp_path_factory.mktemp("author")
    (folder / "one_of_each.py").write_text(BROKEN)
    with live_session(folder / "one_of_each.py", folder / "kept", num_envs=8) as session:
        session.change(action_source="hold")
        for count in range(1, 13):
            session.do(Step())
            view = wait_until(
                session, lambda v, n=count: v.step.elapsed_steps[0] == n or v.problem is not None, "a step"
            )
            assert view.problem is None, view.problem
        yield session


def test_each_kind_is_found_only_in_the_env_that_causes_it(one_of_each: Session) -> None:
    found = {env: {o.kind for o in outliers} for env, outliers in one_of_each.env_rows().outliers.items()}
    assert found == {
        1: {OutlierKind.FAST},
        2: {OutlierKind.ENTRY_NOT_FINITE},
        3: {OutlierKind.UNDER_FLOOR, OutlierKind.DROPPED},
        4: {OutlierKind.DROPPED},
        5: {OutlierKind.REWARD_OUT_OF_RANGE},
        6: {OutlierKind.REWARD_NOT_FINITE},
        7: {OutlierKind.OBSERVATION_NOT_FINITE},
    }


def test_each_outlier_is_a_finding_of_its_rule_at_the_hook(one_of_each: Session) -> None:
    found = {finding.rule: finding for finding in one_of_each.view().odd}
    assert found.keys() == OUTLIER_RULES.keys()
    assert found["entries-finite"].code == "def evaluate(self):" and found["entries-finite"].degree == "warn"
    assert found["bodies-stay"].function == "_initialize_episode" and found["bodies-stay"].count > 20
    assert found["reward-finite"].message == "the reward is NaN, in env 6 at step 1 of its episode"
