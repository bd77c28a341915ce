"""Contact impulses of bodies and of pairs of bodies, over N CPU physics systems."""

from __future__ import annotations

import weakref
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import sapien.physx as physx
import torch
from numpy.typing import NDArray

_Key = int | tuple[int, int]
"""The ``id`` of a body, or the ids of two bodies."""


class CpuArray:
    """A CPU tensor in place of SAPIEN's ``CudaArray``."""

    def __init__(self, tensor: torch.Tensor) -> None:
        self._tensor = tensor

    def torch(self) -> torch.Tensor:
        return self._tensor

    @property
    def shape(self) -> tuple[int, ...]:
        return tuple(self._tensor.shape)


@dataclass(eq=False)
class ImpulseQuery:
    """Net contact impulses of bodies, or of pairs: on the first body by the second."""

    held: Sequence[Any]
    """The bodies or pairs, kept alive: `rows` has their ids, and pybind11 gives a body a new Python object,
    with another id, once the last reference is gone."""
    cuda_impulses: CpuArray
    """(len(held), 3) newton seconds of the last substep."""
    rows: Mapping[_Key, Sequence[tuple[int, int]]]
    """Row and sign 1 of each body; or row and sign (1 or -1) of each pair, in both orders."""


@dataclass
class ContactReader:
    """Answers queries about the last substep of the systems; call `stepped` after each substep.

    Reading the points of a PhysX contact takes microseconds in Python. So the lists are walked at most once a
    step, for any number of queries, and points are read only for contacts that a query counts. (PickCube, 64
    envs: ``is_grasping`` takes 1,200 us of a control step, of which 850 are ManiSkill's own; 1,900 us if
    every contact of the cube is read.) Sums have the order and precision of
    ``mani_skill.utils.sapien_utils.compute_total_impulse``, so that numbers equal stock ManiSkill's.
    """

    systems: Sequence[physx.PhysxCpuSystem]
    _queries: weakref.WeakSet[ImpulseQuery] = field(default_factory=weakref.WeakSet)
    _wanted: set[_Key] = field(default_factory=set)
    _cache: list[tuple[tuple[int, int], NDArray[np.float32]]] | None = None
    _carried: dict[int, list[tuple[tuple[int, int], NDArray[np.float32]]]] = field(default_factory=dict)
    """Contacts of systems whose state was restored; see `carry`."""

    def create_body_query(self, bodies: Sequence[physx.PhysxRigidBaseComponent]) -> ImpulseQuery:
        return self._create([*bodies], [(i, id(body), 1) for i, body in enumerate(bodies)])

    def create_pair_query(
        self, pairs: Sequence[tuple[physx.PhysxRigidBaseComponent, physx.PhysxRigidBaseComponent]]
    ) -> ImpulseQuery:
        both = [((i, (id(a), id(b)), 1), (i, (id(b), id(a)), -1)) for i, (a, b) in enumerate(pairs)]
        return self._create([*pairs], [row for rows in both for row in rows])

    def _create(self, held: list[Any], what: Sequence[tuple[int, _Key, int]]) -> ImpulseQuery:
        rows: dict[_Key, list[tuple[int, int]]] = {}
        for row, key, sign in what:
            rows.setdefault(key, []).append((row, sign))
        query = ImpulseQuery(held, CpuArray(torch.zeros((len(held), 3))), rows)
        # Held weakly: a task may make new queries after every reset, and dropped ones must cost nothing.
        self._queries.add(query)
        self._wanted = {key for query in self._queries for key in query.rows}
        self._cache = None
        return query

    def invalidate(self) -> None:
        self._cache = None

    def stepped(self, exclude: Collection[int] = ()) -> None:
        """Note that all systems except those in `exclude` made a substep: PhysX's lists of their contacts are
        valid again."""
        self._cache = None
        self._carried = {env: touching for env, touching in self._carried.items() if env in exclude}

    def carry(self, system: int, contacts: list[tuple[tuple[int, int], NDArray[np.float32]]]) -> None:
        """Use these contacts, as returned by `counted`, for one system until its next substep.

        PhysX's own list is that of the last substep before the state was restored.
        """
        self._carried[system] = contacts
        self._cache = None

    def answer(self, query: ImpulseQuery) -> None:
        """Sum the impulses that the query counts into `ImpulseQuery.cuda_impulses`."""
        total, rows = np.zeros((len(query.held), 3)), query.rows
        for pair, impulse in self.counted():
            first, second = pair
            for key in (pair, first):
                for row, sign in rows.get(key, ()):
                    total[row] += impulse * sign
            # If both are the same body, stock ManiSkill counts the contact only for the first.
            for row, _ in rows.get(second, ()) if second != first else ():
                total[row] -= impulse
        query.cuda_impulses.torch().copy_(torch.from_numpy(total))

    def counted(self) -> list[tuple[tuple[int, int], NDArray[np.float32]]]:
        """Ids of the two bodies, and the impulse on the first, for every contact that a query counts."""
        if self._cache is None:
            found = self._cache = []
            wanted = self._wanted
            # Without a query nothing is counted; reading the lists of 256 systems would take a millisecond.
            asked = range(len(self.systems)) if wanted else sorted(self._carried)
            for index in asked:
                if index in self._carried:
                    found += self._carried[index]
                    continue
                system = self.systems[index]
                for contact in system.get_contacts():
                    a, b = contact.bodies
                    first, second = pair = id(a), id(b)
                    if pair in wanted or first in wanted or second in wanted:
                        # np.sum without its three wrappers.
                        impulse = np.add.reduce([point.impulse for point in contact.points], axis=0)
                        found.append((pair, impulse))
        return self._cache
