"""The ``.json`` of a recording: ManiSkill's words for an episode, and ours under the key ``workbench``.

A library of thousands of episodes lists them by this alone, and whoever reads one back learns from `Description` what neither of the
other two files keeps: the types of the entries of ``evaluate()``, the names and kinds of bodies, the lenses of cameras. The ``.rrd``
holds it as well. Anybody may have written such a file: it is read up to a size, and each field is of its type or named by its path.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, TypeVar

import msgspec
import numpy as np
import xxhash
from msgspec import UNSET, Meta, Struct, UnsetType

from workbench.core.camera_data import CameraInfo, CameraKind
from workbench.core.scene.shapes import BodyKind
from workbench.machine.files import (
    MOST_SOURCE_BYTES,
    FileTooLarge,
    NotARegularFile,
    open_regular_file,
    read_regular_file,
    replace_file,
)
from workbench.recording.episode.columns import TextTrack
from workbench.recording.episode.episode import NO_SEED, ActedBy, EpisodeInfo, Seal
from workbench.recording.episode.row import clean_note, clean_tags

FORMAT = 1
MOST_BYTES = 64 << 20
"""ManiSkill's ``.json`` of 100,000 episodes has 40 MB."""
_BLOCK = 1 << 20
MOST_PARTS = 40
"""Folders in the place of a task that are looked for: the place is what a recording says."""

T = TypeVar("T")
Whole = Annotated[int, Meta(ge=-(2**63), le=2**63 - 1)]
Vector = tuple[float, float, float]
ColumnType = tuple[str, tuple[int, ...]]
"""numpy's type, and the shape of one row."""


class WrongDocument(ValueError):
    """No JSON that can be read, or a field is missing or of another type; the message goes on from the file's name."""


class CameraJson(Struct, frozen=True):
    """A camera's lens; where its config stands in the source is of no use to another day."""

    name: str
    kind: CameraKind
    width: int
    height: int
    fovy: float
    near: float
    far: float
    intrinsic: tuple[Vector, Vector, Vector]
    mount: str | None
    modalities: tuple[str, ...]

    @classmethod
    def of(cls, camera: CameraInfo) -> CameraJson:
        rows = np.asarray(camera.intrinsic, dtype=np.float64).tolist()
        numbers = float(camera.fovy), float(camera.near), float(camera.far)
        size = camera.width, camera.height
        return cls(camera.name, camera.kind, *size, *numbers, rows, camera.mount, camera.modalities)

    def info(self) -> CameraInfo:
        intrinsic = np.array(self.intrinsic, dtype=np.float32)
        size, numbers = (self.width, self.height), (self.fovy, self.near, self.far)
        return CameraInfo(self.name, self.kind, *size, *numbers, intrinsic, self.mount, self.modalities)


class SceneJson(Struct, frozen=True):
    """Every body of the scene."""

    body_names: tuple[str, ...]
    body_kinds: tuple[BodyKind, ...]
    body_hidden: tuple[bool, ...]


class Checksum(Struct, frozen=True):
    """Of a file, as it was written."""

    size: int = msgspec.field(name="bytes")
    xxh3_128: str | None = None


class SealJson(Struct, frozen=True):
    """Of the installation that recorded it (`made_here`)."""

    content: str
    place: str


class Description(Struct, frozen=True, kw_only=True):
    """What a recording says of itself. What has a default may lack."""

    format: int = FORMAT
    # Up to `source_hash` as in `EpisodeInfo`.
    id: str
    task: str
    env_index: Whole
    seed: Whole | None
    """None where it is not known."""
    control_dt: float
    control_mode: str | None
    backend: str
    versions: dict[str, str]
    env_kwargs: dict[str, Any]
    reset_options: dict[str, Any]
    max_episode_steps: int | None
    written_at: str
    recovered: bool
    source_hash: str
    source_file: str | None
    """The name of the task's file."""
    source: dict[str, str] | None
    """Path as seen from the task's file, to text. None in the ``.rrd``, which holds the texts besides."""
    side_files: dict[str, str] = {}
    """What else the task reads and is not held here: path as seen from the task's file, to hash."""
    acted_by: ActedBy = ()
    length: Whole
    total_reward: float = msgspec.field(name="return")
    success: bool | None
    """Of the last state; None where the task has no such entry. The same of the other three."""
    success_once: bool | None
    fail: bool | None
    fail_once: bool | None
    action_names: tuple[str, ...]
    cameras: list[CameraJson]
    segmentation: dict[int, str]
    scene: SceneJson
    evaluate: dict[str, ColumnType]
    batch: dict[str, ColumnType] = {}
    """Numbers that ``evaluate()`` returned without a row for each env."""
    texts: dict[str, TextTrack] = {}
    """Entries of ``evaluate()`` that are no numbers."""
    obs: dict[str, ColumnType]
    # In the .json alone:
    files: dict[str, Checksum] | UnsetType = UNSET
    """By suffix, the other two files."""
    source_path: str | None | UnsetType = UNSET
    """Where the task's file lies as seen from the recording's folder."""
    thumbnail: str | None | UnsetType = UNSET
    """Base64 of a JPEG; None without cameras."""
    made_here: SealJson | None | UnsetType = UNSET
    """None where the installation could make no seal."""
    tags: list[str] | UnsetType = UNSET
    note: str | UnsetType = UNSET

    def info(self, folder: Path | None = None) -> EpisodeInfo:
        """Of a recording in `folder`; without it the task's own file is not looked for."""
        found = None if folder is None else task_file(self.source_path or None, self.task, folder)
        made = self.made_here or None
        files = as_json(self.files or {})
        return EpisodeInfo(
            **{name: getattr(self, name) for name in SHARED},
            seed=NO_SEED if self.seed is None else self.seed,
            source_file=found or self.source_file,
            source=self.source or {},
            seal=None if made is None else Seal(made.content, made.place, self.source_file, files),
        )


SHARED = (
    "id", "task", "env_index", "control_dt", "control_mode", "backend", "versions", "env_kwargs", "reset_options",
    "max_episode_steps", "written_at", "recovered", "source_hash", "side_files", "acted_by",
)  # fmt: skip
"""What `EpisodeInfo` and `Description` say alike."""


class ResetJson(Struct, frozen=True):
    """How ManiSkill says that an episode was begun."""

    seed: Whole | list[Whole] | None = None
    options: dict[str, Any] | None = None


class EpisodeJson(Struct, frozen=True):
    """An episode in ManiSkill's words; an env of several says a list of one where others say a number."""

    episode_id: int
    episode_seed: Whole | list[Whole] | None = None
    control_mode: str | dict[str, Any] | None = None
    elapsed_steps: Whole | list[Whole] | None = None
    reset_kwargs: ResetJson | None = None
    success: bool | list[bool] | None = None
    fail: bool | list[bool] | None = None

    @property
    def seed(self) -> int | None:
        seed = self.episode_seed
        if seed is None and self.reset_kwargs is not None:
            seed = self.reset_kwargs.seed
        return seed if not isinstance(seed, list) else seed[0] if seed else None


class EnvJson(Struct, frozen=True):
    """How ManiSkill makes the env again."""

    env_id: str | None = None
    env_kwargs: dict[str, Any] | None = None
    max_episode_steps: int | None = None


@dataclass(frozen=True)
class Document:
    """A ``.json`` that may be a recording's. Its parts are checked when they are asked for."""

    data: Mapping[str, Any]

    @property
    def is_ours(self) -> bool:
        return isinstance(self.data.get("workbench"), dict)

    @property
    def is_maniskill(self) -> bool:
        return isinstance(self.data.get("episodes"), list)

    def description(self) -> Description:
        """Of a recording of ours. Raises WrongDocument."""
        return _typed(self.data.get("workbench"), Description, "workbench")

    def env(self) -> EnvJson:
        """Raises WrongDocument."""
        return _typed(self.data.get("env_info") or {}, EnvJson, "env_info")

    def episode(self, number: int) -> EpisodeJson:
        """Of a file of ManiSkill's. Raises WrongDocument."""
        return _typed(self.data["episodes"][number], EpisodeJson, f"episodes[{number}]")

    @property
    def source_type(self) -> str:
        """What chose ManiSkill's actions; empty where it is not said."""
        source = self.data.get("source_type")
        return " ".join(source.split())[:80] if isinstance(source, str) else ""


def read_document(path: Path) -> Document:
    """Raises OSError, WrongDocument."""
    data = read_json(path)
    return Document(data if isinstance(data, dict) else {})


def description_in(text: str, source: Mapping[str, str]) -> Description:
    """The description in an ``.rrd``, and the texts that lie beside it there. Raises WrongDocument."""
    data = parse_json(text)
    return _typed({**data, "source": dict(source)} if isinstance(data, dict) else data, Description, "")


def read_json(path: Path, most_bytes: int = MOST_BYTES) -> Any:
    """What a ``.json`` holds.

    Raises:
        OSError: it cannot be read.
        WrongDocument: it is no JSON, no regular file, or much too long.
    """
    try:
        content = read_regular_file(path, most_bytes)
    except FileTooLarge as error:
        raise WrongDocument(f"is longer than {most_bytes >> 20} MB") from error
    except NotARegularFile as error:
        raise WrongDocument(str(error.strerror)) from error
    return parse_json(content)


def parse_json(content: bytes | str) -> Any:
    """Raises WrongDocument."""
    try:
        # Not msgspec's own, which refuses the NaN that a sum of rewards may be.
        return json.loads(content)
    except (ValueError, RecursionError) as error:
        raise WrongDocument("is not JSON, or was cut short") from error


def json_text(value: object, indent: int | None = None) -> str:
    """`value`, which may hold words, as JSON."""
    return json.dumps(value, indent=indent, default=_plain)


def as_json(value: object) -> Any:
    """`value` as JSON reads it back."""
    return json.loads(json_text(value))


def fields_of(words: Struct) -> dict[str, Any]:
    """Those that are said, by the names that they have in the file."""
    held = ((field.encode_name, getattr(words, field.name)) for field in msgspec.structs.fields(words))
    return {name: value for name, value in held if value is not UNSET}


def _plain(value: object) -> Any:
    if not isinstance(value, Struct):
        return str(value)
    return msgspec.structs.astuple(value) if value.__struct_config__.array_like else fields_of(value)


def _typed(data: object, kind: type[T], place: str) -> T:
    try:
        return msgspec.convert(data, kind, str_keys=True)
    except (msgspec.ValidationError, OverflowError) as error:
        what, _, within = str(error).partition(" - at `$")
        at = f"${'.' if place else ''}{place}{within.rstrip('`')}"
        raise WrongDocument(
            f"is not as a recording is described: {what[0].lower()}{what[1:]} at {at}"
        ) from error


def task_file(source_path: str | None, task: str, folder: Path) -> str | None:
    """The task's own file, where `source_path` leads to from the recording's `folder`; None where it is not found.

    A recording that was copied elsewhere has not taken its task along, and is mostly looked at from where that lies: so the end
    of the path is looked for below the present folder and those above the recording as well. There the file has to name the task.
    """
    if not source_path:
        return None
    if (there := folder / source_path).is_file():
        return os.fspath(there.resolve())
    parts = [part for part in Path(source_path).parts if part not in ("..", os.sep)]
    if not source_path.endswith(".py") or len(parts) > MOST_PARTS:
        return None
    for place in (Path.cwd(), *folder.resolve().parents):
        for begin in range(len(parts)):
            candidate = place.joinpath(*parts[begin:])
            try:
                if task.encode(errors="surrogatepass") in read_regular_file(candidate, MOST_SOURCE_BYTES):
                    return os.fspath(candidate.resolve())
            except OSError:
                continue
    return None


# --- whether a file of a recording is as it was written ---------------------------------------------
#
# Neither format notices a changed byte: HDF5 has a checksum for chunks alone, which most columns of an episode are too small
# to be, and costs whoever reads; rerun takes what a chunk's bytes say. An episode judged again from such a file is wrong without
# a word. So the `.json` says how long each of the other two is and what it hashes to: both are in the system's memory when they
# have just been written, where reading and hashing them takes a hundredth of what writing them took, and no program that reads
# the files alone is concerned.
#
# It tells damage, not forgery: who changes a file can change the `.json` too. And whoever changed one on purpose
# (`rerun rrd optimize`) takes its entry out of `workbench.files` in the `.json`, and is believed.


def checksum(path: Path) -> Checksum:
    """Of the file at `path`. Raises OSError."""
    hashed = xxhash.xxh3_128()
    size = 0
    with open_regular_file(path) as file:
        while block := file.read(_BLOCK):
            hashed.update(block)
            size += len(block)
    return Checksum(size, hashed.hexdigest())


def check(path: Path, checksums: Mapping[str, Checksum]) -> None:
    """Compare the file at `path` with what its ``.json`` says of files of its suffix, if it says anything.

    Raises:
        OSError: it is another, and how; or it cannot be read.
    """
    if (why := wrong_size(checksums, path.suffix, path.stat().st_size)) is not None:
        raise OSError(why)
    written = checksums.get(path.suffix)
    if written is not None and written.xxh3_128 is not None and checksum(path) != written:
        raise OSError("its checksum is not the one that was written down with it")


def wrong_size(checksums: Mapping[str, Checksum], suffix: str, size: int) -> str | None:
    """What is wrong with a file that is `size` bytes long; None for nothing."""
    if suffix not in checksums or checksums[suffix].size == size:
        return None
    return f"it has {size} bytes, and had {checksums[suffix].size}"


# --- tags and notes ----------------------------------------------------------------------------


MOST_NOTES_BYTES = 16 << 20
"""Of a ``.notes``, and of the ``.json`` of a recording of ours, which holds its task's source and one small picture."""
_NOTES = "workbench_notes"


def read_notes(path: Path) -> dict[str, tuple[tuple[str, ...], str]]:
    """Tags and note of each trajectory ("" where the file has no trajectories) in a ``.notes``; what is not
    one holds none."""
    try:
        return _notes(path)
    except (OSError, ValueError):
        return {}


def write_notes(path: Path, trajectory: str | None, tags: tuple[str, ...], note: str) -> None:
    """Put tags and note of one trajectory into a ``.notes``; without any left, the file goes.

    Raises:
        OSError: the file cannot be read, or the folder not written to.
        ValueError: there is something else in the file, which is not written over. The message is a sentence's end.
    """
    try:
        entries = _notes(path)
    except FileNotFoundError:
        entries = {}
    entries.pop(trajectory or "", None)
    if tags or note:
        entries[trajectory or ""] = (tags, note)
    if not entries:
        path.unlink(missing_ok=True)
        return
    plain = {name: {"tags": list(tags), "note": note} for name, (tags, note) in sorted(entries.items())}
    replace_file(path, json.dumps({_NOTES: plain}, indent=2, ensure_ascii=False).encode())


def _notes(path: Path) -> dict[str, tuple[tuple[str, ...], str]]:
    """Raises OSError, ValueError."""
    try:
        entries = read_json(path, MOST_NOTES_BYTES)[_NOTES]
        return {
            str(name): (clean_tags(entry.get("tags")), clean_note(entry.get("note")))
            for name, entry in entries.items()
        }
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{path.name} holds no notes that this version can read: move it away") from error


def write_into_description(path: Path, tags: tuple[str, ...], note: str) -> None:
    """Put tags and note into the ``.json`` of a recording of ours.

    Raises:
        OSError: it cannot be read or written.
        ValueError: it is no recording of ours. The message is the end of a sentence.
    """
    described = read_json(path, MOST_NOTES_BYTES)
    if not isinstance(described, dict) or not Document(described).is_ours:
        raise ValueError("is not a recording of the workbench")
    described["workbench"] |= {"tags": list(tags), "note": note}
    # Indented as what was read: these files are looked at.
    with open_regular_file(path) as file:
        indent = 2 if b"\n" in file.read(4) else None
    replace_file(path, json.dumps(described, indent=indent).encode())
