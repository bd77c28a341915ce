"""Bodies that are inside each other."""

from __future__ import annotations

from typing import Any

from workbench.envs.inspect_env import list_contacts
from workbench.envs.inspection import Overlap
from workbench.envs.maniskill_private import fetch, objects_of
from workbench.envs.scene.scene_index import scene_index

OVERLAP_METRES = 0.002
"""Depth in metres that two bodies may overlap: contacts of bodies at rest are about that deep."""


def first_substep(env: Any) -> None:
    """Make one substep of physics. Its contacts are those of the state before the substep."""
    env.scene.step()
    fetch(env)


def overlaps_of(env: Any, env_idx: int) -> tuple[Overlap, ...]:
    """Bodies that overlapped at the start of the last substep, deepest first. Links of one articulation that touch are left out,
    since joints hold them.

    Raises:
        NotImplementedError: the env is simulated on the GPU.
    """
    deepest: dict[tuple[str, str], float] = {}
    for contact in list_contacts(env, env_idx):
        first, second = sorted(contact.bodies)
        if first.split("/")[0] == second.split("/")[0] and "/" in first:
            continue
        depth = -float(contact.separations.min(initial=0.0))
        if depth > deepest.get((first, second), 0.0):
            deepest[first, second] = depth
    return tuple(Overlap(pair, depth) for pair, depth in sorted(deepest.items(), key=lambda item: -item[1]))


def overlaps_to_report(env: Any) -> tuple[tuple[Overlap, ...], ...]:
    """For each env, `overlaps_of` that are deeper than `OVERLAP_METRES` and have a body that can move.

    Raises:
        NotImplementedError: the env is simulated on the GPU.
    """
    fixed = immovable(env)
    return tuple(
        tuple(
            overlap
            for overlap in overlaps_of(env, env_idx)
            if overlap.depth > OVERLAP_METRES and not fixed.issuperset(overlap.bodies)
        )
        for env_idx in range(env.num_envs)
    )


def immovable(env: Any) -> set[str]:
    """Names of the bodies that no contact moves: static and kinematic bodies, and links that only fixed
    joints connect to a fixed root."""
    index = scene_index(env)
    found = {
        name for name, kind in zip(index.names, index.kinds, strict=True) if kind in ("static", "kinematic")
    }
    for articulation in env.scene.articulations.values():
        for link in objects_of(articulation)[0].links:
            name, above = index.name_of(link), link
            while above is not None and above.joint.type == "fixed":
                above = above.parent
            if name is not None and above is None:
                found.add(name)
    return found
