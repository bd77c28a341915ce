"""Lays out what a task drew as rerun entities, and reads it back.

Each drawing is the entity ``/drawings/<kind>/<name>``, in the frame of ``/world``: points and texts ``Points3D``, lines
``LineStrips3D``, arrows ``Arrows3D``; frames are ``LineStrips3D`` of three axes each, with their poses (position and
quaternion wxyz) in the component ``poses``. A row is written where the drawing changes; a row without items draws nothing.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray
from rerun.chunk import Chunk
from transforms3d.quaternions import qmult

from workbench.envs.task_drawings import ITEM_SHAPES, Drawing, DrawingKind
from workbench.episodes.drawings import DrawingKey, DrawingTrack
from workbench.episodes.rerun.chunks import TimedChunks, lists_column, static_chunk
from workbench.episodes.rerun.read import RerunTable

DRAWINGS = "/drawings"
_RADIUS_PER_SIZE: dict[DrawingKind, float] = {"points": 1 / 2, "arrows": 1 / 4, "frames": 1 / 30}
_LINE_RADIUS = -1.0
"""Radius of lines and texts, which have no size in metres. Negative numbers are pixels to rerun."""
_ARCHETYPES: dict[DrawingKind, str] = {
    "points": "Points3D",
    "text": "Points3D",
    "lines": "LineStrips3D",
    "frames": "LineStrips3D",
    "arrows": "Arrows3D",
}
_POSES = "poses"
_AXIS_COLORS = ((255, 0, 0), (0, 255, 0), (0, 0, 255))


def drawing_entity(key: DrawingKey) -> str:
    name, kind = key
    return rr.new_entity_path(["drawings", kind, name])


def drawing_chunks(tracks: Iterable[DrawingTrack], timed: TimedChunks) -> Iterator[Chunk]:
    """The chunks of an episode's drawings."""
    for track in tracks:
        entity = drawing_entity(track.key)
        if track.kind == "frames":
            most = int(np.diff(track.begins).max())
            yield static_chunk(entity, rr.LineStrips3D.from_fields(colors=_AXIS_COLORS * most))
        if track.kind == "text":
            yield static_chunk(entity, rr.Points3D.from_fields(show_labels=True))
        yield timed.of(entity, track.states, _columns(track))


def _columns(track: DrawingTrack) -> list[Any]:
    counts, data = np.diff(track.begins), track.data
    scale = _RADIUS_PER_SIZE.get(track.kind)
    radii = (
        np.full(len(counts), _LINE_RADIUS, np.float32) if scale is None else track.sizes * np.float32(scale)
    )
    match track.kind:
        case "points":
            items = rr.Points3D.columns(positions=data).partition(counts)
            looks = rr.Points3D.columns(colors=track.colors, radii=radii)
        case "text":
            labels = [text or track.name for text in track.texts]
            items = rr.Points3D.columns(positions=data).partition(counts)
            looks = rr.Points3D.columns(colors=track.colors, radii=radii, labels=labels)
        case "lines":
            items = rr.LineStrips3D.columns(strips=data).partition(counts)
            looks = rr.LineStrips3D.columns(colors=track.colors, radii=radii)
        case "arrows":
            vectors = data[:, 1] - data[:, 0]
            items = rr.Arrows3D.columns(origins=data[:, 0], vectors=vectors).partition(counts)
            looks = rr.Arrows3D.columns(colors=track.colors, radii=radii)
        case "frames":
            strips = _axes(data, np.repeat(track.sizes, counts))
            items = rr.LineStrips3D.columns(strips=strips).partition(3 * counts)
            looks = [*rr.LineStrips3D.columns(radii=radii), lists_column(_POSES, data.ravel(), 7 * counts)]
    return [*items, *looks]


def _axes(poses: NDArray[np.float32], lengths: NDArray[np.float32]) -> NDArray[np.float32]:
    """(3 I, 2, 3) start and end of the x, y and z axis of each pose (I, 7)."""
    turn = poses[:, 3:].astype(np.float64)
    turn = (turn / np.maximum(np.linalg.norm(turn, axis=1, keepdims=True), 1e-12)).T
    back = turn * np.array([[1], [-1], [-1], [-1]])
    turned = [qmult(qmult(turn, (0, *axis)), back)[1:].T for axis in np.eye(3)]
    starts = np.repeat(poses[:, None, :3], 3, axis=1)
    ends = starts + lengths[:, None, None] * np.stack(turned, axis=1)
    return np.stack([starts, ends], axis=2).reshape(-1, 2, 3).astype(np.float32)


def read_drawings(table: RerunTable, keys: Sequence[DrawingKey]) -> Iterator[DrawingTrack]:
    """The drawings with these keys, unchecked (`drawings.wrong_drawings`). Raises ValueError."""
    for name, kind in keys:
        rows = partial(table.lists, drawing_entity((name, kind)))
        of = _ARCHETYPES[kind]
        match kind:
            case "points" | "text":
                states, begins, flat = rows(f"{of}:positions")
            case "lines":
                states, begins, flat = rows(f"{of}:strips")
            case "arrows":
                states, begins, starts = rows(f"{of}:origins")
                vectors = rows(f"{of}:vectors")[2]
                flat = np.stack([part.reshape(-1, 3) for part in (starts, starts + vectors)], axis=1)
            case "frames":
                states, begins, flat = rows(_POSES)
                begins = begins // 7
        colors = np.tile(np.array(Drawing.color, np.uint8), (len(states), 1))
        if kind != "frames":
            rgba = rows(f"{of}:colors")[2].astype(">u4")
            colors = rgba.view(np.uint8).reshape(-1, 4)[:, :3].copy()
        radii, scale = rows(f"{of}:radii")[2].astype(np.float32), _RADIUS_PER_SIZE.get(kind)
        yield DrawingTrack(
            name,
            kind,
            states,
            begins,
            flat.astype(np.float32).reshape(-1, *ITEM_SHAPES[kind]),
            colors,
            np.zeros_like(radii) if scale is None else radii / np.float32(scale),
            tuple(map(str, rows(f"{of}:labels")[2])) if kind == "text" else (),
        )
