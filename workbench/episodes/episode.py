"""One episode of one env as columns."""

from __future__ import annotations

import datetime
import uuid
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from workbench.envs.camera_data import CameraInfo, MovedCamera, PictureDegree
from workbench.envs.scene.shapes import BodyKind, SceneGeometry
from workbench.envs.step_result import OtherEntry
from workbench.envs.task_drawings import Drawing
from workbench.episodes.columns import TextTrack, entry_at
from workbench.episodes.drawings import DrawingTrack
from workbench.episodes.encoded_pictures import EncodedPictures, Modality
from workbench.episodes.row import UnreadableRecording

# --- limits of a recording, which the .json and the reader's answers must meet, since both are untrusted ------------

Name = Annotated[str, Meta(max_length=1000)]
PathText = Annotated[str, Meta(max_length=4096)]
SmallInt = Annotated[int, Meta(ge=-(2**63), le=2**63 - 1)]
Seconds = Annotated[float, Meta(ge=1e-4, le=1e3)]
"""Duration of a control step. The frame rate of a film is its inverse: 0.001 to 10,000 per second."""
MAX_ENTRIES = 10_000
"""Maximum length of every list in a recording: entries of ``evaluate()``, files, actions."""
MAX_BODIES = 20_000
"""Maximum number of bodies of a scene; a reader needs some seconds to read that many."""
MAX_DEPTH = 32
"""Maximum nesting of keyword arguments and options."""
Entries = Meta(max_length=MAX_ENTRIES)
ActedBy = Annotated[tuple[tuple[SmallInt, PathText], ...], Entries]


def is_shallow(value: object) -> bool:
    """Whether lists and dicts in `value` are nested at most `MAX_DEPTH` deep: Python's ``repr`` fails at a
    few hundred levels."""
    level = [value]
    for _ in range(MAX_DEPTH):
        inside = (
            one.values() if isinstance(one, dict) else one for one in level if isinstance(one, (dict, list))
        )
        level = [value for values in inside for value in values if isinstance(value, (dict, list))]
    return not level


def _now() -> str:
    return datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="seconds")


NO_SEED = -1
"""Seed of an episode that began without one."""


@dataclass(frozen=True)
class Seal:
    """The seal that a recording claims; `made_here` checks it."""

    content: str
    place: str
    main: Any
    """Recorded name of the task's file."""
    files: Any
    """Recorded checksums of the other files."""


@dataclass(frozen=True)
class EpisodeInfo:
    """Identity of an episode, and what is needed to repeat it."""

    task: Name
    env_index: SmallInt
    seed: SmallInt
    """Episode seed; `NO_SEED` if there was none or it is unknown."""
    source_file: PathText | None
    """The task's file. When read from a recording: its path if the file exists, else its name alone."""
    source_hash: Name
    source: Annotated[dict[PathText, str], Entries]
    """Text of the task's Python files by path; when read from a recording, relative to `source_file`'s folder."""
    control_dt: Seconds
    """Seconds of simulated time per step."""
    control_mode: PathText | None
    backend: Name
    versions: Annotated[dict[Name, Name], Entries] = field(default_factory=dict)
    """Version by package name."""
    env_kwargs: Annotated[dict[Name, Any], Entries] = field(default_factory=dict)
    """Keyword arguments of ``gym.make`` for this env (``robot_uids``, ``obs_mode``, ``control_mode`` ...), as JSON values."""
    reset_options: Annotated[dict[Name, Any], Entries] = field(default_factory=dict)
    """``options`` of the reset that began the episode."""
    max_episode_steps: SmallInt | None = None
    written_at: Name = field(default_factory=_now)
    """When it was recorded, ISO 8601 in UTC."""
    id: Name = field(default_factory=lambda: uuid.uuid4().hex)
    """Globally unique, independent of file names."""
    recovered: bool = False
    """Whether the recording ends early, because its writer was killed."""
    side_files: Annotated[dict[PathText, Name], Entries] = field(default_factory=dict)
    """Hashes of other files that the task reads and the recording lacks, by path relative to `source_file`'s
    folder."""
    acted_by: ActedBy = ()
    """Sources of the actions: (index of the first action, name such as ``random`` or ``policy act.py:act``). Empty if
    unknown."""
    pictures: PictureDegree = "exact"
    """Quality of the camera pictures; exact if the recording does not name one."""
    moved_cameras: tuple[MovedCamera, ...] = ()
    """Cameras that were not where `source` places them, in order of time."""
    observed_by: Name = ""
    """`source_hash` of the version that made the observations and pictures, if that version is later than the
    one in `source`."""
    seal: Seal | None = field(default=None, compare=False)
    """Set when read from a recording."""

    @property
    def has_reward(self) -> bool:
        """False for a task without a reward, for which ManiSkill returns 0."""
        return self.env_kwargs.get("reward_mode") != "none"


@dataclass
class CameraTrack:
    """P pictures of one camera, normally one per state (P = T + 1)."""

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
        """The recorded pictures by modality."""
        tracks: dict[Modality, EncodedPictures | None] = {
            "rgb": self.rgb,
            "depth": self.depth,
            "segmentation": self.segmentation,
        }
        return {modality: pictures for modality, pictures in tracks.items() if pictures is not None}


def file_part(name: str) -> str:
    """`name` of a camera, with only characters that are safe in a file's name."""
    return "".join(c if c.isalnum() or c in " ._-" else "_" for c in name)[:100]


def camera_names(cameras: Sequence[CameraInfo]) -> list[str]:
    """A unique name for each camera: its own, with ``_human`` appended when a sensor has the same name."""
    names = [""] * len(cameras)
    for index in sorted(range(len(cameras)), key=lambda index: cameras[index].kind != "sensor"):
        name = cameras[index].name or "unnamed"
        while name in names:
            name += f"_{cameras[index].kind}"
        names[index] = name
    return names


@dataclass(frozen=True)
class BrokenFile:
    """A broken file of a recording."""

    file: str
    """Name of the file."""
    what: str
    """The problem and what is missing; follows the name in a sentence."""

    @property
    def sentence(self) -> str:
        return f"{self.file} {self.what}"


@dataclass
class Episode:
    """T actions and T + 1 states of one env. State 0 is the reset; action t leads to state t + 1.

    Stored as whole columns, since every format and every reader uses them; rerun writes a column forty times
    faster in one call than in one call per step (measured). Only pictures are not plain arrays: an hour of
    pictures from four cameras does not fit into memory.
    """

    info: EpisodeInfo
    geometry: SceneGeometry | None
    """When read from a recording, the geometry of this env alone, as env 0 of 1; None if the recording holds no scene."""
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
    """(T + 1, ...) each entry of ``evaluate()`` that has a row per env, with ``success`` and ``fail`` if the task has
    them, and the terms of the reward under ``reward_terms/``. NaN where a state lacks an entry."""
    cameras: list[CameraTrack]
    env_states: dict[str, NDArray] = field(default_factory=dict)
    """``actors/cube``, ``articulations/panda``, each (T + 1, D) as ManiSkill's ``get_state_dict`` lays it out."""
    obs: dict[str, NDArray] = field(default_factory=dict)
    """State observations without pictures, (T + 1, ...) each; nested keys are joined by ``/``; an observation
    that is not a dict has the key ``""``."""
    batch: dict[str, NDArray] = field(default_factory=dict)
    """(T + 1, ...) numbers that ``evaluate()`` returned for the whole batch."""
    texts: dict[str, TextTrack] = field(default_factory=dict)
    """Entries of ``evaluate()`` that are not numbers."""
    drawn: tuple[DrawingTrack, ...] = ()
    """What the task drew with `workbench.draw`."""
    broken_files: tuple[BrokenFile, ...] = ()
    """Set when read from a recording."""

    @property
    def length(self) -> int:
        """T, the number of control steps."""
        return len(self.reward)

    def flag(self, name: str) -> NDArray[np.bool_] | None:
        """(T + 1,) an entry of ``evaluate()`` with one value per state, False where it is NaN; None if there
        is no such entry."""
        values = self.evaluate.get(name)
        if values is None or values.ndim != 1:
            return None
        return values.copy() if values.dtype == np.bool_ else np.nan_to_num(values.astype(np.float64)) != 0

    @property
    def flags(self) -> dict[str, NDArray[np.bool_]]:
        """(T + 1,) ``success`` and ``fail``, if the task has them."""
        found = {name: self.flag(name) for name in ("success", "fail")}
        return {name: flag for name, flag in found.items() if flag is not None}

    @property
    def solved_at(self) -> int | None:
        """Control steps until the first state with success (0 for the state after the reset); None if there is none."""
        success = self.flag("success")
        return None if success is None or not success.any() else int(np.argmax(success))

    @property
    def means(self) -> dict[str, float]:
        """Mean of each entry of ``evaluate()`` with one number per state, except ``success`` and ``fail``,
        over the states after the reset that have the entry."""
        found: dict[str, float] = {}
        for name, values in self.evaluate.items():
            if values.ndim == 1 and name not in ("success", "fail"):
                known = values[1:].astype(np.float64)
                known = known[~np.isnan(known)]
                if len(known):
                    found[name] = float(known.mean())
        return found

    def other_entries_at(self, state: int) -> dict[str, OtherEntry]:
        """Entries of ``evaluate()`` in this state that are not in `evaluate`."""
        found: dict[str, OtherEntry] = {}
        for name, values in self.batch.items():
            value = np.asarray(values[state])
            found[name] = OtherEntry(f"{value.dtype} of shape {value.shape}", numbers=value)
        for name, track in self.texts.items():
            entry = entry_at(track, state)
            number = found.get(name)
            # The column has NaN in states where the entry was not a number.
            if entry is not None and (number is None or _is_nan(number.numbers)):
                found[name] = OtherEntry(entry.what, (entry.text,), None, entry.per_env, entry.whole)
        return found

    def drawings_at(self, state: int) -> dict[str, Drawing]:
        """What the task drew, by name, as a batch of one env."""
        return {track.name: drawing for track in self.drawn if (drawing := track.at(state)) is not None}


def read_whole(name: str, read: Callable[[], Episode]) -> Episode:
    """Read an episode for a dataset, which accepts no damaged or missing files.

    Args:
        name: name of the recording, for messages.

    Raises:
        UnreadableRecording: it cannot be read completely; the message names the recording.
    """
    try:
        episode = read()
    except (OSError, UnreadableRecording) as error:
        raise UnreadableRecording(str(error) if name in str(error) else f"{name}: {error}") from error
    if episode.broken_files:
        raise UnreadableRecording(" ".join(broken.sentence for broken in episode.broken_files))
    return episode


def _is_nan(value: NDArray | None) -> bool:
    return value is None or (value.dtype.kind == "f" and bool(np.isnan(value).all()))


def movable_bounds(poses: NDArray, kinds: Sequence[BodyKind]) -> tuple[NDArray, NDArray]:
    """Minimum and maximum corner (3,), in metres, of the positions of movable bodies; the origin if there are none.

    Args:
        poses: (..., B, 7).
        kinds: (B,)
    """
    movable = np.array([kind in ("link", "dynamic") for kind in kinds], np.bool_)
    points = poses[..., movable, :3].reshape(-1, 3)
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        points = np.zeros((1, 3), np.float32)
    return points.min(axis=0), points.max(axis=0)


def parse_acted_by(pairs: Iterable[Iterable[Any]] | None) -> ActedBy:
    """`EpisodeInfo.acted_by` from its JSON value. Raises TypeError or ValueError."""
    return tuple((int(begin), str(what)) for begin, what in pairs or ())


def acted_by_text(acted_by: ActedBy) -> str:
    """Text such as ``random; from step 41 on: sliders``; empty if unknown. Action k leads to step k + 1."""
    return "; ".join(what if begin == 0 else f"from step {begin + 1} on: {what}" for begin, what in acted_by)
