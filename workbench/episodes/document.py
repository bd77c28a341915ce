"""The ``.json`` of a recording: ManiSkill's fields, and the workbench's own under the key ``workbench``. Also
checksums, tags and notes."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, is_dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Any, TypeVar

import msgspec
import numpy as np
import xxhash
from msgspec import UNSET, Meta, Struct, UnsetType

from workbench.envs.camera_data import CameraInfo, CameraKind, MovedCamera, PictureDegree
from workbench.envs.scene.shapes import BodyKind
from workbench.envs.task_drawings import DrawingKind
from workbench.episodes.columns import TextTrack
from workbench.episodes.episode import (
    MAX_BODIES,
    MAX_DEPTH,
    NO_SEED,
    ActedBy,
    Entries,
    EpisodeInfo,
    Name,
    PathText,
    Seal,
    Seconds,
    SmallInt,
    is_shallow,
)
from workbench.episodes.row import clean_note, clean_tags
from workbench.machine.files import (
    MAX_SOURCE_BYTES,
    FileTooLarge,
    NotARegularFile,
    open_regular_file,
    read_regular_file,
    replace_file,
)

FORMAT = 2
"""Version of the format; from 2 on, the ``.json`` ends with a checksum of itself (`with_checksum`)."""
MAX_BYTES = 64 << 20
"""Maximum size of a ``.json``; a ``.json`` of ManiSkill with 100,000 episodes has 40 MB."""
_BLOCK_BYTES = 1 << 20
_ESCAPED_SURROGATE = re.compile(rb"\\u[dD][89a-fA-F]")
MAX_PATH_PARTS = 40
"""Maximum number of parts of a recorded path. The path is untrusted, and a longer path is not searched
for."""

T = TypeVar("T")
Vector = tuple[float, float, float]
ColumnType = tuple[Name, Annotated[tuple[SmallInt, ...], Meta(max_length=32)]]
"""numpy dtype, and shape of one row."""
Columns = Annotated[dict[Name, ColumnType], Entries]


class WrongDocument(ValueError):
    """Unreadable JSON, or a field that is missing or has a wrong type; the message follows the file's name."""


class CameraJson(Struct, frozen=True):
    """A camera's parameters: a `CameraInfo` without `settings`, `varies` and `site`."""

    name: Name
    kind: CameraKind
    width: SmallInt
    height: SmallInt
    fovy: float
    near: float
    far: float
    intrinsic: tuple[Vector, Vector, Vector]
    mount: Name | None
    modalities: Annotated[tuple[Name, ...], Entries]
    replaced_shader: Name = ""
    """Shader pack of the task's config, if another one rendered the pictures; see `CameraInfo.replaced_shader`."""

    @classmethod
    def of(cls, camera: CameraInfo) -> CameraJson:
        rows = np.asarray(camera.intrinsic, dtype=np.float64).tolist()
        numbers = float(camera.fovy), float(camera.near), float(camera.far)
        size = camera.width, camera.height
        of = camera.mount, camera.modalities, camera.replaced_shader
        return cls(camera.name, camera.kind, *size, *numbers, rows, *of)

    def info(self) -> CameraInfo:
        intrinsic = np.array(self.intrinsic, dtype=np.float32)
        size, numbers = (self.width, self.height), (self.fovy, self.near, self.far)
        of = {"mount": self.mount, "modalities": self.modalities, "replaced_shader": self.replaced_shader}
        return CameraInfo(self.name, self.kind, *size, *numbers, intrinsic, **of)


Bodies = Meta(max_length=MAX_BODIES)


class SceneJson(Struct, frozen=True):
    """Every body of the scene."""

    body_names: Annotated[tuple[Name, ...], Bodies]
    body_kinds: Annotated[tuple[BodyKind, ...], Bodies]
    body_hidden: Annotated[tuple[bool, ...], Bodies]


class Checksum(Struct, frozen=True):
    """Size and hash of a file as it was written."""

    size: int = msgspec.field(name="bytes")
    xxh3_128: str | None = None


class SealJson(Struct, frozen=True):
    """Seal of the installation that recorded the episode (`made_here`)."""

    content: str
    place: str


MAX_SEGMENTS = 1_000_000
"""Maximum number of ids of a segmentation."""


class Description(Struct, frozen=True, kw_only=True):
    """Metadata of a recording, in the ``.json`` and in the ``.rrd``; fields with a default may be missing.

    A library lists thousands of episodes from their descriptions alone. A description also holds what the
    ``.rrd`` and ``.h5`` lack: types of the entries of ``evaluate()``, names and kinds of bodies, camera
    parameters.
    """

    format: int = FORMAT
    # Fields up to `source_hash`: as in `EpisodeInfo`.
    id: Name
    task: Name
    env_index: SmallInt
    seed: SmallInt | None
    """None if unknown."""
    control_dt: Seconds
    control_mode: PathText | None
    backend: Name
    versions: Annotated[dict[Name, Name], Entries]
    env_kwargs: Annotated[dict[Name, Any], Entries]
    reset_options: Annotated[dict[Name, Any], Entries]
    max_episode_steps: SmallInt | None
    written_at: Name
    recovered: bool
    source_hash: Name
    source_file: PathText | None
    """The name of the task's file."""
    source: Annotated[dict[PathText, str], Entries] | None
    """Texts of the task's Python files, by path relative to the task's folder. None in the ``.rrd``, which
    holds the texts separately."""
    side_files: Annotated[dict[PathText, Name], Entries] = {}
    """Hashes of other files that the task reads, by path relative to the task's folder. The recording does
    not hold these files."""
    acted_by: ActedBy = ()
    pictures: PictureDegree = "exact"
    moved_cameras: tuple[MovedCamera, ...] = ()
    observed_by: Name = ""
    length: SmallInt
    total_reward: float | None = msgspec.field(name="return")
    """None for a task without a reward."""
    success: bool | None
    """Success in the last state (`success_once`: in any). None if the task has no such entry."""
    success_once: bool | None
    fail: bool | None
    fail_once: bool | None
    action_names: Annotated[tuple[Name, ...], Entries]
    cameras: Annotated[list[CameraJson], Entries]
    segmentation: Annotated[dict[SmallInt, Name], Meta(max_length=MAX_SEGMENTS)]
    scene: SceneJson
    evaluate: Columns
    batch: Columns = {}
    """Numbers that ``evaluate()`` returned without a row for each env."""
    texts: Annotated[dict[Name, TextTrack], Entries] = {}
    """Entries of ``evaluate()`` that are not numbers."""
    obs: Columns
    drawings: Annotated[tuple[tuple[Name, DrawingKind], ...], Entries] | UnsetType = UNSET
    """Name and kind of each drawing; missing if the task draws nothing."""
    # Only in the .json:
    files: dict[str, Checksum] | UnsetType = UNSET
    """Checksums of the other two files, by suffix."""
    source_path: PathText | None | UnsetType = UNSET
    """Path of the task's file relative to the recording's folder."""
    thumbnail: str | None | UnsetType = UNSET
    """Base64 of a JPEG; None if there are no colour pictures."""
    made_here: SealJson | None | UnsetType = UNSET
    """None if no seal could be made."""
    tags: list[str] | UnsetType = UNSET
    note: str | UnsetType = UNSET

    def info(self, folder: Path | None = None) -> EpisodeInfo:
        """The episode's info. Searches for the task's file only if the recording's `folder` is given."""
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
    "pictures", "moved_cameras", "observed_by",
)  # fmt: skip
"""Fields that `EpisodeInfo` and `Description` share."""


class ResetJson(Struct, frozen=True):
    """Arguments of the reset, as ManiSkill records them."""

    seed: SmallInt | list[SmallInt] | None = None
    options: Annotated[dict[Name, Any], Entries] | None = None


class EpisodeJson(Struct, frozen=True):
    """An episode as ManiSkill records it; batched envs write a list with one item instead of a single
    value."""

    episode_id: SmallInt
    episode_seed: SmallInt | list[SmallInt] | None = None
    control_mode: PathText | dict[str, Any] | None = None
    elapsed_steps: SmallInt | list[SmallInt] | None = None
    reset_kwargs: ResetJson | None = None
    success: bool | list[bool] | None = None
    fail: bool | list[bool] | None = None
    workbench_id: Name | None = None
    """Id of the recording that the episode was exported from."""

    @property
    def seed(self) -> int | None:
        seed = self.episode_seed
        if seed is None and self.reset_kwargs is not None:
            seed = self.reset_kwargs.seed
        return seed if not isinstance(seed, list) else seed[0] if seed else None


class EnvJson(Struct, frozen=True):
    """Arguments of ``gym.make``, as ManiSkill records them."""

    env_id: Name | None = None
    env_kwargs: Annotated[dict[Name, Any], Entries] | None = None
    max_episode_steps: SmallInt | None = None


@dataclass(frozen=True)
class Document:
    """A ``.json`` that may belong to a recording. Its parts are checked on access."""

    data: Mapping[str, Any]

    @property
    def is_ours(self) -> bool:
        return isinstance(self.data.get("workbench"), dict)

    @property
    def is_maniskill(self) -> bool:
        return isinstance(self.data.get("episodes"), list)

    def description(self) -> Description:
        """Description of a workbench recording. Raises WrongDocument."""
        return _typed(self.data.get("workbench"), Description, "workbench")

    def env(self) -> EnvJson:
        """ManiSkill's ``env_info``. Raises WrongDocument."""
        return _typed(self.data.get("env_info") or {}, EnvJson, "env_info")

    def episode(self, number: int) -> EpisodeJson:
        """Entry `number` of ManiSkill's list of episodes. Raises WrongDocument."""
        return _typed(self.data["episodes"][number], EpisodeJson, f"episodes[{number}]")

    @property
    def source_type(self) -> str:
        """ManiSkill's name for the source of the actions; empty if missing."""
        source = self.data.get("source_type")
        return " ".join(source.split())[:80] if isinstance(source, str) else ""


def read_document(path: Path) -> Document:
    """Read the ``.json`` of a recording.

    Raises:
        OSError: it cannot be read.
        WrongDocument: for the reasons of `read_json`, or because the file was changed after the workbench
            wrote it.
    """
    content = _read_content(path, MAX_BYTES)
    data = parse_json(content)
    document = Document(data if isinstance(data, dict) else {})
    _require_unchanged(content, document)
    return document


def description_in(text: str, source: Mapping[str, str]) -> Description:
    """The description in an ``.rrd``, with the `source` texts that are stored separately. Raises WrongDocument."""
    data = parse_json(text)
    return _typed({**data, "source": dict(source)} if isinstance(data, dict) else data, Description, "")


def read_json(path: Path, most_bytes: int = MAX_BYTES) -> Any:
    """The content of a ``.json``.

    Raises:
        OSError: it cannot be read.
        WrongDocument: it is not JSON, not a regular file, or longer than `most_bytes`.
    """
    return parse_json(_read_content(path, most_bytes))


def _read_content(path: Path, most_bytes: int) -> bytes:
    """Bytes of the file. Raises as `read_json` does."""
    try:
        return read_regular_file(path, most_bytes)
    except FileTooLarge as error:
        raise WrongDocument(f"is longer than {most_bytes >> 20} MB") from error
    except NotARegularFile as error:
        raise WrongDocument(str(error.strerror)) from error


def parse_json(content: bytes | str) -> Any:
    """The value of a JSON text. Raises WrongDocument."""
    try:
        # msgspec's parser refuses NaN, which a sum of rewards may be.
        data = json.loads(content)
        if _ESCAPED_SURROGATE.search(content if isinstance(content, bytes) else content.encode()):
            json.dumps(data, ensure_ascii=False).encode()  # a lone surrogate can be neither sent nor printed
        return data
    except (ValueError, RecursionError) as error:
        raise WrongDocument("is not JSON, or was cut short") from error


def json_text(value: object, indent: int | None = None) -> str:
    """`value`, which may contain Structs, as JSON."""
    text = json.dumps(value, default=_plain)
    if indent is None:
        return text
    try:
        # json indents in Python, which takes six times as long.
        return msgspec.json.format(text, indent=indent)
    except msgspec.DecodeError:  # msgspec refuses NaN
        return json.dumps(value, indent=indent, default=_plain)


def differences_from_source(info: EpisodeInfo) -> dict[str, Any]:
    """Fields for the metadata of an export: the cameras that were not where the recorded source places them,
    and the version that made the observations if it is later than that source. Empty if neither applies."""
    fields = {"moved_cameras": as_json(info.moved_cameras), "observed_by": info.observed_by}
    return {name: value for name, value in fields.items() if value}


def as_json(value: object) -> Any:
    """`value` after writing it as JSON and reading it back."""
    return json.loads(json_text(value))


def fields_of(struct: Struct) -> dict[str, Any]:
    """The fields that are set, by their names in the file."""
    held = ((in_file, getattr(struct, name)) for name, in_file in _names_of(type(struct)))
    return {name: value for name, value in held if value is not UNSET}


@cache
def _names_of(kind: type[Struct]) -> tuple[tuple[str, str], ...]:
    """(name, name in the file) of each field, cached because msgspec evaluates the annotations at every call."""
    return tuple((field.name, field.encode_name) for field in msgspec.structs.fields(kind))


def _plain(value: object) -> Any:
    if is_dataclass(value):
        return vars(value)
    if not isinstance(value, Struct):
        return str(value)
    return msgspec.structs.astuple(value) if value.__struct_config__.array_like else fields_of(value)


def _typed(data: object, kind: type[T], place: str) -> T:
    if not is_shallow(data):
        raise WrongDocument(
            "is not in the format of a recording: lists and objects nested deeper than "
            f"{MAX_DEPTH} at $.{place}"
        )
    try:
        return msgspec.convert(data, kind, str_keys=True)
    except (msgspec.ValidationError, OverflowError) as error:
        what, _, within = str(error).partition(" - at `$")
        at = f"${'.' if place else ''}{place}{within.rstrip('`')}"
        raise WrongDocument(
            f"is not in the format of a recording: {what[0].lower()}{what[1:]} at {at}"
        ) from error


def task_file(source_path: str | None, task: str, folder: Path) -> str | None:
    """The task's file at `source_path` relative to the recording's `folder`; None if it is not found.

    In a copied recording the path is wrong, but the copy is usually opened from the task's folder. So the
    path and its ends (for ``a/b/c.py``: ``b/c.py`` and ``c.py``) are tried below the current folder, below
    the recording's folder, and below the folders above the recording's. A file that is found in this way must
    contain the task's name.
    """
    if not source_path:
        return None
    # Not `Path.is_file`, which raises for an invalid file name.
    if os.path.isfile(there := folder / source_path):
        return os.fspath(there.resolve())
    parts = [part for part in Path(source_path).parts if part not in ("..", os.sep)]
    if not source_path.endswith(".py") or len(parts) > MAX_PATH_PARTS:
        return None
    for place in (Path.cwd(), folder.resolve(), *folder.resolve().parents):
        for begin in range(len(parts)):
            candidate = place.joinpath(*parts[begin:])
            try:
                if task.encode(errors="surrogatepass") in read_regular_file(candidate, MAX_SOURCE_BYTES):
                    return os.fspath(candidate.resolve())
            except (OSError, ValueError):  # a null byte
                continue
    return None


# --- checksums --------------------------------------------------------------------------------------
#
# Neither the .h5 nor the .rrd detects a changed byte: HDF5 has checksums for chunks only, and most columns of
# an episode are too small to be chunked; rerun has no checksums. Rescoring a changed file would be silently
# wrong. So the `.json` has the size and hash of the other two files. They are hashed while they are still in
# the page cache, which takes a hundredth of the time of writing them (measured). The `.json` itself ends with
# a hash of everything before it.
#
# Checksums detect damage, not forgery. After you changed an `.rrd` or `.h5` (with `rerun rrd optimize`, for
# example), remove its entry from `workbench.files` in the `.json`; after you changed the `.json`, set its
# hash to null.

_OWN = "workbench_checksum"


def with_checksum(text: bytes) -> bytes:
    """The JSON object `text`, with a hash of its content as the last member."""
    body = text.rstrip().removesuffix(b"}").rstrip()
    return b'%s,\n  "%s": "%s"\n}' % (body, _OWN.encode(), xxhash.xxh3_128_hexdigest(body).encode())


def _require_unchanged(content: bytes, document: Document) -> None:
    """Raise WrongDocument if `content`, the text of `document`, was changed after its checksum was
    written."""
    if _OWN not in document.data:
        # A recording with a damaged checksum key must not pass for an old recording, which has no checksum.
        if document.is_ours and document.data["workbench"].get("format", 1) != 1:
            raise WrongDocument("has changed since it was written: it has lost its checksum")
    elif document.data[_OWN] is not None:
        before, comma, _ = content.rpartition(b',\n  "%s"' % _OWN.encode())
        if not comma or with_checksum(before + b"}") != content.rstrip():
            raise WrongDocument("has changed since it was written: its checksum differs")


def checksum(path: Path) -> Checksum:
    """Checksum of the file at `path`. Raises OSError."""
    hashed = xxhash.xxh3_128()
    size = 0
    with open_regular_file(path) as file:
        while block := file.read(_BLOCK_BYTES):
            hashed.update(block)
            size += len(block)
    return Checksum(size, hashed.hexdigest())


def check(path: Path, checksums: Mapping[str, Checksum]) -> None:
    """Compare the file at `path` with the checksum of its suffix, if there is one.

    Raises:
        OSError: it differs, or cannot be read.
    """
    with open_regular_file(path) as file:
        size = os.fstat(file.fileno()).st_size
    if (why := wrong_size(checksums, path.suffix, size)) is not None:
        raise OSError(why)
    written = checksums.get(path.suffix)
    if written is not None and written.xxh3_128 is not None and checksum(path) != written:
        raise OSError("its checksum differs from the recorded one")


def wrong_size(checksums: Mapping[str, Checksum], suffix: str, size: int) -> str | None:
    """Problem with a file of `size` bytes; None if this is the recorded size, or no size was recorded."""
    if suffix not in checksums or checksums[suffix].size == size:
        return None
    return f"it has {size} bytes, and had {checksums[suffix].size} when it was written"


# --- tags and notes -----------------------------------------------------------------------------------
#
# A person typed the tags and notes, and the library's index may be discarded without asking. So tags and
# notes are stored with the recordings: in the `.json` of a workbench recording, but in `NAME.notes` for files
# of other programs, which rewrite their own files (ManiSkill's recorder after each episode). `mv NAME.*`
# moves the `.notes` along.


MAX_NOTES_BYTES = 16 << 20
"""Maximum size of a ``.notes``, and of the workbench's own ``.json`` files, which hold the task's source and one small
picture."""
_NOTES = "workbench_notes"


def read_notes(path: Path) -> dict[str, tuple[tuple[str, ...], str]]:
    """The tags and the note of each trajectory in a ``.notes``, by trajectory ("" in a file without
    trajectories); empty if the file cannot be read."""
    try:
        return _notes(path)
    except (OSError, ValueError):
        return {}


def write_notes(path: Path, trajectory: str | None, tags: tuple[str, ...], note: str) -> None:
    """Write tags and note of one trajectory into a ``.notes``; delete the file if it becomes empty.

    Raises:
        OSError: the file cannot be read, or the folder cannot be written to.
        ValueError: the file holds something else, which is not overwritten. The message is a clause.
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
        entries = read_json(path, MAX_NOTES_BYTES)[_NOTES]
        return {
            str(name): (clean_tags(entry.get("tags")), clean_note(entry.get("note")))
            for name, entry in entries.items()
        }
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{path.name} holds no notes that this version can read: move it away") from error


def write_into_description(path: Path, tags: tuple[str, ...], note: str) -> None:
    """Write tags and note into the ``.json`` of a workbench recording, replacing the file atomically.

    Raises:
        OSError: it cannot be read or written.
        ValueError: it is not a workbench recording, or was changed, which a new checksum would hide. The
            message is a clause.
    """
    content = _read_content(path, MAX_NOTES_BYTES)
    described = parse_json(content)
    if not isinstance(described, dict) or not Document(described).is_ours:
        raise ValueError("is not a recording of the workbench")
    _require_unchanged(content, Document(described))
    is_sealed = described.get(_OWN) is not None
    if is_sealed:
        del described[_OWN]
    described["workbench"] |= {"tags": list(tags), "note": note}
    # Keep the indentation: people read these files.
    text = json.dumps(described, indent=2 if b"\n" in content[:4] else None).encode()
    replace_file(path, with_checksum(text) if is_sealed else text)
