"""Reads an episode back from its journal."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from workbench.envs.camera_data import CameraInfo, MovedCamera
from workbench.envs.scene.shapes import SceneGeometry, Visual
from workbench.episodes.columns import BATCH, EVALUATE, OBS, STATE, TEXT, assemble, layout_type, text_tracks
from workbench.episodes.document import CameraJson, SceneJson, json_text
from workbench.episodes.drawings import DRAWING, drawing_tracks
from workbench.episodes.encoded_pictures import MODALITIES, EncodedPictures, LazyPictures, Modality
from workbench.episodes.episode import CameraTrack, Episode, EpisodeInfo, parse_acted_by
from workbench.episodes.seal import is_sealed, seal_text
from workbench.episodes.writing.journal import JournalEntry, JournalReader


@dataclass(frozen=True)
class Header:
    """Metadata that is known when an episode begins."""

    info: EpisodeInfo
    geometry: SceneGeometry
    segmentation: dict[int, str]
    action_names: tuple[str, ...]
    cameras: tuple[CameraInfo, ...]
    made_here: bool = True
    """Whether this installation recorded the episode; False for a journal that another installation wrote."""

    @property
    def bodies(self) -> int:
        return len(self.geometry.body_names)


def header_text(header: Header) -> str:
    """`header` without its meshes, as JSON."""
    geometry = header.geometry
    info = json_text({**vars(header.info), "seal": None})
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
    """The inverse of `header_text`, with the meshes in `visuals`. Raises ValueError, KeyError or TypeError."""
    data = json.loads(text)
    num_envs, names, kinds, hidden = data["bodies"]
    # Validates the kinds: a damaged journal may hold kinds that readers of the files would reject.
    scene = msgspec.convert({"body_names": names, "body_kinds": kinds, "body_hidden": hidden}, SceneJson)
    # In journals of older versions `info` is an object, and there is no seal.
    info = data["info"] if isinstance(data["info"], str) else json.dumps(data["info"])
    return Header(
        info=_info_from(json.loads(info)),
        geometry=SceneGeometry(num_envs, scene.body_names, scene.body_kinds, scene.body_hidden, visuals),
        segmentation={int(key): name for key, name in data["segmentation"].items()},
        action_names=tuple(data["action_names"]),
        cameras=tuple(words.info() for words in msgspec.convert(data["cameras"], list[CameraJson])),
        made_here=is_sealed(info, data.get("made_here")),
    )


def _info_from(data: Mapping[str, Any]) -> EpisodeInfo:
    acted_by = parse_acted_by(data.get("acted_by"))
    pictures = "fast" if data.get("pictures") == "fast" else "exact"
    moved = msgspec.convert(data.get("moved_cameras") or (), tuple[MovedCamera, ...])
    known = {"acted_by": acted_by, "pictures": pictures, "moved_cameras": moved, "seal": None}
    return EpisodeInfo(**{**data, **known})


def mark_recovered(header: Header) -> Header:
    return replace(header, info=replace(header.info, recovered=True))


def read_header(journal: JournalReader, visuals: tuple[Visual, ...]) -> Header | None:
    """Read the header; None if the journal ends before it.

    Raises:
        OSError: the journal cannot be read.
        ValueError: the header is invalid: written by a later version or another program.
    """
    for _, entries in journal:
        try:
            return header_from(entries[0].value.decode(), visuals)
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            why = f"this version cannot read {journal.path.name}: use a later one, or delete the file"
            raise ValueError(why) from error
    return None


@dataclass
class _CameraEntries:
    """A camera's entries in the journal."""

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
    """The journal's episode, with the scene of its whole batch; None if it has no state.

    The numbers of an hour are a hundred megabytes and are read at once, since both file formats need whole columns:
    length, types and static bodies are known only at the end. Pictures would not fit into memory, so they are read only
    when they are written to a file: keep the journal open until then. Raises OSError.
    """
    layouts: list[np.dtype] = []
    runs: list[tuple[int, list[bytes]]] = []
    """(number of a layout, consecutive rows of that layout)."""
    seen = [_CameraEntries() for _ in header.cameras]
    acted = list(header.info.acted_by)
    placed: list[MovedCamera] = []
    texts: list[tuple[int, bytes]] = []
    drawn: list[tuple[int, bytes]] = []
    for place, (kind, number, value) in _complete_states(journal):
        if kind == "row":
            if not runs or runs[-1][0] != number:
                runs.append((number, []))
            runs[-1][1].append(value)
        elif kind == "layout":
            layouts.append(layout_type(value.decode()))
        elif kind == "acted":
            acted.append((number, value.decode()))
        elif kind == "placed":
            placed.append(msgspec.json.decode(value, type=MovedCamera))
        elif kind == TEXT:
            texts.append((number, value))
        elif kind == DRAWING:
            drawn.append((number, value))
        elif kind.startswith("camera/"):
            camera = seen[int(kind[7:])]
            camera.frames.append(number)
            camera.poses.append(value)
        elif kind.startswith("picture/"):
            _, index, name = kind.split("/")
            seen[int(index)].places.setdefault(_modality(name), []).append(place)
        elif kind != "header":
            raise ValueError(f"{journal.path.name} holds an entry of an unknown kind ({kind[:40]!r})")
    if not runs:
        return None
    columns = assemble([np.frombuffer(b"".join(rows), layouts[layout]) for layout, rows in runs])

    def named(prefix: str) -> dict[str, NDArray]:
        return {name[len(prefix) :]: c for name, c in columns.items() if name.startswith(prefix)}

    return Episode(
        info=replace(header.info, acted_by=tuple(acted), moved_cameras=tuple(placed)),
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
        texts=text_tracks(texts),
        drawn=drawing_tracks(drawn),
    )


def _complete_states(journal: JournalReader) -> Iterator[tuple[tuple[int, int], JournalEntry]]:
    """(place, entry) of all entries of complete states; the row of each state comes last."""
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
    raise ValueError(f"{name} is not a modality")
