"""Objects that differ by env: ``scene_idxs``, ``Actor.merge``, ``Link.merge``, ``Articulation.merge``."""

# ManiSkill annotates an env's members as the widest thing they may be, and vectors as tuples.
# pyright: reportAttributeAccessIssue=false, reportOptionalMemberAccess=false, reportArgumentType=false
# pyright: reportOptionalIterable=false

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
import sapien
import torch
from mani_skill.utils.structs import Actor, Articulation, Link
from mani_skill.utils.structs.pose import Pose

from tests.envs.by_hand import box, by_hand
from tests.envs.stock_env import Bare, batch_of, follow

pytestmark = pytest.mark.thorough


class Mixed(Bare):
    """Even envs: a box and a chain of one hinge. Odd envs: a ball and a chain of two. A floor everywhere."""

    def _load_scene(self, options: dict) -> None:
        things, chains = [], []
        for i, number in enumerate(self.env_numbers()):
            builder = self.scene.create_actor_builder()
            if number % 2 == 0:
                builder.add_box_collision(half_size=[0.05, 0.04, 0.03])
            else:
                builder.add_sphere_collision(radius=0.05)
            builder.initial_pose = sapien.Pose([1, 0, 0.2])
            builder.set_scene_idxs([i])
            things.append(builder.build(f"thing-{i}"))
            self.remove_from_state_dict_registry(things[-1])
            chains.append(by_hand(self, 1 + number % 2, f"chain-{i}", [i]))
            self.remove_from_state_dict_registry(chains[-1])
        self.thing = Actor.merge(things, name="thing")
        self.chain = Articulation.merge(chains, name="chain")
        self.tip = Link.merge([chain.links[-1] for chain in chains], name="tip")
        self.add_to_state_dict_registry(self.thing)
        self.add_to_state_dict_registry(self.chain)
        self.floor = box(self, "floor", [3, 3, 0.1], sapien.Pose([0, 0, -0.1]), "static")

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        b = len(env_idx)
        rng = self._batched_episode_rng[env_idx]
        p = torch.tensor([[1.0, 0.0, 0.2]]).repeat(b, 1)
        p[:, :2] += torch.from_numpy(rng.uniform(-0.1, 0.1, (2,))).float()
        self.thing.set_pose(Pose.create_from_pq(p))
        self.thing.set_linear_velocity(torch.tensor([0.5, 0.0, 0.0]))
        self.chain.set_qpos(torch.full((b, self.chain.max_dof), 0.3))


@pytest.fixture(scope="module")
def mixed() -> Iterator[Any]:
    env = batch_of(Mixed, 4)
    env.reset(seed=[0, 1, 2, 3])
    yield env
    env.close()


def test_each_env_equals_a_stock_env_with_its_objects() -> None:
    def look(env: Any) -> dict[str, torch.Tensor]:
        return {
            "thing": env.thing.get_state(),
            "qpos": env.chain.get_qpos(),
            "qvel": env.chain.get_qvel(),
            "qlimits": env.chain.get_qlimits().flatten(1),
            "qacc": env.chain.qacc,
            "tip": env.tip.pose.raw_pose,
            "tip velocity": env.tip.linear_velocity,
            "tip's joint": env.tip.joint.qpos,
            "net impulse": env.thing.get_net_contact_impulses().float(),
            "impulse of the floor": env.scene.get_pairwise_contact_impulses(env.thing, env.floor).float(),
        }

    follow(Mixed, 4, look=look).close()


def test_a_partial_reset_writes_the_right_parts_of_a_merged_actor(mixed: Any) -> None:
    mixed.reset(seed=[0, 1, 2, 3])
    for _ in range(5):
        mixed.step(None)
    before = mixed.get_state()
    mixed.reset(options={"env_idx": torch.tensor([1, 2])})
    after = mixed.get_state()
    assert torch.equal(after[[0, 3]], before[[0, 3]])
    assert bool((after[[1, 2]] != before[[1, 2]]).any(dim=1).all())
    assert torch.equal(mixed.thing.pose.p[[1, 2], 2], torch.full((2,), 0.2))


def test_the_state_of_merged_structs_survives_a_round_trip(mixed: Any) -> None:
    mixed.reset(seed=[0, 1, 2, 3])
    state = mixed.get_state_dict()
    assert state["actors"].keys() == {"thing"}
    assert state["articulations"].keys() == {"chain"}
    assert state["articulations"]["chain"].shape == (4, 13 + 2 * 2)
    for _ in range(5):
        mixed.step(None)
    assert not torch.allclose(mixed.thing.get_state(), state["actors"]["thing"])
    assert not torch.allclose(mixed.chain.get_state(), state["articulations"]["chain"])
    mixed.set_state_dict(state)
    again = mixed.get_state_dict()
    torch.testing.assert_close(again, state, atol=1e-6, rtol=0)


def test_drive_targets_of_parts_of_a_merged_articulation() -> None:
    """Targets are set on the parts, since ManiSkill 3.0.1's merged joint has no ``articulation``."""

    class Driven(Mixed):
        def _load_scene(self, options: dict) -> None:
            super()._load_scene(options)
            self.tip.joint.set_drive_properties(stiffness=200, damping=20)

        def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
            super()._initialize_episode(env_idx, options)
            for number, i in zip(self.env_numbers(), range(self.num_envs)):
                if i in env_idx:
                    chain = self.scene.articulations[f"chain-{i}"]
                    chain.active_joints[-1].set_drive_target(torch.tensor([0.1 + 0.1 * number]))

    env = follow(Driven, 4, look=lambda e: {"qpos": e.chain.get_qpos(), "qvel": e.chain.get_qvel()})
    final = env.tip.joint.qpos
    assert bool((final.diff() > 0.05).all()), final
    env.reset(options={"env_idx": torch.tensor([2])})
    env.close()
