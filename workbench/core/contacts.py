"""Contact impulses of bodies and pairs of bodies, over N CPU physics systems.

ManiSkill's GPU path makes a query object once and asks it every step; PhysX on the CPU gives a list
of contact objects, and reading the points of one costs microseconds in Python. So the lists are
walked at most once a step, whatever the number of queries, and the points are read only of contacts
that some query wants. Sums are formed in the order and precision of
``mani_skill.utils.sapien_utils.compute_total_impulse``, so that the numbers equal stock ManiSkill's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import sapien.physx as physx
import torch


class CpuArray:
    """Stands where SAPIEN's ``CudaArray`` stands on the GPU: something with ``.torch()``."""

    def __init__(self, tensor: torch.Tensor) -> None:
        self._tensor = tensor

    def torch(self) -> torch.Tensor:
        return self._tensor

    @property
    def shape(self) -> tuple[int, ...]:
        return tuple(self._tensor.shape)


@dataclass
class BodyImpulseQuery:
    """Net contact impulse of each body; the sign is that of an impulse on the body itself."""

    bodies: Sequence[physx.PhysxRigidBaseComponent]
    cuda_impulses: CpuArray
    """(len(bodies), 3) newton seconds of the last substep."""


@dataclass
class PairImpulseQuery:
    """Impulse on the first body of each pair by the second."""

    pairs: Sequence[tuple[physx.PhysxRigidBaseComponent, physx.PhysxRigidBaseComponent]]
    cuda_impulses: CpuArray
    """(len(pairs), 3) newton seconds of the last substep."""


@dataclass
class ContactReader:
    """Answers queries about the last substep of the systems; `invalidate` after each substep."""

    systems: Sequence[physx.PhysxCpuSystem]
    _wanted: set[int] = field(default_factory=set)
    _kept: list[Any] = field(default_factory=list)
    _cache: list[tuple[int, int, np.ndarray]] | None = None

    def create_body_query(self, bodies: Sequence[physx.PhysxRigidBaseComponent]) -> BodyImpulseQuery:
        bodies = list(bodies)
        self._want(bodies)
        return BodyImpulseQuery(bodies, CpuArray(torch.zeros((len(bodies), 3))))

    def create_pair_query(
        self, pairs: Sequence[tuple[physx.PhysxRigidBaseComponent, physx.PhysxRigidBaseComponent]]
    ) -> PairImpulseQuery:
        pairs = list(pairs)
        self._want([body for pair in pairs for body in pair])
        return PairImpulseQuery(pairs, CpuArray(torch.zeros((len(pairs), 3))))

    def invalidate(self) -> None:
        self._cache = None

    def query_bodies(self, query: BodyImpulseQuery) -> None:
        row = {id(body): i for i, body in enumerate(query.bodies)}
        total = np.zeros((len(query.bodies), 3))
        for first, second, impulse in self._contacts():
            # Not both: stock ManiSkill counts a contact for its first body only when the two are one.
            if first in row:
                total[row[first]] += impulse
            if second in row and second != first:
                total[row[second]] -= impulse
        query.cuda_impulses.torch().copy_(torch.from_numpy(total))

    def query_pairs(self, query: PairImpulseQuery) -> None:
        row = {(id(a), id(b)): i for i, (a, b) in enumerate(query.pairs)}
        total = np.zeros((len(query.pairs), 3))
        for first, second, impulse in self._contacts():
            if (first, second) in row:
                total[row[first, second]] += impulse
            elif (second, first) in row:
                total[row[second, first]] -= impulse
        query.cuda_impulses.torch().copy_(torch.from_numpy(total))

    def _want(self, bodies: list[physx.PhysxRigidBaseComponent]) -> None:
        # pybind11 gives the same Python object for the same body only while one is alive: without
        # this reference the ids below would be reused for other bodies.
        self._kept.extend(bodies)
        self._wanted.update(id(body) for body in bodies)
        self._cache = None

    def _contacts(self) -> list[tuple[int, int, np.ndarray]]:
        if self._cache is None:
            self._cache = []
            for system in self.systems:
                for contact in system.get_contacts():
                    first, second = contact.bodies
                    if id(first) in self._wanted or id(second) in self._wanted:
                        impulse = np.sum([point.impulse for point in contact.points], axis=0)
                        self._cache.append((id(first), id(second), impulse))
        return self._cache
