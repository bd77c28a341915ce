"""Which bodies of an env touch, where, and how hard: for people who look, not for rewards.

A task asks for the impulse on a body it knows (`contacts`); a person who wonders why the peg will not go in
wants to see everything that touches anything. PhysX on the CPU has that list, and ManiSkill gives it for a
single env only (``scene.get_contacts()``). Here it is read for one env at a time, with the names under which
the rest of the workbench shows the bodies; the other envs cost nothing.

A contact here is what PhysX calls one: two collision *shapes* that are nearer than their contact offsets
(1 cm each unless the task says otherwise). So a pair of bodies may come more than once, and a contact with a
positive `separation` and no impulse is two shapes that are near and do not touch.
"""

from __future__ import annotations

import operator
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import sapien.physx as physx
from numpy.typing import NDArray

from workbench.core import seams
from workbench.core.cpu_system import batched_system
from workbench.core.env_numbers import require_env
from workbench.core.scene_index import SceneIndex, scene_index


@dataclass(frozen=True)
class Contact:
    """One pair of shapes in the last substep, with K points; float32, the env's own world frame."""

    bodies: tuple[str, str]
    """Names as in `SceneIndex.names`; the name of the ``sapien.Entity`` for what ManiSkill does not manage."""
    points: NDArray[np.float32]
    """(K, 3) metres."""
    normals: NDArray[np.float32]
    """(K, 3) unit vectors from the second body towards the first."""
    impulses: NDArray[np.float32]
    """(K, 3) newton seconds ON the first body, BY the second, in the last substep; friction is in it."""
    separations: NDArray[np.float32]
    """(K,) metres between the surfaces; negative where they overlap."""
    timestep: float
    """Seconds of a substep."""

    @property
    def impulse(self) -> NDArray[np.float32]:
        """(3,) newton seconds on the first body: the sum of `impulses`."""
        return self.impulses.sum(axis=0)

    @property
    def force(self) -> NDArray[np.float32]:
        """(3,) newtons on the first body, the mean over the last substep. On the second: its negative."""
        return self.impulse / np.float32(self.timestep)


def list_contacts(env: Any, env_idx: int) -> tuple[Contact, ...]:
    """All contacts of one env in its last substep, ordered by their bodies' names, then by their points.

    (SAPIEN's own order is that of memory addresses: it differs from run to run of the same episode.)

    A state that was set since (a reset, a restored snapshot) has no contacts of its own until the next step:
    the list is still that of the last substep, as in stock ManiSkill.

    Args:
        env: a ManiSkill env (reset at least once; wrappers are looked through): batched on the CPU, or stock.

    Raises:
        IndexError: there is no such env.
        NotImplementedError: the env is simulated on the GPU.
    """
    env, env_idx = seams.open_env(env), operator.index(env_idx)
    require_env(env_idx, env.num_envs)
    batched = batched_system(env.scene)
    if batched is None and env.scene.gpu_sim_enabled:
        raise NotImplementedError(
            "PhysX on the GPU keeps no list of contacts that can be read: open the task with the CPU backend."
        )
    system = env.scene.px if batched is None else batched.systems[env_idx]
    index, timestep = scene_index(env), env.scene.timestep
    contacts = [_read(contact, index, timestep) for contact in system.get_contacts()]
    return tuple(sorted(contacts, key=_place))


def _place(contact: Contact) -> tuple[Any, ...]:
    # Two shapes of one body may touch the same point: then they differ in depth.
    return contact.bodies, contact.points.tolist(), contact.separations.tolist(), contact.impulses.tolist()


def _read(contact: physx.PhysxContact, index: SceneIndex, timestep: float) -> Contact:
    first, second = contact.bodies
    points = contact.points
    return Contact(
        bodies=(index.name_of(first) or first.entity.name, index.name_of(second) or second.entity.name),
        points=_rows([point.position for point in points]),
        normals=_rows([point.normal for point in points]),
        impulses=_rows([point.impulse for point in points]),
        separations=np.array([point.separation for point in points], dtype=np.float32),
        timestep=timestep,
    )


def _rows(vectors: Sequence[Any]) -> NDArray[np.float32]:
    return np.array(vectors, dtype=np.float32).reshape(-1, 3)
