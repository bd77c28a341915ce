"""What an episode turned out to be, learnt from its journal in one pass, before any file of it is written.

Both formats must be told beforehand what is only known afterwards: how long the episode is, which entries
``evaluate()`` gave in the end and of which type, which bodies never moved. So the journal is read twice, a piece at a time:
once for this, and once for the columns. What is kept of the first pass is small whatever the length of the episode; the
pictures are not among it.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from workbench.core.geometry import SceneGeometry
from workbench.core.pictures import CameraInfo
from workbench.recording.columns import EVALUATE, Column, assemble, layout_type, merge
from workbench.recording.encoded_pictures import MODALITIES, Modality
from workbench.recording.entry_texts import KIND as TEXT
from workbench.recording.entry_texts import TextTrack, tracks_of
from workbench.recording.episode import EpisodeInfo, acted_by_from
from workbench.recording.journal import Entry, read_journal
from workbench.recording.made_here import is_sealed, seal_text

_PIECE_STATES = 1024
_PIECE_BYTES = 8 << 20


@dataclass(frozen=True)
class Header:
    """What is known of an episode when it begins."""

    info: EpisodeInfo
    geometry: SceneGeometry
    segmentation: dict[int, str]
    action_names: tuple[str, ...]
    cameras: tuple[CameraInfo, ...]
    made_here: bool = True
    """Its episode was recorded by this installation: not so of a journal that came with a folder from elsewhere."""

    @property
    def bodies(self) -> int:
        return len(self.geometry.body_names)


def header_text(header: Header) -> str:
    """`header` without its meshes, as JSON."""
    geometry = header.geometry
    info = json.dumps(asdict(header.info), default=str)
    return json.dumps(
        {
            "info": info,
            "made_here": seal_text(info),
            "bodies": [geometry.num_envs, geometry.body_names, geometry.body_kinds, geometry.body_hidden],
            "segmentation": {str(key): name for key, name in header.segmentation.items()},
            "action_names": header.action_names,
            "cameras": [camera_words(camera) for camera in header.cameras],
        },
        default=str,
    )


def header_from(text: str, geometry: SceneGeometry | None) -> Header:
    """The inverse of `header_text`; where the meshes were lost there are none. Raises ValueError, KeyError or TypeError."""
    said = json.loads(text)
    if geometry is None:
        num_envs, names, kinds, hidden = said["bodies"]
        geometry = SceneGeometry(num_envs, tuple(names), tuple(kinds), tuple(hidden), ())
    # A journal of an earlier version holds it as an object, without a seal.
    info = said["info"] if isinstance(said["info"], str) else json.dumps(said["info"])
    return Header(
        info=_info_from(json.loads(info)),
        geometry=geometry,
        segmentation={int(key): name for key, name in said["segmentation"].items()},
        action_names=tuple(said["action_names"]),
        cameras=tuple(camera_from(words) for words in said["cameras"]),
        made_here=is_sealed(info, said.get("made_here")),
    )


def _info_from(said: Mapping[str, Any]) -> EpisodeInfo:
    return EpisodeInfo(**{**said, "acted_by": acted_by_from(said.get("acted_by")), "seal": None})


def camera_words(camera: CameraInfo) -> dict[str, Any]:
    """`camera` as JSON; where its config stands in the source is of no use to another day."""
    return {
        "name": camera.name,
        "kind": camera.kind,
        "width": camera.width,
        "height": camera.height,
        "fovy": float(camera.fovy),
        "near": float(camera.near),
        "far": float(camera.far),
        "intrinsic": np.asarray(camera.intrinsic, dtype=np.float64).tolist(),
        "mount": camera.mount,
        "modalities": list(camera.modalities),
    }


def camera_from(words: Mapping[str, Any]) -> CameraInfo:
    held = dict(words)
    held["intrinsic"] = np.array(held["intrinsic"], dtype=np.float32)
    held["modalities"] = tuple(held["modalities"])
    return CameraInfo(**held)


@dataclass
class CameraSurvey:
    info: CameraInfo
    frames: NDArray[np.int64]
    """(P,) state of each picture."""
    poses: NDArray[np.float32]
    """(P, 7)"""
    still: bool
    """It never moved."""
    modalities: tuple[Modality, ...]
    wide: bool
    """One of its segmentations has ids that 16 bits do not hold."""


@dataclass
class Survey:
    """All that is to be known of an episode of T steps but its columns and pictures."""

    header: Header
    states: int = 0
    """T + 1"""
    columns: dict[str, Column] = field(default_factory=dict)
    cameras: list[CameraSurvey] = field(default_factory=list)
    """Those that took a picture."""
    first_poses: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 7), np.float32))
    present: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, np.bool_))
    """(B,) the env has the body."""
    still: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, np.bool_))
    """(B,) it never moved."""
    reward: NDArray[np.float32] = field(default_factory=lambda: np.zeros(0, np.float32))
    """(T,)"""
    terminated: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, np.bool_))
    truncated: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, np.bool_))
    flags: dict[str, NDArray[np.bool_]] = field(default_factory=dict)
    """(T + 1,) ``success`` and ``fail``, those that the task has; a state that lacks it says no."""
    texts: dict[str, TextTrack] = field(default_factory=dict)
    """Entries of ``evaluate()`` that are no numbers."""
    sample: bytes | None = None
    """A picture of the episode (JPEG), near its end, of a camera for people if there is one."""

    @property
    def length(self) -> int:
        return max(self.states - 1, 0)

    @property
    def info(self) -> EpisodeInfo:
        return self.header.info

    def evaluate(self) -> dict[str, Column]:
        """Entry of ``evaluate()`` with a row for each env to what its column is."""
        return self.named(EVALUATE)

    def named(self, prefix: str) -> dict[str, Column]:
        return {name[len(prefix) :]: c for name, c in self.columns.items() if name.startswith(prefix)}


@dataclass(frozen=True)
class Piece:
    """Some consecutive states of an episode."""

    first: int
    """State of the first row."""
    columns: dict[str, NDArray]
    pictures: dict[tuple[int, Modality], tuple[list[int], list[bytes]]]
    """(index into `Survey.cameras`, modality) to the states and the encoded pictures."""

    @property
    def states(self) -> NDArray[np.int64]:
        return np.arange(self.first, self.first + len(self.columns["poses"]), dtype=np.int64)


class _Raw:
    """States as they come out of a journal, before anything is known of the whole."""

    def __init__(self, first: int) -> None:
        self.first = first
        self.rows: list[tuple[int, bytes]] = []
        """Layout and bytes of a row, or of several."""
        self.states = 0
        self.pictures: dict[tuple[int, Modality], tuple[list[int], list[bytes]]] = {}
        self.poses: list[tuple[int, int, bytes]] = []
        self.acted: list[tuple[int, str]] = []
        self.texts: list[tuple[int, bytes]] = []
        self.bytes = 0

    def runs(self, layouts: Sequence[np.dtype]) -> list[NDArray]:
        """The rows as runs of one layout each."""
        found: list[NDArray] = []
        begin = 0
        for end in range(1, len(self.rows) + 1):
            if end == len(self.rows) or self.rows[end][0] != self.rows[begin][0]:
                content = b"".join(value for _, value in self.rows[begin:end])
                found.append(np.frombuffer(content, dtype=layouts[self.rows[begin][0]]))
                begin = end
        return found


class _Seen:
    """What a camera did, while it is being read."""

    def __init__(self) -> None:
        self.frames: list[int] = []
        self.poses: list[bytes] = []
        self.modalities: set[Modality] = set()
        self.wide = False

    def survey(self, info: CameraInfo) -> CameraSurvey:
        return CameraSurvey(
            info,
            np.array(self.frames, np.int64),
            np.frombuffer(b"".join(self.poses), np.float32).reshape(-1, 7),
            len(set(self.poses)) == 1,
            tuple(modality for modality in MODALITIES if modality in self.modalities),
            self.wide,
        )


class JournalReader:
    """A journal, a piece at a time; `layouts` grows while `pieces` is read."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.layouts: list[np.dtype] = []

    def header(self, geometry: SceneGeometry | None) -> Header | None:
        """None where the journal ends before its header.

        Raises:
            OSError: the journal cannot be read.
            ValueError: it begins with something else: it is of a later version, or none of ours.
        """
        for entries in read_journal(self._path):
            try:
                return header_from(entries[0].value.decode(), geometry)
            except (ValueError, KeyError, TypeError, AttributeError) as error:
                why = f"{self._path.name} is no recording that this version can read; a later one may, else remove it"
                raise ValueError(why) from error
        return None

    def raw(self) -> Iterator[_Raw]:
        self.layouts = []
        raw = _Raw(0)
        held: list[Entry] = []
        for entries in read_journal(self._path):
            for entry in entries:
                held.append(entry)
                if entry.kind != "row":
                    continue
                for part in held:
                    self._take(raw, part)
                held.clear()
                if raw.states >= _PIECE_STATES or raw.bytes >= _PIECE_BYTES:
                    yield raw
                    raw = _Raw(raw.first + raw.states)
        if raw.rows:
            yield raw

    def _take(self, raw: _Raw, entry: Entry) -> None:
        raw.bytes += len(entry.value)
        if entry.kind == "row":
            raw.rows.append((entry.number, entry.value))
            raw.states += len(entry.value) // self.layouts[entry.number].itemsize
        elif entry.kind == "layout":
            self.layouts.append(layout_type(entry.value.decode()))
        elif entry.kind == "acted":
            raw.acted.append((entry.number, entry.value.decode()))
        elif entry.kind == TEXT:
            raw.texts.append((entry.number, entry.value))
        elif entry.kind.startswith("camera/"):
            raw.poses.append((int(entry.kind[7:]), entry.number, entry.value))
        elif entry.kind.startswith("picture/"):
            _, camera, modality = entry.kind.split("/")
            states, blobs = raw.pictures.setdefault((int(camera), _modality(modality)), ([], []))
            states.append(entry.number)
            blobs.append(entry.value)

    def survey(self, header: Header) -> Survey:
        """Raises OSError."""
        survey = Survey(header)
        survey.present = np.zeros(header.bodies, np.bool_)
        survey.still = np.ones(header.bodies, np.bool_)
        counts: dict[np.dtype, int] = {}
        cameras = [_Seen() for _ in header.cameras]
        smalls: dict[str, list[NDArray]] = {"reward": [], "terminated": [], "truncated": []}
        flags: dict[str, list[NDArray[np.bool_]]] = {"success": [], "fail": []}
        samples: dict[str, bytes] = {}
        acted = list(header.info.acted_by)
        texts: list[tuple[int, bytes]] = []
        for raw in self.raw():
            for run in raw.runs(self.layouts):
                counts[run.dtype] = counts.get(run.dtype, 0) + len(run)
                poses = run["poses"]
                if survey.states == 0:
                    survey.first_poses = poses[0].copy()
                survey.states += len(run)
                survey.present |= np.isfinite(poses).any(axis=(0, 2))
                # As bits: a NaN is no movement.
                moved = poses.view(np.int32) != survey.first_poses.view(np.int32)
                survey.still &= ~moved.any(axis=(0, 2))
                for name, parts in smalls.items():
                    parts.append(run[name].copy())
                for name, parts in flags.items():
                    parts.append(_flag(run, EVALUATE + name))
            acted += raw.acted
            texts += raw.texts
            for index, state, value in raw.poses:
                cameras[index].frames.append(state)
                cameras[index].poses.append(value)
            for (index, modality), (_, blobs) in raw.pictures.items():
                cameras[index].modalities.add(modality)
                if modality == "segmentation":
                    cameras[index].wide |= any(blob[25] == _PNG_RGBA for blob in blobs)
                if modality == "rgb":
                    samples[header.cameras[index].kind] = blobs[-1]
        survey.header = replace(header, info=replace(header.info, acted_by=tuple(acted)))
        survey.columns = merge(counts)
        survey.texts = tracks_of(texts)
        survey.cameras = [
            seen.survey(info) for info, seen in zip(header.cameras, cameras, strict=True) if seen.frames
        ]
        for name, parts in smalls.items():
            setattr(survey, name, np.concatenate(parts)[1:] if parts else getattr(survey, name))
        for name, parts in flags.items():
            if (column := survey.evaluate().get(name)) is not None and column.shape == ():
                survey.flags[name] = np.concatenate(parts)
        survey.sample = samples.get("human", samples.get("sensor"))
        return survey

    def pieces(self, survey: Survey) -> Iterator[Piece]:
        """The episode in pieces of a few megabytes, in order. Raises OSError."""
        listed = {
            index: number
            for number, camera in enumerate(survey.cameras)
            for index, info in enumerate(survey.header.cameras)
            if info is camera.info
        }
        for raw in self.raw():
            columns = assemble(raw.runs(self.layouts), survey.columns)
            piece = Piece(raw.first, columns, {})
            for (index, modality), held in raw.pictures.items():
                piece.pictures[listed[index], modality] = held
            yield piece


_PNG_RGBA = 6
"""Colour type of a PNG, its byte 25 (PNG specification, section 11.2.1)."""


def recovered(header: Header) -> Header:
    return replace(header, info=replace(header.info, recovered=True))


def _modality(name: str) -> Modality:
    for modality in MODALITIES:
        if modality == name:
            return modality
    raise ValueError(f"{name} is no modality of a picture")


def _flag(run: NDArray, name: str) -> NDArray[np.bool_]:
    if name not in (run.dtype.names or ()) or run.dtype[name].shape != ():
        return np.zeros(len(run), np.bool_)
    return np.nan_to_num(run[name].astype(np.float64)) != 0
