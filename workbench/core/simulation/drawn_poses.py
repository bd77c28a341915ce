"""Draws bodies elsewhere than SAPIEN has them, without moving them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import sapien
import sapien.render
from numpy.typing import NDArray

from workbench.core.maniskill_private import draw_at
from workbench.core.simulation.state_layout import StateLayout

Places = Mapping[int, tuple[Any, NDArray[np.float32]]]
"""Entities and the poses (7,) to draw them at, by the ``id`` of the entity."""
NOWHERE_ELSE: Places = {}


def bodies_elsewhere(
    scenes: Sequence[sapien.Scene], layout: StateLayout, data: NDArray[np.float32], envs: Sequence[int]
) -> dict[int, Places]:
    """By env, the bodies that the tensor has elsewhere than SAPIEN, and where; envs without such are left out.

    ManiSkill's GPU cameras draw the tensor that poses are written to (``RenderSystemGroup.set_cuda_poses``), applied or not: a
    pose set in ``evaluate`` is seen and never felt, and a body that moved in a step is drawn where it was until the fetch.
    SAPIEN's CPU renderer draws its entities. Before each picture what differs is therefore moved, in what is drawn only.
    Static bodies have no row.

    Args:
        data: (R, 13) ManiSkill's ``cuda_rigid_body_data``.
    """
    # Packed again although a fetch may have done it: an entity may have been moved directly since.
    packs = [scenes[env].pack_poses() for env in envs]
    starts = np.full(len(scenes), -1, dtype=np.int64)
    starts[envs] = np.cumsum([0, *(len(pack) // 4 for pack in packs[:-1])])
    rows = np.flatnonzero(starts[layout.env_of_row] >= 0) if len(envs) < len(scenes) else slice(None)
    at = layout.pose_at[rows] + starts[layout.env_of_row[rows], None]
    differs = np.frombuffer(b"".join(packs), dtype=np.float32)[at] != data[rows, :7]
    if not differs.any():
        return {}
    found: dict[int, dict[int, tuple[Any, NDArray[np.float32]]]] = {}
    for row in np.arange(len(data))[rows][differs.any(axis=1)]:
        entity = layout.entities[row]
        found.setdefault(int(layout.env_of_row[row]), {})[id(entity)] = entity, data[row, :7].copy()
    return dict(found)


@contextmanager
def drawn_at(places: Places, components: Iterable[Any] = ()) -> Iterator[Callable[[], None]]:
    """Within this, draw entities and their cameras at `places`; the entities stay where they are.

    Yields a function that moves what is drawn: call it after ``update_render``, which draws entities where they are.
    Cameras are moved before it.

    Args:
        components: cameras that may be on one of the entities.
    """
    on_them = [c for c in components if id(c.entity) in places] if places else []
    cameras = [(c, "local_pose", c.entity.pose.inv() * camera_pose(c, places)) for c in on_them]

    def move_bodies() -> None:
        for entity, pose in places.values():
            for drawn in entity.components:
                if isinstance(drawn, sapien.render.RenderBodyComponent):
                    draw_at(drawn, pose)

    with temporarily(cameras):
        yield move_bodies


@contextmanager
def temporarily(changes: Iterable[tuple[Any, str, Any]]) -> Iterator[None]:
    """Within this, attributes (owner, name, value) have these values."""
    was: list[tuple[Any, str, Any]] = []
    try:
        for owner, name, value in changes:
            was.append((owner, name, getattr(owner, name)))
            setattr(owner, name, value)
        yield
    finally:
        for owner, name, value in reversed(was):
            setattr(owner, name, value)


def camera_pose(component: Any, places: Places) -> sapien.Pose:
    """Pose of a camera in its env's frame, with its entity drawn at `places`."""
    if id(component.entity) not in places:
        return component.get_global_pose()
    pose = places[id(component.entity)][1]
    return sapien.Pose(pose[:3], pose[3:]) * component.local_pose  # type: ignore[arg-type]
