"""An episode as its journal tells it: its columns whole, its pictures a few megabytes at a time.

Both formats must be told beforehand what is only known afterwards: how long the episode is, which entries
``evaluate()`` gave in the end and of which type, which bodies never moved. An hour of an episode is a hundred megabytes of
numbers, which are put together at once; but its pictures are more than a machine holds, so they are
read a second time, while the file that they go to is written.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from workbench.core.geometry import SceneGeometry, Visual
from workbench.core.pictures import CameraInfo
from workbench.recording.columns import EVALUATE, TEXT, TextTrack, assemble, layout_type, tracks_of
from workbench.recording.document import CameraWords, json_text
from workbench.recording.encoded_pictures import MODALITIES, Modality
from workbench.recording.episode import EpisodeInfo, acted_by_from, flag_of
from workbench.recording.journal import Entry, read_journal
from workbench.recording.made_here import is_sealed, seal_text

_MOST_PICTURES = 1024
_MOST_BYTES = 8 << 20
"""Of the pictures that are read at once."""


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
    info = json_text(asdict(header.info))
    return json_text(
        {
            "info": info,
            "made_here": seal_text(info),
            "bodies": [geometry.num_envs, geometry.body_names, geometry.body_kinds, geometry.body_hidden],
            "segmentation": {str(key): name for key, name in header.segmentation.items()},
            "action_names": header.action_names,
            "cameras": [CameraWords.of(camera) for camera in header.cameras],
        }
    )


def header_from(text: str, visuals: tuple[Visual, ...]) -> Header:
    """The inverse of `header_text`; the meshes lie beside it. Raises ValueError, KeyError or TypeError."""
    said = json.loads(text)
    num_envs, names, kinds, hidden = said["bodies"]
    # A journal of an earlier version holds it as an object, without a seal.
    info = said["info"] if isinstance(said["info"], str) else json.dumps(said["info"])
    return Header(
        info=_info_from(json.loads(info)),
        geometry=SceneGeometry(num_envs, tuple(names), tuple(kinds), tuple(hidden), visuals),
        segmentation={int(key): name for key, name in said["segmentation"].items()},
        action_names=tuple(said["action_names"]),
        cameras=tuple(words.info() for words in msgspec.convert(said["cameras"], list[CameraWords])),
        made_here=is_sealed(info, said.get("made_here")),
    )


def _info_from(said: Mapping[str, Any]) -> EpisodeInfo:
    return EpisodeInfo(**{**said, "acted_by": acted_by_from(said.get("acted_by")), "seal": None})


@dataclass
class CameraSurvey:
    info: CameraInfo
    number: int
    """Which of the header's cameras it is."""
    frames: list[int] = field(default_factory=list)
    """State of each of its P pictures."""
    poses: list[bytes] = field(default_factory=list)
    """Of each, (7,) float32."""
    modalities: set[Modality] = field(default_factory=set)
    wide: bool = False
    """One of its segmentations has ids that 16 bits do not hold."""

    @property
    def still(self) -> bool:
        """It never moved."""
        return len(set(self.poses)) == 1

    @property
    def pose(self) -> NDArray[np.float32]:
        """(P, 7)"""
        return np.frombuffer(b"".join(self.poses), np.float32).reshape(-1, 7)


@dataclass
class Survey:
    """All that is to be known of an episode of T steps but its pictures."""

    header: Header
    columns: dict[str, NDArray]
    """(T + 1, ...) each, named as `columns` says; nothing where the journal has no state."""
    cameras: list[CameraSurvey]
    """Those that took a picture."""
    texts: dict[str, TextTrack]
    """Entries of ``evaluate()`` that are no numbers."""
    sample: bytes | None
    """A picture of the episode (JPEG), near its end, of a camera for people if there is one."""

    @property
    def info(self) -> EpisodeInfo:
        return self.header.info

    @property
    def states(self) -> int:
        """T + 1"""
        return len(self.columns["poses"]) if self.columns else 0

    @property
    def length(self) -> int:
        return max(self.states - 1, 0)

    @property
    def poses(self) -> NDArray[np.float32]:
        """(T + 1, B, 7)"""
        return self.columns["poses"]

    @property
    def reward(self) -> NDArray[np.float32]:
        """(T,)"""
        return self.columns["reward"][1:]

    @cached_property
    def present(self) -> NDArray[np.bool_]:
        """(B,) the env has the body."""
        return np.asarray(np.isfinite(self.poses).any(axis=(0, 2)))

    @cached_property
    def still(self) -> NDArray[np.bool_]:
        """(B,) it never moved."""
        bits = self.poses.view(np.int32)  # a NaN is no movement
        return (bits == bits[0]).all(axis=(0, 2))

    @cached_property
    def flags(self) -> dict[str, NDArray[np.bool_]]:
        """(T + 1,) ``success`` and ``fail``, those that the task has."""
        found = {name: flag_of(self.columns.get(EVALUATE + name)) for name in ("success", "fail")}
        return {name: flag for name, flag in found.items() if flag is not None}

    def evaluate(self) -> dict[str, NDArray]:
        """The columns of entries of ``evaluate()`` with a row for each env."""
        return self.named(EVALUATE)

    def named(self, prefix: str) -> dict[str, NDArray]:
        return {name[len(prefix) :]: c for name, c in self.columns.items() if name.startswith(prefix)}


@dataclass(frozen=True)
class Pictures:
    """Some consecutive pictures of one camera."""

    camera: int
    """Index into `Survey.cameras`."""
    modality: Modality
    frames: list[int]
    """The states that they are of."""
    blobs: list[bytes]
    """Encoded."""


def read_header(journal: Path, visuals: tuple[Visual, ...]) -> Header | None:
    """None where the journal ends before its header.

    Raises:
        OSError: the journal cannot be read.
        ValueError: it begins with something else: it is of a later version, or none of ours.
    """
    for entries in read_journal(journal):
        try:
            return header_from(entries[0].value.decode(), visuals)
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            why = (
                f"{journal.name} is no recording that this version can read; a later one may, else remove it"
            )
            raise ValueError(why) from error
    return None


def read_survey(journal: Path, header: Header) -> Survey:
    """Raises OSError."""
    layouts: list[np.dtype] = []
    runs: list[tuple[int, list[bytes]]] = []
    """Layout, and the rows of it that follow each other."""
    cameras = [CameraSurvey(info, number) for number, info in enumerate(header.cameras)]
    acted = list(header.info.acted_by)
    texts: list[tuple[int, bytes]] = []
    samples: dict[str, bytes] = {}
    for kind, number, value in (entry for state in _states(journal) for entry in state):
        if kind == "row":
            if not runs or runs[-1][0] != number:
                runs.append((number, []))
            runs[-1][1].append(value)
        elif kind == "layout":
            layouts.append(layout_type(value.decode()))
        elif kind == "acted":
            acted.append((number, value.decode()))
        elif kind == TEXT:
            texts.append((number, value))
        elif kind.startswith("camera/"):
            camera = cameras[int(kind[7:])]
            camera.frames.append(number)
            camera.poses.append(value)
        elif kind.startswith("picture/"):
            _, index, name = kind.split("/")
            camera, modality = cameras[int(index)], _modality(name)
            camera.modalities.add(modality)
            if modality == "segmentation":
                camera.wide |= value[25] == _PNG_RGBA
            if modality == "rgb":
                samples[camera.info.kind] = value
    return Survey(
        header=replace(header, info=replace(header.info, acted_by=tuple(acted))),
        columns=assemble([np.frombuffer(b"".join(rows), layouts[layout]) for layout, rows in runs]),
        cameras=[camera for camera in cameras if camera.frames],
        texts=tracks_of(texts),
        sample=samples.get("human", samples.get("sensor")),
    )


def read_pictures(journal: Path, survey: Survey) -> Iterator[Pictures]:
    """All pictures, those of a camera and modality in order. Raises OSError."""
    found: dict[str, tuple[int, Modality]] = {
        f"picture/{camera.number}/{modality}": (index, modality)
        for index, camera in enumerate(survey.cameras)
        for modality in camera.modalities
    }
    held: dict[str, Pictures] = {}
    size = 0
    for state in _states(journal) if found else ():
        for kind, number, value in state:
            if kind in found:
                pictures = held.setdefault(kind, Pictures(*found[kind], [], []))
                pictures.frames.append(number)
                pictures.blobs.append(value)
                size += len(value)
        if size >= _MOST_BYTES or any(len(pictures.frames) >= _MOST_PICTURES for pictures in held.values()):
            yield from held.values()
            held, size = {}, 0
    yield from held.values()


def _states(journal: Path) -> Iterator[list[Entry]]:
    """The entries of each state that is there with all that belongs to it, its row last."""
    held: list[Entry] = []
    for entries in read_journal(journal):
        for entry in entries:
            held.append(entry)
            if entry.kind == "row":
                yield held
                held = []


_PNG_RGBA = 6
"""Colour type of a PNG, its byte 25 (PNG specification, section 11.2.1)."""


def recovered(header: Header) -> Header:
    return replace(header, info=replace(header.info, recovered=True))


def _modality(name: str) -> Modality:
    for modality in MODALITIES:
        if modality == name:
            return modality
    raise ValueError(f"{name} is no modality of a picture")
