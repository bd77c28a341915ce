"""Contact impulses and the list of contacts equal those of stock ManiSkill's single env in the same state."""

# ManiSkill annotates an env's members as the widest thing they may be, and vectors as tuples.
# pyright: reportAttributeAccessIssue=false, reportOptionalMemberAccess=false, reportArgumentType=false
# pyright: reportOptionalIterable=false

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
import torch
from mani_skill.utils.registration import REGISTERED_ENVS
from mani_skill.utils.structs.pose import Pose

from tests.envs.by_hand import box
from tests.envs.stock_env import Bare, batch_of, put_in_same_state, single
from workbench.envs.inspect_env import Contact, list_contacts

pytestmark = [
    pytest.mark.thorough,
    # Some of ManiSkill's own tasks break rules: `tests/envs/test_strict.py` lists them.
    pytest.mark.filterwarnings("ignore::workbench.envs.broken_rule.RuleWarning"),
]

N = 3


def task_class(env_id: str) -> Any:
    return REGISTERED_ENVS[env_id].cls


def same_impulses(ours: torch.Tensor, theirs: torch.Tensor, env: int) -> float:
    """Assert equality to the last bit of float32 (stock returns float64), and return the largest magnitude."""
    assert torch.equal(ours[env], theirs[0].float()), (env, ours[env], theirs[0])
    return float(theirs.abs().max())


def stack_cube(env: Any) -> None:
    """Place cube A across cube B and the table, at a different position in each of the three envs."""
    at = env.cubeB.pose.raw_pose.clone()
    at[:, :3] += torch.tensor([0.01, 0.0, 0.04])
    env.cubeA.set_pose(Pose.create(at))


def in_the_hand(actor: Callable[[Any], Any]) -> Callable[[Any], None]:
    def put(env: Any) -> None:
        pose = actor(env).pose.raw_pose.clone()
        pose[:, :3] = env.agent.tcp.pose.p
        actor(env).set_pose(Pose.create(pose))

    return put


def prepared(env_id: str, prepare: Callable[[Any], None]) -> tuple[Any, list[Any]]:
    batch = batch_of(task_class(env_id), N)
    batch.reset(seed=list(range(N)), options={"reconfigure": True})
    prepare(batch)
    batch.scene._gpu_apply_all()
    batch.scene._gpu_fetch_all()
    stocks = []
    for env in range(N):
        stocks.append(single(task_class(env_id)))
        stocks[-1].reset(seed=env, options={"reconfigure": True})
        put_in_same_state(stocks[-1], batch, env)
    return batch, stocks


GRASP = np.concatenate([np.zeros(7), [-1.0]]).astype(np.float32)
CASES: dict[str, tuple[str, Callable[[Any], None], Callable[[Any], list[Any]]]] = {
    "stack": ("StackCube-v1", stack_cube, lambda env: [env.cubeA, env.cubeB]),
    "grasp": (
        "StackCube-v1",
        in_the_hand(lambda env: env.cubeA),
        lambda env: [env.cubeA, env.agent.finger1_link, env.agent.finger2_link],
    ),
    "merged peg": (
        "PegInsertionSide-v1",
        in_the_hand(lambda env: env.peg),
        lambda env: [env.peg, env.agent.finger1_link, env.agent.finger2_link],
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_impulses_of_bodies_and_pairs_equal_the_stock_values(case: str) -> None:
    env_id, prepare, bodies = CASES[case]
    batch, stocks = prepared(env_id, prepare)
    felt_bodies = felt_pairs = 0.0
    for _ in range(6):
        batch.step(np.tile(GRASP, (N, 1)))
        for env, stock in enumerate(stocks):
            stock.step(GRASP[None])
            for i, (ours, theirs) in enumerate(zip(bodies(batch), bodies(stock))):
                felt_bodies += same_impulses(
                    ours.get_net_contact_impulses(), theirs.get_net_contact_impulses(), env
                )
                for other, their_other in zip(bodies(batch)[i + 1 :], bodies(stock)[i + 1 :]):
                    pair = batch.scene.get_pairwise_contact_impulses(ours, other)
                    turned = batch.scene.get_pairwise_contact_impulses(other, ours)
                    assert torch.equal(pair, -turned)
                    felt_pairs += same_impulses(
                        pair, stock.scene.get_pairwise_contact_impulses(theirs, their_other), env
                    )
    assert felt_bodies > 0.01 and felt_pairs > 0.01, "no contacts, so the test proved nothing"
    for env in (batch, *stocks):
        env.close()


def test_net_forces_on_the_feet_of_a_legged_robot_equal_the_stock_values() -> None:
    batch, stocks = prepared("MS-AntWalk-v1", lambda env: None)
    feet = [link.name for link in batch.agent.robot.links if "foot" in link.name]
    assert len(feet) == 4
    rng, felt = np.random.default_rng(0), 0.0
    for _ in range(25):
        action = rng.uniform(-1, 1, (N, 8)).astype(np.float32)
        batch.step(action)
        forces = batch.agent.robot.get_net_contact_forces(feet)
        assert forces.shape == (N, 4, 3)
        for env, stock in enumerate(stocks):
            stock.step(action[env : env + 1])
            felt += same_impulses(forces, stock.agent.robot.get_net_contact_forces(feet), env)
            for i, foot in enumerate(feet):
                one_by_one = stock.agent.robot.links_map[foot].get_net_contact_forces()
                torch.testing.assert_close(forces[env, i], one_by_one[0].float(), atol=1e-4, rtol=1e-6)
    assert felt > 1.0, "no foot touched the ground, so the test proved nothing"
    for env in (batch, *stocks):
        env.close()


# --- the list of contacts ---------------------------------------------------------------------------


class Pile(Bare):
    """A box on a floor, and a second box on top of it that overhangs."""

    def _load_scene(self, options: dict) -> None:
        self.floor = box(self, "floor", [3, 3, 0.1], None, "static")
        self.low = box(self, "low")
        self.high = box(self, "high", [0.08, 0.02, 0.03])

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        number = torch.tensor(self.env_numbers())[env_idx]
        p = torch.zeros((len(env_idx), 3))
        p[:, 2] = 0.15
        self.low.set_pose(Pose.create_from_pq(p))
        p[:, 2] = 0.235
        p[:, 0] = 0.01 * number
        self.high.set_pose(Pose.create_from_pq(p))


@pytest.fixture(scope="module")
def piles() -> Iterator[tuple[Any, list[Any]]]:
    batch = batch_of(Pile, N)
    batch.reset(seed=[0, 1, 2])
    stocks = [single(Pile, first_env=env) for env in range(N)]
    for env, stock in enumerate(stocks):
        stock.reset(seed=env)
        put_in_same_state(stock, batch, env)
    for _ in range(5):
        for env in (batch, *stocks):
            env.step(None)
    yield batch, stocks
    for env in (batch, *stocks):
        env.close()


def equal(ours: Contact, theirs: Contact) -> bool:
    return ours.bodies == theirs.bodies and all(
        np.array_equal(getattr(ours, name), getattr(theirs, name))
        for name in ("points", "normals", "impulses", "separations", "force")
    )


def test_the_list_of_contacts_equals_that_of_a_stock_env(piles: tuple[Any, list[Any]]) -> None:
    batch, stocks = piles
    for env, stock in enumerate(stocks):
        ours, theirs = list_contacts(batch, env), list_contacts(stock, 0)
        raw = {
            tuple(b.entity.name.removeprefix("scene-0_") for b in c.bodies): c
            for c in stock.scene.get_contacts()
        }
        assert [contact.bodies for contact in ours] == sorted(raw)
        assert {frozenset(bodies) for bodies in raw} >= {
            frozenset(("low", "floor")),
            frozenset(("low", "high")),
        }
        for our, their in zip(ours, theirs):
            assert equal(our, their)
            contact = raw[our.bodies]
            assert np.array_equal(our.points, [point.position for point in contact.points])
            assert np.array_equal(our.normals, [point.normal for point in contact.points])
            assert np.array_equal(our.impulses, [point.impulse for point in contact.points])
            assert np.array_equal(our.separations, np.float32([point.separation for point in contact.points]))
            count = len(contact.points)
            assert our.points.shape == our.normals.shape == our.impulses.shape == (count, 3)
