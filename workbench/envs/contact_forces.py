"""Contact forces between chosen pairs of bodies, in all envs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sapien.physx import PhysxRigidBaseComponent

from workbench.envs.scene.scene_index import once_a_scene, scene_index
from workbench.envs.step_result import BodyPair


def pair_forces(
    env: Any, pairs: Sequence[BodyPair], known: NDArray[np.bool_]
) -> dict[BodyPair, NDArray[np.float32]]:
    """(N,) magnitude in newtons of the net contact force between two bodies in the last substep, by pair.

    NaN for an env that lacks one of the bodies or is not `known`. Leaves out a pair with a body that the scene does not have.

    Args:
        env: ManiSkill env, unwrapped; a batched one, on the CPU or GPU.
        known: (N,) whether a step led to the env's state: after a reset or a move by hand, PhysX still has the contacts
            of the last step.
    """
    names, px = scene_index(env).names, env.scene.px
    found: dict[BodyPair, NDArray[np.float32]] = {}
    for pair in pairs:
        if not {*pair} <= {*names}:
            continue
        queries = _queries(env)
        if pair not in queries:
            queries[pair] = _query(env, pair)
        envs, query = queries[pair]
        newtons = np.full(env.num_envs, np.nan, np.float32)
        if len(envs):
            px.gpu_query_contact_pair_impulses(query)
            impulses = query.cuda_impulses.torch().numpy(force=True)
            newtons[envs] = np.linalg.norm(impulses, axis=1) / px.timestep
        found[pair] = np.where(known, newtons, np.float32(np.nan))
    return found


@once_a_scene
def _queries(env: Any) -> dict[BodyPair, tuple[NDArray[np.int64], Any]]:
    """PhysX's queries that were made for this scene, with the envs of their rows."""
    return {}


def _query(env: Any, pair: BodyPair) -> tuple[NDArray[np.int64], Any]:
    index = scene_index(env)
    columns = [index.entities[:, index.names.index(name)] for name in pair]
    both = [(env_idx, a, b) for env_idx, (a, b) in enumerate(zip(*columns, strict=True)) if a and b]
    bodies = [
        (a.find_component_by_type(PhysxRigidBaseComponent), b.find_component_by_type(PhysxRigidBaseComponent))
        for _, a, b in both
    ]
    query = env.scene.px.gpu_create_contact_pair_impulse_query(bodies) if bodies else None
    return np.array([env_idx for env_idx, _, _ in both], np.int64), query
