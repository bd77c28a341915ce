"""One episode of one env, as columns: what every file of it is written from, and what reading one gives.

Rerun takes columns forty times faster than calls a step (measured), ManiSkill's own format is columns
too, and a review, a replay and a dataset all ask for whole columns. Only pictures are not plain arrays:
an hour of four cameras is more than a machine holds, so they stay encoded until one is looked at
(`EncodedPictures`).
"""

from __future__ import annotations

import datetime
import uuid
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from workbench.core.camera_data import CameraInfo
from workbench.core.env.step_result import OtherEntry
from workbench.core.scene.shapes import BodyKind, SceneGeometry
from workbench.recording.episode.columns import TextTrack, entry_at
from workbench.recording.episode.encoded_pictures import MODALITIES, EncodedPictures, Modality


def _now() -> str:
    return datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="seconds")


NO_SEED = -1
"""An episode's seed where it has none: it began wherever the random generators stood."""


@dataclass(frozen=True)
class Seal:
    """What a recording that was read says of who made it; only `made_here` knows whether it is true."""

    content: str
    place: str
    main: Any
    """The name of the task's file as it was described."""
    files: Any
    """What the other files hash to."""


@dataclass(frozen=True)
class EpisodeInfo:
    """What is needed to know an episode again, and to make it again."""

    task: str
    env_index: int
    seed: int
    """Episode seed; `NO_SEED` where none was given, or it is not known."""
    source_file: str | None
    """The task's own file. Of a recording that was read: its path where it is still there, else its name alone."""
    source_hash: str
    source: dict[str, str]
    """Path to text of the task's own files; of a recording that was read, paths as seen from `source_file`'s folder."""
    control_dt: float
    """Seconds of simulated time per step."""
    control_mode: str | None
    backend: str
    versions: dict[str, str] = field(default_factory=dict)
    """Package name to version."""
    env_kwargs: dict[str, Any] = field(default_factory=dict)
    """Keywords of ``gym.make`` that make this env (``robot_uids``, ``obs_mode``, ``control_mode`` ...), as JSON can say
    them."""
    reset_options: dict[str, Any] = field(default_factory=dict)
    """``options`` of the reset that began the episode."""
    max_episode_steps: int | None = None
    written_at: str = field(default_factory=_now)
    """When it was recorded, ISO 8601 in UTC."""
    id: str = field(default_factory=lambda: uuid.uuid4().hex)
    """Unique for ever, whatever the files are called."""
    recovered: bool = False
    """Its writer ended in the middle; the episode is cut where that was."""
    side_files: dict[str, str] = field(default_factory=dict)
    """What else the task reads, and the recording does not hold: path as seen from `source_file`'s folder, to hash."""
    acted_by: tuple[tuple[int, str], ...] = ()
    """What chose the actions: number of an action, and what it was from that one on (``random``, ``policy act.py:act``).
    Empty where it is not known."""
    seal: Seal | None = field(default=None, compare=False)
    """Of a recording that was read."""


@dataclass
class CameraTrack:
    """What one camera saw over the episode; P pictures, normally one a state (P = T + 1)."""

    info: CameraInfo
    frame: NDArray[np.int64]
    """(P,) state index 0..T of each picture."""
    pose: NDArray[np.float32]
    """(P, 7) camera pose in the env's frame, ManiSkill convention (x forward, y left, z up), wxyz."""
    rgb: EncodedPictures | None = None
    depth: EncodedPictures | None = None
    segmentation: EncodedPictures | None = None

    @property
    def pictures(self) -> dict[Modality, EncodedPictures]:
        """Those that it has."""
        return {m: held for m in MODALITIES if (held := getattr(self, m)) is not None}


def camera_names(cameras: Sequence[CameraInfo]) -> list[str]:
    """What people know each by: its name, after which ``_human`` follows where a sensor has the same."""
    names = [""] * len(cameras)
    for index in sorted(range(len(cameras)), key=lambda index: cameras[index].kind != "sensor"):
        name = cameras[index].name or "unnamed"
        while name in names:
            name += f"_{cameras[index].kind}"
        names[index] = name
    return names


@dataclass(frozen=True)
class BrokenFile:
    """A file of a recording that is broken."""

    file: str
    """Its name."""
    what: str
    """How it is broken, and what it would have held: goes on from its name to a sentence."""

    @property
    def sentence(self) -> str:
        return f"{self.file} {self.what}"


@dataclass
class Episode:
    """T actions and T + 1 states of one env. State 0 is the reset; action t leads to state t + 1."""

    info: EpisodeInfo
    geometry: SceneGeometry | None
    """Of this env alone (one env, index 0) where it was read from a recording; None where a recording holds no scene."""
    segmentation: dict[int, str]
    poses: NDArray[np.float32] | None
    """(T + 1, B, 7) position and wxyz of every body; NaN rows for bodies this env lacks. None without a scene."""
    action: NDArray[np.float32]
    """(T, A)"""
    action_names: tuple[str, ...]
    reward: NDArray[np.float32]
    """(T,)"""
    terminated: NDArray[np.bool_]
    """(T,)"""
    truncated: NDArray[np.bool_]
    """(T,)"""
    evaluate: dict[str, NDArray]
    """(T + 1, ...) every entry of ``evaluate()`` with a row for each env; ``success`` and ``fail`` are among them if the task has them, and the
    terms of the reward under ``reward_terms/`` if it names any. NaN where a state lacks an entry."""
    cameras: list[CameraTrack]
    env_states: dict[str, NDArray] = field(default_factory=dict)
    """``actors/cube``, ``articulations/panda``, each (T + 1, D) as ManiSkill's ``get_state_dict`` lays it out."""
    obs: dict[str, NDArray] = field(default_factory=dict)
    """State observations flattened by ``/``, each (T + 1, ...); no pictures. The key of one that was no dict is ``""``."""
    batch: dict[str, NDArray] = field(default_factory=dict)
    """(T + 1, ...) the numbers that ``evaluate()`` returned of the whole batch."""
    texts: dict[str, TextTrack] = field(default_factory=dict)
    """Its entries that are no numbers."""
    broken_files: tuple[BrokenFile, ...] = ()
    """Of a recording that was read: its files that are broken."""

    @property
    def length(self) -> int:
        """T, the number of control steps."""
        return len(self.reward)

    def flag(self, name: str) -> NDArray[np.bool_] | None:
        """(T + 1,) of an entry of ``evaluate()`` that is one truth a state, NaN where it lacks it; None where it is another,
        or not there."""
        values = self.evaluate.get(name)
        return None if values is None or values.ndim != 1 else np.nan_to_num(values.astype(np.float64)) != 0

    @property
    def flags(self) -> dict[str, NDArray[np.bool_]]:
        """(T + 1,) ``success`` and ``fail``, those that the task has."""
        found = {name: self.flag(name) for name in ("success", "fail")}
        return {name: flag for name, flag in found.items() if flag is not None}

    def others_at(self, state: int) -> dict[str, OtherEntry]:
        """What ``evaluate()`` returned in this state besides `evaluate`."""
        found: dict[str, OtherEntry] = {}
        for name, values in self.batch.items():
            value = np.asarray(values[state])
            found[name] = OtherEntry(f"{value.dtype} of shape {value.shape}", numbers=value)
        for name, track in self.texts.items():
            entry = entry_at(track, state)
            number = found.get(name)
            # A state in which it was no number is NaN in the column.
            if entry is not None and (number is None or _is_nan(number.numbers)):
                found[name] = OtherEntry(entry.what, (entry.text,), None, entry.per_env, entry.whole)
        return found


def _is_nan(value: NDArray | None) -> bool:
    return value is None or (value.dtype.kind == "f" and bool(np.isnan(value).all()))


def box_of_moving(poses: NDArray, kinds: Sequence[BodyKind]) -> tuple[NDArray, NDArray]:
    """Lowest and highest corner (3,), in metres, of where the bodies (..., B, 7) are that can move; the origin where none can."""
    points = poses[..., np.isin(np.array(kinds), ("link", "dynamic")), :3].reshape(-1, 3)
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        points = np.zeros((1, 3), np.float32)
    return points.min(axis=0), points.max(axis=0)


ActedBy = tuple[tuple[int, str], ...]


def parse_acted_by(pairs: Iterable[Iterable[Any]] | None) -> ActedBy:
    """`EpisodeInfo.acted_by` of what JSON keeps of it. Raises TypeError or ValueError."""
    return tuple((int(begin), str(what)) for begin, what in pairs or ())


def acted_by_text(acted_by: ActedBy) -> str:
    """``random; from step 41 on: sliders``; empty where it is not known. Action k leads to step k + 1."""
    return "; ".join(what if begin == 0 else f"from step {begin + 1} on: {what}" for begin, what in acted_by)
