"""Draws bodies at poses other than their simulated poses, without moving them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np
import sapien
import sapien.render
from numpy.typing import NDArray

from workbench.envs.maniskill_private import draw_at

Places = Mapping[int, tuple[Any, NDArray[np.float32]]]
"""Entities and the poses (7,) to draw them at, by the ``id`` of the entity."""
NOWHERE_ELSE: Places = {}


@contextmanager
def drawn_at(places: Places, components: Iterable[Any] = ()) -> Iterator[Callable[[], None]]:
    """Context in which entities and their cameras are drawn at `places`; the entities stay where they are.

    Yields a function that moves the drawn bodies: call it after each ``update_render``, which moves them back
    to their entities. The cameras are moved when the context begins.

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
    """Context in which attributes (owner, name, value) have these values."""
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
    """Pose of a camera in its env's frame, when the camera's entity is drawn at its pose in `places`."""
    if id(component.entity) not in places:
        return component.get_global_pose()
    pose = places[id(component.entity)][1]
    return sapien.Pose(pose[:3], pose[3:]) * component.local_pose  # type: ignore[arg-type]
