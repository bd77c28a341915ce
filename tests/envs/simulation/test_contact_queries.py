"""Contact impulse queries on plain PhysX systems of boxes; `test_contact_forces` compares with stock ManiSkill."""

# SAPIEN annotates vectors as arrays, and its objects by what they are in C++.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportOptionalMemberAccess=false

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
import sapien
import sapien.physx as physx

from workbench.envs.simulation.contact_queries import ContactReader


@dataclass(frozen=True)
class Pile:
    """A box on the ground, and a second box on top of it."""

    scene: sapien.Scene
    system: physx.PhysxCpuSystem
    ground: physx.PhysxRigidBaseComponent
    low: physx.PhysxRigidBaseComponent
    high: physx.PhysxRigidBaseComponent


def pile(overhang: float) -> Pile:
    scene = sapien.Scene([physx.PhysxCpuSystem()])
    bodies = []
    for half_size, at in (
        ([1, 1, 0.1], [0, 0, -0.1]),
        ([0.1] * 3, [0, 0, 0.1]),
        ([0.1] * 3, [overhang, 0, 0.3]),
    ):
        builder = scene.create_actor_builder()
        builder.add_box_collision(half_size=half_size)
        builder.set_initial_pose(sapien.Pose(at))
        entity = builder.build() if len(bodies) else builder.build_static()
        bodies.append(entity.find_component_by_type(physx.PhysxRigidBaseComponent))
    system = scene.physx_system
    assert isinstance(system, physx.PhysxCpuSystem)
    for _ in range(5):
        system.step()
    return Pile(scene, system, *bodies)


@pytest.fixture
def piles() -> list[Pile]:
    return [pile(0.03), pile(0.06)]


def reader_of(piles: list[Pile]) -> ContactReader:
    return ContactReader([one.system for one in piles])


def impulse_on(pile: Pile, body: object, by: object = None) -> np.ndarray:
    """Sum the impulses on `body` over all its contacts (with `by` only, if given), as stock ManiSkill does."""
    total = np.zeros(3)
    for contact in pile.system.get_contacts():
        first, second = contact.bodies
        if body in (first, second) and (by is None or by in (first, second)):
            total += np.sum([point.impulse for point in contact.points], axis=0) * (
                1 if body is first else -1
            )
    return total


def net(reader: ContactReader, *bodies: physx.PhysxRigidBaseComponent) -> np.ndarray:
    query = reader.create_body_query(bodies)
    assert query.cuda_impulses.shape == (len(bodies), 3)
    reader.answer(query)
    return query.cuda_impulses.torch().numpy().copy()


def test_a_second_answer_replaces_the_first(piles: list[Pile]) -> None:
    reader = reader_of(piles)
    query, pairs = (
        reader.create_body_query([piles[0].high]),
        reader.create_pair_query([(piles[0].high, piles[0].low)]),
    )
    for _ in range(3):
        piles[0].system.step()
        reader.stepped()
        for _ in range(2):
            reader.answer(query)
            reader.answer(pairs)
        expected = np.float32(impulse_on(piles[0], piles[0].high))
        assert np.array_equal(query.cuda_impulses.torch()[0].numpy(), expected)
        assert np.array_equal(pairs.cuda_impulses.torch()[0].numpy(), expected)


def test_a_new_query_reads_contacts_that_no_earlier_query_needed(piles: list[Pile]) -> None:
    reader, first = reader_of(piles), piles[0]
    lower = reader.create_pair_query([(first.low, first.ground)])
    reader.answer(lower)
    assert np.array_equal(net(reader, first.high)[0], np.float32(impulse_on(first, first.high)))


def test_a_query_reads_new_contacts_after_stepped_or_invalidate(piles: list[Pile]) -> None:
    for notify in (ContactReader.invalidate, ContactReader.stepped):
        reader, first = reader_of(piles), piles[0]
        query = reader.create_body_query([first.high])
        reader.answer(query)
        first.high.set_linear_velocity([0, 0, 5])
        first.system.step()
        notify(reader)
        reader.answer(query)
        assert not query.cuda_impulses.torch().any(), "the box has lost contact"


def test_carried_contacts_replace_one_systems_list_until_its_next_step(piles: list[Pile]) -> None:
    first, second = piles
    reader = reader_of(piles)
    own = net(reader, first.high, second.high)
    touch = np.float32([1, 2, 3])
    query = reader.create_body_query([first.high, first.low, second.high])

    def impulses() -> list[list[float]]:
        reader.answer(query)
        return query.cuda_impulses.torch().tolist()

    second_impulse = own[1].tolist()
    reader.carry(0, [((id(first.high), id(first.low)), touch)])
    assert impulses() == [[1, 2, 3], [-1, -2, -3], second_impulse], "the other system keeps its own list"
    reader.invalidate()
    assert impulses()[0] == [1, 2, 3], "invalidate must keep carried contacts"
    reader.stepped(exclude=[0])
    assert impulses()[0] == [1, 2, 3], "this system did not step"
    reader.carry(0, [((id(first.high), id(first.high)), touch)])
    assert impulses()[0] == [1, 2, 3], "a body in contact with itself counts once, as in stock ManiSkill"
    reader.carry(0, [((id(first.high), id(first.low)), touch)])
    reader.carry(1, [])
    assert impulses() == [[1, 2, 3], [-1, -2, -3], [0, 0, 0]]
    reader.stepped(exclude=[1])
    assert impulses()[0] == own[0].tolist() and impulses()[2] == [0, 0, 0]
    reader.stepped()
    assert impulses()[2] == second_impulse
