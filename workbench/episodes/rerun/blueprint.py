"""The blueprint of an ``.rrd``: rerun's views, arranged like the workbench's page."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import rerun.blueprint as rrb

from workbench.envs.step_result import TERM_PREFIX
from workbench.episodes.episode import Episode, movable_bounds
from workbench.episodes.rerun.chunks import STEP
from workbench.episodes.rerun.drawings import DRAWINGS
from workbench.episodes.rerun.entities import (
    EVENTS,
    LOGS,
    WORLD,
    batch_entity,
    camera_entities,
    evaluate_entity,
)

MAX_SERIES = 32
"""Maximum number of curves of an ``evaluate()`` entry; an entry with more is not drawn, because it would hide
the other curves."""
MAX_STACKED = 3
"""Maximum number of stacked cameras; more cameras are in tabs, because each would be a narrow strip of the
stack."""
EYE_DIRECTION = (0.75, 0.85, 0.6)
"""Direction from the scene's centre to the eye, like ManiSkill's render cameras."""


@dataclass(frozen=True)
class Arrangement:
    """The inputs of an episode's blueprint, which most episodes of a scene share."""

    cameras: tuple[tuple[str, str, tuple[str, ...]], ...]
    """(name, entity, modalities) of each camera."""
    drawn: tuple[str, ...]
    """Entities of ``evaluate()`` that are drawn as curves."""
    texts: bool
    """Whether ``evaluate()`` returned texts."""
    drawings: bool
    """Whether the task drew anything."""
    acted: bool
    """Whether there are actions to draw."""
    fps: float | None
    eye: tuple[float, float, float]
    looked_at: tuple[float, float, float]


def arrangement(episode: Episode) -> Arrangement:
    cameras = episode.cameras
    entities = camera_entities([camera.info for camera in cameras])
    entries = [
        (evaluate_entity(name), column)
        for name, column in episode.evaluate.items()
        if not name.startswith(TERM_PREFIX)
    ]
    entries += [(batch_entity(name), column) for name, column in episode.batch.items()]
    drawn = (entity for entity, column in entries if 0 < math.prod(column.shape[1:]) <= MAX_SERIES)
    eye, looked_at = _eye(episode)
    return Arrangement(
        cameras=tuple(
            (camera.info.name, entity, tuple(camera.pictures)) for camera, entity in zip(cameras, entities)
        ),
        drawn=tuple(drawn),
        texts=bool(episode.texts),
        drawings=bool(episode.drawn),
        acted=bool(episode.action_names),
        fps=1.0 / episode.info.control_dt if episode.info.control_dt > 0 else None,
        eye=eye,
        looked_at=looked_at,
    )


def blueprint_of(arranged: Arrangement) -> rrb.Blueprint:
    """The scene on the left, cameras on the right, curves below.

    All views are explicit: rerun's automatic layout changes between releases and makes a view for every number.
    """
    scene = rrb.Spatial3DView(
        name="Scene",
        origin=WORLD,
        # Without depth and segmentation: in a 3-D view a depth picture is a point cloud over the meshes.
        contents=[
            "$origin/**",
            *([f"{DRAWINGS}/**"] if arranged.drawings else []),
            *(f"- {entity}/{m}" for _, entity, _ in arranged.cameras for m in ("depth", "segmentation")),
        ],
        eye_controls=rrb.EyeControls3D(
            kind=rrb.Eye3DKind.Orbital,
            position=arranged.eye,
            look_target=arranged.looked_at,
            eye_up=(0.0, 0.0, 1.0),
        ),
        line_grid=False,
    )
    top: rrb.ContainerLike = scene
    if arranged.cameras:
        top = rrb.Horizontal(scene, _cameras(arranged), column_shares=[3, 2])
    return rrb.Blueprint(
        rrb.Vertical(top, _curves(arranged), row_shares=[5, 2]),
        rrb.TimePanel(state="collapsed", timeline=STEP, fps=arranged.fps, play_state="paused"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        auto_views=False,
        auto_layout=False,
    )


def _cameras(arranged: Arrangement) -> rrb.ContainerLike:
    alone = len(arranged.cameras) == 1
    parts = [_camera(*camera, alone) for camera in arranged.cameras]
    if alone:
        return parts[0]
    return rrb.Vertical(*parts) if len(parts) <= MAX_STACKED else rrb.Tabs(*parts)


def _camera(name: str, entity: str, modalities: tuple[str, ...], alone: bool) -> rrb.ContainerLike:
    views = [
        rrb.Spatial2DView(name=f"{name} {m}", origin=entity, contents=[f"$origin/{m}"]) for m in modalities
    ]
    if len(views) == 1:
        return views[0]
    if alone:
        return rrb.Vertical(views[0], rrb.Horizontal(*views[1:]), row_shares=[3, 2], name=name)
    return rrb.Horizontal(views[0], rrb.Vertical(*views[1:]), column_shares=[2, 1], name=name)


def _curves(arranged: Arrangement) -> rrb.ContainerLike:
    views: list[rrb.View] = [rrb.TimeSeriesView(name="Reward", origin="/reward")]
    if arranged.drawn:
        views.append(rrb.TimeSeriesView(name="Evaluate", origin="/evaluate", contents=list(arranged.drawn)))
    if arranged.acted:
        views.append(rrb.TimeSeriesView(name="Action", origin="/action"))
    columns = rrb.TextLogColumns(text_log_columns=["loglevel", "body"])
    origin = LOGS if arranged.texts else EVENTS
    views.append(rrb.TextLogView(name="Events", origin=origin, columns=columns))
    return rrb.Horizontal(*views)


def _eye(episode: Episode) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """Eye and target that frame the movable bodies. By default rerun frames the whole scene, with 100 m of ground."""
    assert episode.poses is not None and episode.geometry is not None
    low, high = movable_bounds(episode.poses[0], episode.geometry.body_kinds)
    # Rounded, so that episodes of a scene share one cached blueprint.
    middle = np.round((low + high).astype(np.float64) / 2, 1)
    direction = np.array(EYE_DIRECTION) / np.linalg.norm(EYE_DIRECTION)
    distance = round(1.5 * max(float(np.linalg.norm(high - low)), 0.5), 1)
    eye = middle + distance * direction
    return (eye[0], eye[1], eye[2]), (middle[0], middle[1], middle[2])
