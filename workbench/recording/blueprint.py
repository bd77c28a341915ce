"""How a recording looks when it is opened: the same arrangement as the workbench's own page.

The scene is large on the left, what the cameras saw is on the right, and the curves lie below, all
moved by one slider over ``step``. Rerun can also arrange views by itself, but its rules change from
release to release and put one view on every number, so nothing is left to them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import rerun.blueprint as rrb

from workbench.recording.columns import BATCH
from workbench.recording.encoded_pictures import MODALITIES
from workbench.recording.layout import (
    EVENTS,
    LOGS,
    REWARD_TERMS,
    WORLD,
    batch_entity,
    camera_entities,
    evaluate_entity,
)
from workbench.recording.rerun_chunks import STEP
from workbench.recording.survey import Survey

MAX_SERIES = 32
"""An ``evaluate()`` entry with more numbers than this is kept, but not drawn: it hides the others."""
MAX_STACKED = 3
"""More cameras than this lie behind tabs: one above the other each would be a strip."""
EYE_DIRECTION = (0.75, 0.85, 0.6)
"""From where the scene is looked at, seen from its middle: ManiSkill's render cameras do likewise."""


@dataclass(frozen=True)
class Arrangement:
    """All that an episode's blueprint hangs on: most episodes of a scene share one."""

    cameras: tuple[tuple[str, str, tuple[str, ...]], ...]
    """Name, entity and modalities of each."""
    drawn: tuple[str, ...]
    """Entities of ``evaluate()`` that are curves."""
    texts: bool
    """Whether ``evaluate()`` returned texts."""
    acted: bool
    """Whether actions have names, and so curves."""
    fps: float | None
    eye: tuple[float, float, float]
    looked_at: tuple[float, float, float]


def arrangement(survey: Survey) -> Arrangement:
    cameras = survey.cameras
    entities = camera_entities([camera.info for camera in cameras])
    entries = [
        (evaluate_entity(name), column)
        for name, column in survey.evaluate().items()
        if not name.startswith(REWARD_TERMS)
    ]
    entries += [(batch_entity(name), column) for name, column in survey.named(BATCH).items()]
    drawn = (entity for entity, column in entries if 0 < math.prod(column.shape[1:]) <= MAX_SERIES)
    eye, looked_at = _eye(survey)
    return Arrangement(
        cameras=tuple(
            (camera.info.name, entity, tuple(m for m in MODALITIES if m in camera.modalities))
            for camera, entity in zip(cameras, entities)
        ),
        drawn=tuple(drawn),
        texts=bool(survey.texts),
        acted=bool(survey.header.action_names),
        fps=1.0 / survey.info.control_dt if survey.info.control_dt > 0 else None,
        eye=eye,
        looked_at=looked_at,
    )


def blueprint_of(arranged: Arrangement) -> rrb.Blueprint:
    scene = rrb.Spatial3DView(
        name="Scene",
        origin=WORLD,
        # A depth picture in a 3-D view is a cloud of points over the very meshes that it shows.
        contents=[
            "$origin/**",
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
    legend = rrb.PlotLegend(visible=True)
    views: list[rrb.View] = [rrb.TimeSeriesView(name="Reward", origin="/reward", plot_legend=legend)]
    if arranged.drawn:
        views.append(
            rrb.TimeSeriesView(
                name="Evaluate", origin="/evaluate", contents=list(arranged.drawn), plot_legend=legend
            )
        )
    if arranged.acted:
        views.append(rrb.TimeSeriesView(name="Action", origin="/action", plot_legend=legend))
    columns = rrb.TextLogColumns(text_log_columns=["loglevel", "body"])
    origin = LOGS if arranged.texts else EVENTS
    views.append(rrb.TextLogView(name="Events", origin=origin, columns=columns))
    return rrb.Horizontal(*views)


def _eye(survey: Survey) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """Where the eye is and what it looks at: what can move. By itself rerun frames the whole scene, and a ground plane is 100 m wide."""
    kinds = np.array(survey.header.geometry.body_kinds)
    points = survey.poses[0, np.isin(kinds, ("link", "dynamic")), :3]
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) == 0:
        points = np.zeros((1, 3), dtype=np.float32)
    low, high = points.min(axis=0), points.max(axis=0)
    # Of what differs by centimetres from episode to episode nothing hangs on, and the same blueprint is made once.
    middle = np.round((low + high).astype(np.float64) / 2, 1)
    direction = np.array(EYE_DIRECTION) / np.linalg.norm(EYE_DIRECTION)
    distance = round(1.5 * max(float(np.linalg.norm(high - low)), 0.5), 1)
    eye = middle + distance * direction
    return (eye[0], eye[1], eye[2]), (middle[0], middle[1], middle[2])
