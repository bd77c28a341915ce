"""Where a sensor stands that is added: on the side from which somebody looks, near enough to see the task's objects.

Who adds a camera looks at a whole table, or at a grid of sixteen, from metres away, and at that distance a cube is four
pixels of a picture of 128. What they have chosen is the side. So the direction of their view is kept, and the eye goes
along it to where the objects of all envs fill the picture; if they look from about there, it stands where they look
from.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from workbench.core.camera_frames import axes_of, intrinsic_of, pose_of, vertical_fov
from workbench.core.camera_settings import CameraSettings
from workbench.session.view import SessionView
from workbench.ui.camera_moves import rounded

AROUND = 0.1
"""Metres of room around the middles of the objects."""
ROOM = 1.25
"""Times the distance from which they just fill the picture."""
NEAREST = 0.6
"""Metres from which a hand that reaches for one small thing is in the picture too."""
NEAR_ENOUGH = 1.5
"""Times the distance that is wanted, up to which an eye stays where it is."""
NEAREST_TARGET = 0.1
"""Metres."""
MOST_NAMES = 3


@dataclass(frozen=True)
class FirstPlace:
    settings: CameraSettings
    words: str
    """Where that is, a sentence."""
    target: tuple[float, float, float] | None = None
    """The point on its line of sight that is nearest to the objects; None if they are not before it."""


def first_place(seen_from: CameraSettings, names: tuple[str, ...], places: NDArray[np.float64]) -> FirstPlace:
    """
    Args:
        seen_from: a camera of the lens that is added, where somebody looks from, in the env's frame.
        names: of the objects that it is to see.
        places: (K, 3) where they are in all envs, each in its env's frame.
    """
    stays = "It stands where you look from."
    if not len(places):
        return FirstPlace(seen_from, stays)
    pose = pose_of(seen_from)
    # One object that fell from the table must not take the camera away from all others.
    middle = np.median(places, axis=0)
    reach = float(np.quantile(np.linalg.norm(places - middle, axis=1), 0.9)) + AROUND
    fov = vertical_fov(intrinsic_of(seen_from), seen_from.height)
    wanted = max(NEAREST, ROOM * reach / math.sin(fov / 2))
    away = float(np.linalg.norm(middle - pose[:3]))
    if away <= NEAR_ENOUGH * wanted:
        return FirstPlace(seen_from, stays, aimed_at(seen_from, places))
    x, y, z = rounded(middle - wanted * axes_of(pose[3:])[0], 4)
    told = ", ".join(names[:MOST_NAMES]) + (" and others" if len(names) > MOST_NAMES else "")
    settings = replace(seen_from, position=(x, y, z))
    return FirstPlace(
        settings,
        f"It looks from your side at {told} from {wanted:.2f} m; you look from {away:.1f} m away.",
        aimed_at(settings, places),
    )


def aimed_at(settings: CameraSettings, places: NDArray[np.float64]) -> tuple[float, float, float] | None:
    """The point ahead of a camera that is nearest to the middle of some places (K, 3); None if that is behind it."""
    if not len(places):
        return None
    pose = pose_of(settings)
    forward = axes_of(pose[3:])[0]
    distance = float((np.median(places, axis=0) - pose[:3]) @ forward)
    if distance < NEAREST_TARGET:
        return None
    x, y, z = (pose[:3] + distance * forward).tolist()
    return x, y, z


def objects_in(view: SessionView) -> tuple[tuple[str, ...], NDArray[np.float64]]:
    """What a sensor may see of a task's objects, and (K, 3) where it is in all envs at the shown moment."""
    task, step = view.task, view.step
    if task is None or step is None or step.poses.shape[1] != len(task.geometry.body_names):
        return (), np.zeros((0, 3))
    objects = [thing for thing in task.objects if not (thing.hidden or thing.robot)]
    bodies = {name for thing in objects for name in (thing.links or (thing.name,))}
    columns = [i for i, name in enumerate(task.geometry.body_names) if name in bodies]
    places = step.poses[:, columns, :3].reshape(-1, 3).astype(np.float64)
    return tuple(thing.name for thing in objects), places[np.isfinite(places).all(axis=1)]
