"""An episode as its journal tells it: its columns whole, its pictures where they lie until one is asked for.

Both formats must be told beforehand what is only known afterwards: how long the episode is, which entries
``evaluate()`` gave in the end and of which type, which bodies never moved. An hour of an episode is a hundred megabytes of
numbers, which are put together at once; but its pictures are more than a machine holds, so they are
read a second time, while the file that they go to is written.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from workbench.core.camera_data import CameraInfo
from workbench.core.scene.shapes import SceneGeometry, Visual
from workbench.recording.episode.columns import (
    BATCH,
    EVALUATE,
    OBS,
    STATE,
    TEXT,
    assemble,
    layout_type,
    tracks_of,
)
from workbench.recording.episode.document import CameraJson, json_text
from workbench.recording.episode.encoded_pictures import MODALITIES, EncodedPictures, LazyPictures, Modality
from workbench.recording.episode.episode import CameraTrack, Episode, EpisodeInfo, parse_acted_by
from workbench.recording.episode.made_here import is_sealed, seal_text
from workbench.recording.writing.journal import JournalEntry, JournalReader


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
            "cameras": [CameraJson.of(camera) for camera in header.cameras],
        }
    )


def header_from(text: str, visuals: tuple[Visual, ...]) -> Header:
    """The inverse of `header_text`; the meshes lie beside it. Raises ValueError, KeyError or TypeError."""
    data = json.loads(text)
    num_envs, names, kinds, hidden = data["bodies"]
    # A journal of an earlier version holds it as an object, without a seal.
    info = data["info"] if isinstance(data["info"], str) else json.dumps(data["info"])
    return Header(
        info=_info_from(json.loads(info)),
        geometry=SceneGeometry(num_envs, tuple(names), tuple(kinds), tuple(hidden), visuals),
        segmentation={int(key): name for key, name in data["segmentation"].items()},
        action_names=tuple(data["action_names"]),
        cameras=tuple(words.info() for words in msgspec.convert(data["cameras"], list[CameraJson])),
        made_here=is_sealed(info, data.get("made_here")),
    )


def _info_from(data: Mapping[str, Any]) -> EpisodeInfo:
    return EpisodeInfo(**{**data, "acted_by": parse_acted_by(data.get("acted_by")), "seal": None})


def recovered(header: Header) -> Header:
    return replace(header, info=replace(header.info, recovered=True))


def read_header(journal: JournalReader, visuals: tuple[Visual, ...]) -> Header | None:
    """None where the journal ends before its header.

    Raises:
        OSError: the journal cannot be read.
        ValueError: it begins with something else: it is of a later version, or none of ours.
    """
    for _, entries in journal:
        try:
            return header_from(entries[0].value.decode(), visuals)
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            why = f"{journal.path.name} is no recording that this version can read; a later one may, else remove it"
            raise ValueError(why) from error
    return None


@dataclass
class _Seen:
    """What the journal has of one camera."""

    frames: list[int] = field(default_factory=list)
    poses: list[bytes] = field(default_factory=list)
    places: dict[Modality, list[tuple[int, int]]] = field(default_factory=dict)

    def track(self, info: CameraInfo, journal: JournalReader) -> CameraTrack:
        def pictures(modality: Modality, places: list[tuple[int, int]]) -> EncodedPictures:
            return EncodedPictures(modality, LazyPictures(len(places), lambda n: journal.value(places[n])))

        pose = np.frombuffer(b"".join(self.poses), np.float32).reshape(-1, 7)
        held = {modality: pictures(modality, places) for modality, places in self.places.items()}
        return CameraTrack(info, np.array(self.frames, np.int64), pose, **held)


def episode_in(journal: JournalReader, header: Header) -> Episode | None:
    """The episode that began as `header` says, with the scene of its whole batch; None where there is no state yet.

    Its pictures can be had for as long as the journal is open. Raises OSError.
    """
    layouts: list[np.dtype] = []
    runs: list[tuple[int, list[bytes]]] = []
    """Layout, and the rows of it that follow each other."""
    seen = [_Seen() for _ in header.cameras]
    acted = list(header.info.acted_by)
    texts: list[tuple[int, bytes]] = []
    for place, (kind, number, value) in _complete_states(journal):
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
            camera = seen[int(kind[7:])]
            camera.frames.append(number)
            camera.poses.append(value)
        elif kind.startswith("picture/"):
            _, index, name = kind.split("/")
            seen[int(index)].places.setdefault(_modality(name), []).append(place)
    if not runs:
        return None
    columns = assemble([np.frombuffer(b"".join(rows), layouts[layout]) for layout, rows in runs])

    def named(prefix: str) -> dict[str, NDArray]:
        return {name[len(prefix) :]: c for name, c in columns.items() if name.startswith(prefix)}

    return Episode(
        info=replace(header.info, acted_by=tuple(acted)),
        geometry=header.geometry,
        segmentation=header.segmentation,
        poses=columns["poses"],
        action=columns["action"][1:].astype(np.float32, copy=False),
        action_names=header.action_names,
        reward=columns["reward"][1:].astype(np.float32, copy=False),
        terminated=columns["terminated"][1:],
        truncated=columns["truncated"][1:],
        evaluate=named(EVALUATE),
        cameras=[camera.track(info, journal) for camera, info in zip(seen, header.cameras) if camera.frames],
        env_states=named(STATE),
        obs=named(OBS),
        batch=named(BATCH),
        texts=tracks_of(texts),
    )


def _complete_states(journal: JournalReader) -> Iterator[tuple[tuple[int, int], JournalEntry]]:
    """The entries of states that are there with all that belongs to them, their row last, and where they lie."""
    held: list[tuple[tuple[int, int], JournalEntry]] = []
    for begin, entries in journal:
        for row, entry in enumerate(entries):
            held.append(((begin, row), entry))
            if entry.kind == "row":
                yield from held
                held = []


def _modality(name: str) -> Modality:
    for modality in MODALITIES:
        if modality == name:
            return modality
    raise ValueError(f"{name} is no modality of a picture")
