"""A placement that is offered to the author, as plain data that crosses the pipe; `camera_search` finds them."""

from __future__ import annotations

from dataclasses import dataclass

from workbench.core.camera_report import CameraReport
from workbench.core.camera_settings import CameraSettings
from workbench.core.pictures import Picture


@dataclass(frozen=True)
class OfferedPlacement:
    """One of the best that a search found."""

    settings: CameraSettings
    """In the frame of the camera's mount, or the env's if it has none."""
    target: tuple[float, float, float]
    """A point on its line of sight, for a look-at."""
    score: float
    """0..1, higher is better."""
    words: str
    """What it sees, in a sentence."""
    report: CameraReport
    picture: Picture
    """From there, of the env where it does worst."""


def in_words(report: CameraReport, objects: tuple[str, ...]) -> str:
    """What was measured of these objects, for a person: ``cube: in 8 of 8 envs, about 210 pixels``."""
    told = []
    for thing in report.wanted_objects(objects):
        all_envs = thing.summary()
        if not all_envs.present:
            continue
        seen = round(all_envs.seen * all_envs.present)
        words = (
            f"{thing.name}: in {seen} of {all_envs.present} envs, about {all_envs.median_pixels:.0f} pixels"
        )
        if all_envs.cut > 0:
            words += f", cut by the border in {all_envs.cut:.0%}"
        if all_envs.hidden > 0.005:
            words += f", {all_envs.hidden:.0%} behind the robot"
        told.append(words)
    return "; ".join(told)
