"""Random numbers of an episode, and resets that rebuild the scene."""

# ManiSkill annotates an env's members as the widest thing they may be, and vectors as tuples.
# pyright: reportAttributeAccessIssue=false, reportOptionalMemberAccess=false, reportArgumentType=false
# pyright: reportOptionalIterable=false

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import sapien
import torch
from mani_skill.utils.structs import Actor

from tests.envs.stock_env import Bare, batch_of, single


class Drawing(Bare):
    """Every env builds a box of a random size, and draws again when an episode begins."""

    def _load_scene(self, options: dict) -> None:
        self.sizes = np.asarray(self._batched_episode_rng.uniform(0.02, 0.1, (3,)))
        boxes = []
        for i, size in enumerate(self.sizes):
            builder = self.scene.create_actor_builder()
            builder.add_box_collision(half_size=size)
            builder.initial_pose = sapien.Pose([0, 0, 1])
            builder.set_scene_idxs([i])
            boxes.append(builder.build(f"box-{i}"))
            self.remove_from_state_dict_registry(boxes[-1])
        self.box = Actor.merge(boxes, "box")
        self.add_to_state_dict_registry(self.box)
        self.builds = getattr(self, "builds", 0) + 1

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        rng = self._batched_episode_rng[env_idx]
        drawn = [rng.uniform(size=2), rng.randint(1000, size=(2,)), rng.normal(0, 1, (1,)), rng.rand(3)]
        numbers = np.concatenate(
            [np.asarray(d, dtype=np.float64).reshape(len(env_idx), -1) for d in drawn], axis=1
        )
        if not hasattr(self, "drawn") or len(env_idx) == self.num_envs:
            self.drawn = numbers
        else:
            self.drawn[env_idx.cpu().numpy()] = numbers


def masses(env: Any) -> list[float]:
    return [float(body.mass) for body in env.box._bodies]


def test_env_i_draws_what_a_single_env_with_its_seed_draws() -> None:
    seeds = [11, 5, 2**31 - 1, 7]
    batch = batch_of(Drawing, 4)
    stock = single(Drawing)
    batch.reset(seed=seeds, options={"reconfigure": True})
    for env, seed in enumerate(seeds):
        stock.reset(seed=seed, options={"reconfigure": True})
        assert np.array_equal(batch.drawn[env], stock.drawn[0])
        assert np.array_equal(batch.sizes[env], stock.sizes[0])
        assert masses(batch)[env] == masses(stock)[0]
    assert len({tuple(row) for row in batch.drawn}) == 4
    stock.close()
    batch.close()


def test_reconfiguration_freq_rebuilds_when_a_stock_env_does() -> None:
    batch, stock = batch_of(Drawing, 3, reconfiguration_freq=2), single(Drawing, reconfiguration_freq=2)
    builds: list[int] = []
    scenes: list[Any] = []
    for _ in range(6):
        for env in (batch, stock):
            env.reset()
            env.step(None)
        assert batch.builds == stock.builds
        builds.append(batch.builds)
        scenes.append(batch.scene)
    assert builds[-1] - builds[0] in (2, 3)
    rebuilt = [scene is not before for before, scene in zip(scenes, scenes[1:])]
    assert rebuilt == [count > before for before, count in zip(builds, builds[1:])]
    batch.close()
    stock.close()


@pytest.mark.parametrize("options", [{"reconfigure": True}, {}], ids=["asked for", "due"])
def test_a_partial_reset_that_would_rebuild_raises_upstreams_error(options: dict) -> None:
    env = batch_of(Drawing, 3, reconfiguration_freq=1)
    with pytest.raises(RuntimeError, match="Cannot do a partial reset and reconfigure"):
        env.reset(options={"env_idx": torch.tensor([1]), **options})
    env.reset(seed=[1, 2, 3])
    env.close()
