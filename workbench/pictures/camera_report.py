"""Camera reports: what a camera sees of each object, as arrays over envs."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, fields, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from workbench.envs.camera_data import CameraKey, CameraKind, CameraSettings, Picture
from workbench.pictures.camera_conventions import intrinsic_of

DEPTH_EDGES_METRES: NDArray[np.float64] = np.geomspace(0.01, 100.0, 41)
"""(41,) edges of depth bins, ten bins per decade. They are the same for every camera, so that histograms can
be compared; depths outside of the edges count in the first or last bin."""
LARGE_ENOUGH_PIXELS = 100.0
"""Number of pixels below which `ObjectSeen.marks` are reduced: a cube of ten by ten pixels still shows its
rotation."""


@dataclass(frozen=True)
class ObjectToSee:
    """An object of the task, or a robot. A search can name objects and links, but not a whole robot."""

    name: str
    """Name of an actor or an articulation."""
    hidden: bool
    """Whether the task hides it from the sensors (a goal marker), so that only human cameras see it."""
    links: tuple[str, ...] = ()
    """Names of an articulation's bodies, if it has several; for a robot its drawn links, the hand first."""
    robot: bool = False


@dataclass(frozen=True)
class ObjectSummary:
    """One object over all envs that have it; shares are 0..1, NaN where undefined."""

    present: int
    """Number of envs that have the object."""
    seen: float
    """Share of these envs in which at least one pixel of the object is in the picture."""
    median_pixels: float
    """Median over these envs of the number of visible pixels of the object."""
    cut: float
    """Share of these envs in which the border of the picture cuts the object."""
    hidden: float
    """Share of the object that the robot covers, averaged over the envs in which the object would be seen
    without the robot."""
    wholly_hidden: float
    """Share of the envs that have the object in which it is not visible but would be without the robot."""
    covered: float
    """Share of the object that things other than the robot cover, averaged over the envs in which the object
    would be in the picture if nothing covered it."""


@dataclass(frozen=True)
class ObjectSeen:
    """One object of the task in the pictures of E envs."""

    name: str
    """Name of an actor or an articulation."""
    never_drawn: bool
    """Whether the task hides it from this kind of camera (a goal marker from the sensors)."""
    scenery: bool
    """Whether it is part of the room (a table, a static body), which a policy need not find."""
    present: NDArray[np.bool_]
    """(E,) whether the env has the object at all."""
    pixels: NDArray[np.float32]
    """(E,) visible pixels, scaled to the camera's own picture size if smaller pictures were measured."""
    unhindered: NDArray[np.float32]
    """(E,) pixels that are visible without the robot."""
    alone: NDArray[np.float32]
    """(E,) pixels with nothing else drawn; equals `unhindered` for scenery, which is not measured alone."""
    cut: NDArray[np.bool_]
    """(E,) whether the object, drawn alone, reaches the border of the picture."""
    margin: NDArray[np.float32]
    """(E,) distance from the object to the nearest border, as a share of the picture's shorter side; 0 where it is cut or
    not seen."""

    @property
    def hidden_share(self) -> NDArray[np.float32]:
        """(E,) share of the object that the robot covers; NaN where the object is not visible even without
        the robot."""
        return _share_lost(self.pixels, self.unhindered)

    @property
    def covered_share(self) -> NDArray[np.float32]:
        """(E,) share of the object that things other than the robot cover; NaN where the object is outside of
        the picture."""
        return _share_lost(self.unhindered, self.alone)

    def marks(self) -> NDArray[np.float32]:
        """(E,) mark from 0 (not seen) to 1 (whole, uncovered, large enough); NaN where the object is absent.

        Product of three factors: the share of the object that nothing covers; 1/2 if the border cuts the
        object, else 1; the square root of the object's pixels divided by `LARGE_ENOUGH_PIXELS`, at most 1.
        The root is a ratio of lengths: a small object at twice the distance gets half the mark.
        """
        size = np.sqrt(np.clip(self.alone / LARGE_ENOUGH_PIXELS, 0, 1))
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
    """Depth of everything that the camera sees, including the robot."""

    counts: NDArray[np.int64]
    """(E, 40) number of pixels of the measured picture in each bin of `DEPTH_EDGES_METRES`, without
    background."""
    background: NDArray[np.float32]
    """(E,) share of the picture where a ray meets nothing (depth 0)."""
    beyond: NDArray[np.float32]
    """(E,) share of the picture that is farther away than robot and objects: far floor and walls."""
    nearest: NDArray[np.float32]
    """(E,) smallest depth in metres; NaN where the picture is all background."""
    farthest_object: NDArray[np.float32]
    """(E,) largest depth of robot and objects in metres, without scenery; NaN where neither robot nor objects
    are seen."""

    @property
    def suggested_near(self) -> float | None:
        """Metres: half of the nearest depth seen, rounded down. None if nothing was seen."""
        nearest = _least(self.nearest)
        return None if nearest is None else _rounded(nearest / 2, up=False)

    @property
    def suggested_far(self) -> float | None:
        """Metres: 1.5 times the depth of the farthest object seen, rounded up; farther things become
        background. None if no object was seen."""
        farthest = _least(-self.farthest_object)
        return None if farthest is None else _rounded(-farthest * 1.5, up=True)


@dataclass(frozen=True, eq=False)
class CameraReport:
    """What one camera, or a placement that does not exist yet, sees in E envs. Compared by identity."""

    camera: CameraKey
    size: tuple[int, int]
    """Width and height of the camera's own picture."""
    measured_size: tuple[int, int]
    """Width and height of the measured pictures. If these are smaller than the camera's own, objects smaller
    than one measured pixel are missed."""
    envs: tuple[int, ...]
    """(E,) indices of the envs. An env may occur several times: at several moments, or with several seeds."""
    objects: tuple[ObjectSeen, ...]
    depth: DepthReport
    pictures: int
    """Number of rendered pictures."""
    milliseconds: float

    def env_marks(self, wanted: Collection[str] | None = None) -> NDArray[np.float32]:
        """(E,) mark of the worst object in each env (see `ObjectSeen.marks`); NaN where the env has none.

        Args:
            wanted: names of the objects that must be seen; None for all drawn objects except scenery.

        Raises:
            ValueError: there is no such object.
        """
        marks = [thing.marks() for thing in self.wanted_objects(wanted)]
        if not marks:
            return np.full(len(self.envs), np.nan, np.float32)
        worst = np.min(np.nan_to_num(marks, nan=np.inf), axis=0)
        return np.where(np.isinf(worst), np.nan, worst).astype(np.float32)

    def worst_first(self, wanted: Collection[str] | None = None) -> tuple[int, ...]:
        """Positions in `envs`, worst mark first; equal marks in the order of `envs`, NaN last."""
        return tuple(
            int(i) for i in np.argsort(np.nan_to_num(self.env_marks(wanted), nan=2.0), kind="stable")
        )

    def wanted_objects(self, wanted: Collection[str] | None = None) -> tuple[ObjectSeen, ...]:
        """The objects of these names; None for all drawn objects except scenery.

        Raises:
            ValueError: there is no such object.
        """
        if wanted is None:
            return tuple(thing for thing in self.objects if not (thing.never_drawn or thing.scenery))
        unknown = sorted(set(wanted) - {thing.name for thing in self.objects})
        if unknown:
            there = ", ".join(thing.name for thing in self.objects) or "none"
            raise ValueError(f"there is no object {', '.join(unknown)}; there are: {there}")
        return tuple(thing for thing in self.objects if thing.name in wanted)


@dataclass(frozen=True)
class SearchSpace:
    """Objects, box and lens of a search for placements."""

    objects: tuple[str, ...]
    """Names of actors, articulations and single links (``cabinet/handle``) that must be seen."""
    low: tuple[float, float, float]
    """Lower corner of the box for the eye, in metres, in the frame of the mount, or in the env's frame if
    there is no mount."""
    high: tuple[float, float, float]
    """Upper corner of the box."""
    lens: CameraSettings
    """Settings of the camera. The pose is used only for a mounted camera: its orientation decides which way
    is up in the picture."""
    kind: CameraKind = "sensor"
    candidates: int = 100
    """Number of random placements in the first round."""
    best: int = 5
    """Maximum number of placements that are offered."""
    apart: float | None = None
    """Minimum distance in metres between the eyes of two offered placements; None for a seventh of the box's
    diagonal."""
    seed: int = 0
    mount: str | None = None
    """Name of the body that the camera is mounted on."""

    def check(self) -> None:
        """Raise ValueError if the space cannot be searched."""
        box = np.array([self.low, self.high], np.float64)
        if not np.isfinite(box).all() or (box[0] > box[1]).any():
            raise ValueError(
                f"the search box's lower corner {self.low} must be finite and not above its upper corner "
                f"{self.high}"
            )
        if not self.objects:
            raise ValueError("name at least one object that must be seen")
        if self.candidates < 1 or self.best < 1:
            raise ValueError(f"candidates and best must be at least 1, not {self.candidates} and {self.best}")
        intrinsic_of(self.lens)


@dataclass(frozen=True)
class OfferedPlacement:
    """One of the best placements of a search."""

    settings: CameraSettings
    """Their pose is in the frame of the camera's mount, or in the env's frame if the camera has no mount."""
    target: tuple[float, float, float]
    """A point on the placement's line of sight: the target of a `LookAt`."""
    score: float
    """0..1, higher is better; see `camera_search.score_of`."""
    words: str
    """What the camera sees, in a sentence."""
    report: CameraReport
    picture: Picture
    """Picture from the placement, in its worst env."""


_Part = TypeVar("_Part", ObjectSeen, DepthReport)


def join_reports(reports: Sequence[CameraReport]) -> CameraReport:
    """Join reports of one camera (over steps of an episode, or over several seeds) into one report over all
    their envs.

    Raises:
        ValueError: there is no report, or the reports differ in camera, picture size or scene.
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
    """The first part, with each array replaced by the concatenated arrays of all parts."""
    first = parts[0]
    arrays = [f.name for f in fields(first) if isinstance(getattr(first, f.name), np.ndarray)]
    return replace(
        first, **{name: np.concatenate([getattr(part, name) for part in parts]) for name in arrays}
    )


def size_text(pixels: float, size: tuple[int, int]) -> str:
    """Share of a picture of this `size` (width, height) that `pixels` cover, to two digits: ``0.13 %``."""
    share = 100 * pixels / (size[0] * size[1])
    if 0 < share < 0.01:
        return "< 0.01 %"
    return f"{share:.0f} %" if share >= 10 else f"{share:.2g} %"


def report_text(report: CameraReport, objects: tuple[str, ...]) -> str:
    """Text about these objects: ``cube: in 8 of 8 envs, about 210 pixels``."""
    texts = []
    for thing in report.wanted_objects(objects):
        all_envs = thing.summary()
        if not all_envs.present:
            continue
        seen = round(all_envs.seen * all_envs.present)
        size = f"{all_envs.median_pixels:.0f} pixels ({size_text(all_envs.median_pixels, report.size)})"
        words = f"{thing.name}: in {seen} of {all_envs.present} envs, about {size}"
        if all_envs.cut > 0:
            words += f", cut by the border in {all_envs.cut:.0%}"
        if all_envs.hidden > 0.005:
            words += f", {all_envs.hidden:.0%} behind the robot"
        texts.append(words)
    return "; ".join(texts)


def _share_lost(left: NDArray[np.float32], whole: NDArray[np.float32]) -> NDArray[np.float32]:
    with np.errstate(divide="ignore", invalid="ignore"):
        share = 1 - left / whole
    return np.where(whole > 0, np.clip(share, 0, 1), np.nan).astype(np.float32)


def _least(values: NDArray[np.float32]) -> float | None:
    known = values[np.isfinite(values)]
    return float(known.min()) if len(known) else None


def _rounded(value: float, up: bool) -> float:
    """Round up or down to two significant digits."""
    step = 10.0 ** (np.floor(np.log10(value)) - 1)
    digits = (np.ceil if up else np.floor)(np.round(value / step, 6))
    return float(np.round(digits * step, 9))
