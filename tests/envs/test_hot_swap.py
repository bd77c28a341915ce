"""A running env gets another class, and hooks are tried on it: of what they did nothing is left."""

# pyright: reportAttributeAccessIssue=false, reportArgumentType=false

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from mani_skill.utils.structs.pose import Pose

from tests.drive.envs import PUSH_CUBE, batched
from workbench.envs.hot_swap import put_class, rehearse_hooks

pytestmark = [
    pytest.mark.thorough,
    pytest.mark.filterwarnings("ignore::workbench.envs.broken_rule.RuleWarning"),
]
N = 3
HOOKS = ["_initialize_episode", "evaluate"]


class Plain(PUSH_CUBE):
    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self.looks = 0
        super().__init__(*args, **kwargs)


class Meddles(Plain):
    """Whatever it is asked counts, draws and writes; and does as its `way` says."""

    way = "writes"

    def evaluate(self) -> dict:
        self.looks += 1
        pose = self.obj.pose.raw_pose.clone()
        pose[1, 2] += 0.1 * torch.rand(())  # of one env: the others are where they were
        self.obj.set_pose(Pose.create(pose))
        if self.way == "applies":
            self.scene._gpu_apply_all()
            self.scene._gpu_fetch_all()
        elif self.way == "raises":
            raise ZeroDivisionError
        elif self.way == "is interrupted":
            raise KeyboardInterrupt
        return {**super().evaluate(), "looks": torch.full((self.num_envs,), self.looks)}


def begun(task: type = Plain) -> Any:
    env = batched(
        task, N, control_mode="pd_joint_target_delta_pos", rules="warn", on_finding=lambda told: None
    )
    env.reset(seed=[0, 1, 2])
    for _ in range(4):
        env.step(np.full((N, 8), 0.4, np.float32))
    return env


def moment(env: Any) -> tuple[Any, ...]:
    target = env.agent.get_controller_state()["arm"]["target_qpos"]
    return (
        [system.pack() for system in env.scene.px.systems],
        env.get_state().tolist(),
        target.tolist(),
        [rng.get_state()[2] for rng in env._batched_episode_rng.rngs],
        torch.get_rng_state().tolist(),
        env.looks,
        env.elapsed_steps.tolist(),
    )


@pytest.mark.parametrize("way", ["writes", "applies", "raises", "is interrupted"])
def test_hooks_are_tried_without_a_trace(way: str, monkeypatch: pytest.MonkeyPatch) -> None:
    env = begun()
    monkeypatch.setattr(Meddles, "way", way)
    put_class(env, Meddles)
    before, hooks = moment(env), HOOKS[1:] if way == "applies" else HOOKS
    for _ in range(2):
        if way in ("raises", "is interrupted"):
            with pytest.raises((ZeroDivisionError, KeyboardInterrupt)):
                rehearse_hooks(env, hooks)
        else:
            assert rehearse_hooks(env, hooks) == {}
        after = moment(env)
        if way == "applies":  # what was stepped or applied comes out of a snapshot
            np.testing.assert_allclose(after[1], before[1], atol=1e-5)
            assert after[2:] == before[2:]
        else:
            assert after == before
    there = env.obj.pose.raw_pose + 0.1
    env.obj.set_pose(Pose.create(there))
    assert torch.equal(env.obj.pose.raw_pose, there), "all envs are written to, as between resets"
    env.close()


def test_another_class_goes_on_from_the_same_moment_with_the_same_rules() -> None:
    env, still = begun(), begun()
    before = moment(env)
    put_class(env, type("Edited", (Plain,), {"evaluate": lambda self: {"success": self.elapsed_steps > 4}}))
    assert moment(env) == before
    action = np.full((N, 8), -0.4, np.float32)
    *_, info = env.step(action)
    still.step(action)
    assert info["success"].tolist() == [True] * N and moment(env)[:5] == moment(still)[:5]
    assert env.broken_rules.degree("rows-lost") == still.broken_rules.degree("rows-lost") == "warn"
    env.close()
    still.close()
