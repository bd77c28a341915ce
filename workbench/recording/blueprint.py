"""How a recording looks when it is opened: the same arrangement as the workbench's own page.

The scene is large on the left, what the cameras saw is on the right, and the curves lie below, all
moved by one slider over ``step``. Rerun can also arrange views by itself, but its rules change from
release to release and put one view on every number, so nothing is left to them.
"""

from __future__ import annotations

import math

import numpy as np
import rerun.blueprint as rrb

from workbench.recording.layout import (
    EVENTS,
    REWARD_TERMS,
    WORLD,
    camera_entities,
    evaluate_entity,
)
from workbench.recording.rerun_log import STEP
from workbench.recording.survey import CameraSurvey, Survey

MAX_SERIES = 32
"""An ``evaluate()`` entry with more numbers than this is kept, but not drawn: it hides the others."""
MAX_STACKED = 3
"""More cameras than this lie behind tabs: one above the other each would be a strip."""
EYE_DIRECTION = (0.75, 0.85, 0.6)
"""From where the scene is looked at, seen from its middle: ManiSkill's render cameras do likewise."""


def episode_blueprint(survey: Survey) -> rrb.Blueprint:
    cameras = camera_entities([camera.info for camera in survey.cameras])
    scene = rrb.Spatial3DView(
        name="Scene",
        origin=WORLD,
        # A depth picture in a 3-D view is a cloud of points over the very meshes that it shows.
        contents=[
            "$origin/**",
            *(f"- {camera}/{m}" for camera in cameras for m in ("depth", "segmentation")),
        ],
        eye_controls=_eye(survey),
        line_grid=False,
    )
    top: rrb.ContainerLike = scene
    if survey.cameras:
        top = rrb.Horizontal(scene, _cameras(survey), column_shares=[3, 2])
    return rrb.Blueprint(
        rrb.Vertical(top, _curves(survey), row_shares=[5, 2]),
        rrb.TimePanel(
            state="collapsed",
            timeline=STEP,
            fps=1.0 / survey.info.control_dt if survey.info.control_dt > 0 else None,
            play_state="paused",
        ),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        auto_views=False,
        auto_layout=False,
    )


def _cameras(survey: Survey) -> rrb.ContainerLike:
    alone = len(survey.cameras) == 1
    parts = [
        _camera(*pair, alone)
        for pair in zip(survey.cameras, camera_entities([camera.info for camera in survey.cameras]))
    ]
    if alone:
        return parts[0]
    return rrb.Vertical(*parts) if len(parts) <= MAX_STACKED else rrb.Tabs(*parts)


def _camera(camera: CameraSurvey, entity: str, alone: bool) -> rrb.ContainerLike:
    views = [
        rrb.Spatial2DView(name=f"{camera.info.name} {m}", origin=entity, contents=[f"$origin/{m}"])
        for m in ("rgb", "depth", "segmentation")
        if m in camera.modalities
    ]
    name = camera.info.name
    if len(views) == 1:
        return views[0]
    if alone:
        return rrb.Vertical(views[0], rrb.Horizontal(*views[1:]), row_shares=[3, 2], name=name)
    return rrb.Horizontal(views[0], rrb.Vertical(*views[1:]), column_shares=[2, 1], name=name)


def _curves(survey: Survey) -> rrb.ContainerLike:
    drawn = [
        evaluate_entity(name)
        for name, column in survey.evaluate().items()
        if 0 < math.prod(column.shape) <= MAX_SERIES and not name.startswith(REWARD_TERMS)
    ]
    legend = rrb.PlotLegend(visible=True)
    views: list[rrb.View] = [rrb.TimeSeriesView(name="Reward", origin="/reward", plot_legend=legend)]
    if drawn:
        views.append(
            rrb.TimeSeriesView(name="Evaluate", origin="/evaluate", contents=drawn, plot_legend=legend)
        )
    if survey.header.action_names:
        views.append(rrb.TimeSeriesView(name="Action", origin="/action", plot_legend=legend))
    columns = rrb.TextLogColumns(text_log_columns=["loglevel", "body"])
    views.append(rrb.TextLogView(name="Events", origin=EVENTS, columns=columns))
    return rrb.Horizontal(*views)


def _eye(survey: Survey) -> rrb.EyeControls3D:
    """Look at what can move. By itself rerun frames the whole scene, and a ground plane is 100 m wide."""
    kinds = np.array(survey.header.geometry.body_kinds)
    points = survey.first_poses[np.isin(kinds, ("link", "dynamic")), :3]
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) == 0:
        points = np.zeros((1, 3), dtype=np.float32)
    low, high = points.min(axis=0), points.max(axis=0)
    middle = (low + high) / 2
    direction = np.array(EYE_DIRECTION) / np.linalg.norm(EYE_DIRECTION)
    distance = 1.5 * max(float(np.linalg.norm(high - low)), 0.5)
    return rrb.EyeControls3D(
        kind=rrb.Eye3DKind.Orbital,
        position=middle + distance * direction,
        look_target=middle,
        eye_up=(0.0, 0.0, 1.0),
    )
