"""Camera reports: what a camera sees of each object, as arrays over envs."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, fields, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from workbench.core.camera_data import CameraKey, CameraKind, CameraSettings, Picture
from workbench.core.cameras.conventions import intrinsic_of

DEPTH_EDGES: NDArray[np.float64] = np.geomspace(0.01, 100.0, 41)
"""Metres, (41,). Ten bins a decade, and the same for every camera, so that histograms can be laid over each other;
what is nearer or farther than all of them is counted in the first or the last bin."""
ENOUGH_PIXELS = 100.0
"""From here on an object does not count as small: a cube of ten by ten pixels still shows which way it is turned."""


@dataclass(frozen=True)
class ObjectToSee:
    """One object that a camera may be asked to see: of the task, or a robot, of which single links can be asked for."""

    name: str
    """An actor's or an articulation's."""
    hidden: bool
    """The task hides it from the sensors (a goal marker): only cameras for people see it."""
    links: tuple[str, ...] = ()
    """Names of an articulation's bodies, if it has several: each may be asked for alone. Of a robot those that can be
    seen, its hand first."""
    robot: bool = False


@dataclass(frozen=True)
class ObjectSummary:
    """One object over all envs that have it; shares are 0..1, and NaN where there is nothing to share out."""

    present: int
    """Envs that have the object."""
    seen: float
    """Share of them in which at least one of its pixels is in the picture."""
    median_pixels: float
    cut: float
    """Share of them in which the border of the picture cuts it."""
    hidden: float
    """How much of it the robot covers, on average over the envs where it would be seen without the robot."""
    wholly_hidden: float
    """Share of the envs that have it in which nothing but the robot keeps it from being seen."""
    covered: float
    """How much of it other things than the robot cover, on average over the envs where it is in the picture."""


@dataclass(frozen=True)
class ObjectSeen:
    """One object of the task in the pictures of E envs."""

    name: str
    """An actor's or an articulation's."""
    never_drawn: bool
    """The task hides it from this kind of camera (a goal marker from the sensors): it is not to be seen."""
    scenery: bool
    """Part of the room (a table, a static body): nothing that a policy has to find."""
    present: NDArray[np.bool_]
    """(E,) whether the env has it at all."""
    pixels: NDArray[np.float32]
    """(E,) seen, in pixels of the camera's own size, also where smaller pictures were judged."""
    unhindered: NDArray[np.float32]
    """(E,) what they would be if the robot were not drawn."""
    alone: NDArray[np.float32]
    """(E,) what they would be if nothing else were drawn; `unhindered` for scenery, of which that is not asked."""
    cut: NDArray[np.bool_]
    """(E,) it reaches the border of the picture, seen alone."""
    margin: NDArray[np.float32]
    """(E,) from it to the nearest border, as a share of the picture's shorter side; 0 where it is cut or not seen."""

    @property
    def hidden_share(self) -> NDArray[np.float32]:
        """(E,) how much of it the robot covers; NaN where it would not be seen without the robot either."""
        return _share_lost(self.pixels, self.unhindered)

    @property
    def covered_share(self) -> NDArray[np.float32]:
        """(E,) how much of it other things than the robot cover; NaN where it is out of the picture."""
        return _share_lost(self.unhindered, self.alone)

    def marks(self) -> NDArray[np.float32]:
        """(E,) 0 where it is not seen, 1 where it is whole, in the open and large enough; NaN where it is absent.

        The product of what is left to see: the share that nothing covers, half where the border cuts it, and
        for small objects the square root of their pixels (a length: twice as far away is half as good).
        """
        size = np.sqrt(np.clip(self.alone / ENOUGH_PIXELS, 0, 1))
        open_share = np.clip(self.pixels / np.maximum(self.alone, 1e-6), 0, 1)
        marks = np.where(self.pixels > 0, size * open_share * np.where(self.cut, 0.5, 1.0), 0.0)
        return np.where(self.present, marks, np.nan).astype(np.float32)

    def summary(self) -> ObjectSummary:
        here = self.present
        count = int(here.sum())
        if not count:
            return ObjectSummary(0, *[float("nan")] * 6)
        could, inside = here & (self.unhindered > 0), here & (self.alone > 0)
        return ObjectSummary(
            present=count,
            seen=float((self.pixels[here] > 0).mean()),
            median_pixels=float(np.median(self.pixels[here])),
            cut=float(self.cut[here].mean()),
            hidden=float(self.hidden_share[could].mean()) if could.any() else float("nan"),
            wholly_hidden=float((could & (self.pixels == 0)).sum() / count),
            covered=float(self.covered_share[inside].mean()) if inside.any() else float("nan"),
        )


@dataclass(frozen=True)
class DepthReport:
    """How far away is what the camera sees, robot and all."""

    counts: NDArray[np.int64]
    """(E, 40) pixels of the judged pictures between `DEPTH_EDGES`; background is not among them."""
    background: NDArray[np.float32]
    """(E,) share of the picture in which a ray meets nothing, which is a depth of 0."""
    beyond: NDArray[np.float32]
    """(E,) share that lies farther away than everything that counts (robot and objects): far floor and walls."""
    nearest: NDArray[np.float32]
    """(E,) metres; NaN where the picture is all background."""
    farthest_object: NDArray[np.float32]
    """(E,) metres, of robot and objects that are no scenery; NaN where none of them is seen."""

    @property
    def suggested_near(self) -> float | None:
        """Metres: half of the nearest that was ever seen, rounded down. None where nothing was seen."""
        nearest = _least(self.nearest)
        return None if nearest is None else _rounded(nearest / 2, up=False)

    @property
    def suggested_far(self) -> float | None:
        """Metres: half as far again as the farthest object ever seen, rounded up; what is behind turns background."""
        farthest = _least(-self.farthest_object)
        return None if farthest is None else _rounded(-farthest * 1.5, up=True)


@dataclass(frozen=True)
class CameraReport:
    """One camera, or a placement that is only thought of, judged in E envs."""

    camera: CameraKey
    size: tuple[int, int]
    """Width and height of the camera's own picture."""
    measured_size: tuple[int, int]
    """Of the pictures that were judged. Where they are smaller, what is less than a pixel in them is not seen."""
    envs: tuple[int, ...]
    """(E,) an env may come several times: at several moments, or with several seeds."""
    objects: tuple[ObjectSeen, ...]
    depth: DepthReport
    pictures: int
    """Rendered for it."""
    milliseconds: float

    def env_marks(self, wanted: Collection[str] | None = None) -> NDArray[np.float32]:
        """(E,) the mark of the worst object in each env; see `ObjectSeen.marks`. NaN where none is to be seen.

        Args:
            wanted: names of the objects that must be seen; None for all that are drawn and no scenery.

        Raises:
            ValueError: there is no such object.
        """
        marks = [thing.marks() for thing in self.wanted_objects(wanted)]
        if not marks:
            return np.full(len(self.envs), np.nan, np.float32)
        worst = np.min(np.nan_to_num(marks, nan=np.inf), axis=0)
        return np.where(np.isinf(worst), np.nan, worst).astype(np.float32)

    def worst_first(self, wanted: Collection[str] | None = None) -> tuple[int, ...]:
        """Positions in `envs`, the worst mark first; equal marks as they come, envs with nothing to see last."""
        return tuple(
            int(i) for i in np.argsort(np.nan_to_num(self.env_marks(wanted), nan=2.0), kind="stable")
        )

    def wanted_objects(self, wanted: Collection[str] | None = None) -> tuple[ObjectSeen, ...]:
        """The objects of these names; None for all that are drawn and no scenery."""
        if wanted is None:
            return tuple(thing for thing in self.objects if not (thing.never_drawn or thing.scenery))
        unknown = sorted(set(wanted) - {thing.name for thing in self.objects})
        if unknown:
            there = ", ".join(thing.name for thing in self.objects) or "none"
            raise ValueError(f"there is no object {', '.join(unknown)}; there are: {there}")
        return tuple(thing for thing in self.objects if thing.name in wanted)


@dataclass(frozen=True)
class SearchSpace:
    """What is looked for, and where."""

    objects: tuple[str, ...]
    """Names of actors, articulations and single links (``cabinet/handle``) that must be seen."""
    low: tuple[float, float, float]
    """Of the box for the eye, metres in the frame of the mount, or the env's if there is none."""
    high: tuple[float, float, float]
    lens: CameraSettings
    """Everything of the camera but its pose; of that, where it is mounted, which way its picture is up."""
    kind: CameraKind = "sensor"
    candidates: int = 100
    """Placements that the first round draws."""
    best: int = 5
    """Placements that are offered at most."""
    apart: float | None = None
    """Metres between the eyes of two that are offered; None for a seventh of the box's diagonal."""
    seed: int = 0
    mount: str | None = None
    """Name of the body that the camera rides on."""

    def check(self) -> None:
        """Raises ValueError where nothing can be looked for like that."""
        box = np.array([self.low, self.high], np.float64)
        if not np.isfinite(box).all() or (box[0] > box[1]).any():
            raise ValueError(
                f"the box for the eye goes from {self.low} to {self.high}: each low must be below its high"
            )
        if not self.objects:
            raise ValueError("name at least one object that must be seen")
        if self.candidates < 1 or self.best < 1:
            raise ValueError("a search draws at least one placement and offers at least one")
        intrinsic_of(self.lens)


@dataclass(frozen=True)
class OfferedPlacement:
    """One of the best that `camera_search` found."""

    settings: CameraSettings
    """In the frame of the camera's mount, or the env's if it has none."""
    target: tuple[float, float, float]
    """A point on its line of sight, for a look-at."""
    score: float
    """0..1, higher is better; see `camera_search.score_of`."""
    words: str
    """What it sees, in a sentence."""
    report: CameraReport
    picture: Picture
    """From there, of the env where it does worst."""


_Part = TypeVar("_Part", ObjectSeen, DepthReport)


def join_reports(reports: Sequence[CameraReport]) -> CameraReport:
    """One report over all envs of several: the steps of an episode, or several seeds, of one camera.

    Raises:
        ValueError: there is none, or they are not of one camera and one scene.
    """
    if not reports:
        raise ValueError("there is no report to join")
    first = reports[0]
    for other in reports[1:]:
        if (other.camera, other.size, other.measured_size) != (first.camera, first.size, first.measured_size):
            raise ValueError(
                "reports of different cameras, or of pictures of different sizes, cannot be joined"
            )
        if [thing.name for thing in other.objects] != [thing.name for thing in first.objects]:
            raise ValueError("the reports are of different scenes: their objects are not the same")
    return replace(
        first,
        envs=tuple(env for report in reports for env in report.envs),
        objects=tuple(
            _end_to_end(same) for same in zip(*(report.objects for report in reports), strict=True)
        ),
        depth=_end_to_end([report.depth for report in reports]),
        pictures=sum(report.pictures for report in reports),
        milliseconds=sum(report.milliseconds for report in reports),
    )


def _end_to_end(parts: Sequence[_Part]) -> _Part:
    """One of several, its arrays those of all of them one behind the other."""
    first = parts[0]
    arrays = [f.name for f in fields(first) if isinstance(getattr(first, f.name), np.ndarray)]
    return replace(
        first, **{name: np.concatenate([getattr(part, name) for part in parts]) for name in arrays}
    )


def report_text(report: CameraReport, objects: tuple[str, ...]) -> str:
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


def _share_lost(left: NDArray[np.float32], whole: NDArray[np.float32]) -> NDArray[np.float32]:
    with np.errstate(divide="ignore", invalid="ignore"):
        share = 1 - left / whole
    return np.where(whole > 0, np.clip(share, 0, 1), np.nan).astype(np.float32)


def _least(values: NDArray[np.float32]) -> float | None:
    known = values[np.isfinite(values)]
    return float(known.min()) if len(known) else None


def _rounded(value: float, up: bool) -> float:
    """To two digits, away from what must stay inside."""
    step = 10.0 ** (np.floor(np.log10(value)) - 1)
    digits = (np.ceil if up else np.floor)(np.round(value / step, 6))
    return float(np.round(digits * step, 9))
