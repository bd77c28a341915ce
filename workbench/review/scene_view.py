"""Draws open recordings as one scene in the 3-D view, overlaid or side by side."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
import viser
from numpy.typing import NDArray

from workbench.cameras.frustums import SMALL_METRES, CameraFrustums, without_the_viewpoint
from workbench.envs.camera_data import CameraInfo, CameraKey, Picture
from workbench.envs.scene.shapes import BodyKind, Material, SceneGeometry, Visual, fingerprint
from workbench.episodes.episode import CameraTrack
from workbench.machine.loop import post
from workbench.page.command import Refused
from workbench.page.scene.bodies import DrawStyle
from workbench.page.scene.body_pick import BodyMark, body_under_ray
from workbench.page.scene.env_grid import (
    EnvLayout,
    SelectionMark,
    acting_box,
    env_under_ray,
    lay_out,
    view_label,
)
from workbench.page.scene.frames import BodyFrames
from workbench.page.scene.task_drawings import TaskDrawingsView
from workbench.page.scene.viewpoint import View3D, Viewpoint, frame_all, frame_one
from workbench.page.widgets.templates import colour, letter
from workbench.review.commands import SelectRecording
from workbench.review.differences import distances
from workbench.review.playback import Review
from workbench.review.state import MAX_OVERLAID
from workbench.review.view import Opened, ReviewView

GHOST_ALPHA = 0.45
"""Alpha of a ghost. With a lower alpha it vanishes over a white table, with a higher one it hides the bodies
behind it."""
MAX_NAMED = 16
"""With more recordings than this side by side, only the selected one has a label. A browser lays out labels
in every frame: sixty labels halve its frame rate (measured)."""
MIN_GHOST_METRES = 5e-4
"""A ghost's body is drawn only if it is at least this far from the same body in the first recording."""
_SAME_PLACE_METRES = 1e-5


@dataclass(frozen=True, eq=False)
class ReviewScene:
    """The scene of several open recordings.

    Each recording is an env of one scene, and equal shapes are shared. When the recordings are overlaid, all
    but the first are ghosts: tinted and half transparent, and drawn only where they differ from the first. A
    ghost omits the bodies that rest for the whole time, at the same place as in the first recording.
    """

    geometry: SceneGeometry
    layout: EnvLayout
    ghosts: bool
    _poses: tuple[NDArray[np.float32], ...]
    """For each recording: (T + 1, B, 7) poses of its B bodies."""
    _bodies: tuple[NDArray[np.int64], ...]
    """Indices of each recording's bodies among all bodies."""

    def poses(self, states: Sequence[int]) -> NDArray[np.float32]:
        """(N, B, 7) poses of each recording at its state in `states`; NaN for bodies that a recording lacks,
        and for a ghost's bodies that are at the same place as in the first recording."""
        found = _side_by_side(self._poses, self._bodies, len(self.geometry.body_names), states)
        if self.ghosts:
            for ghost in found[1:]:
                # Two surfaces at the same place flicker.
                ghost[distances(found[0], ghost) < MIN_GHOST_METRES] = np.nan
        return found


def shown_together(view: ReviewView) -> tuple[int, ...]:
    """Indices of the recordings drawn together: all, or only the selected one if they are too many."""
    return tuple(range(len(view.opened))) if len(view.opened) <= MAX_OVERLAID else (view.selected,)


def review_scene(opened: Sequence[Opened], ghosts: bool) -> ReviewScene | None:
    """The scene of these recordings; None if none of them has one."""
    if not any(one.has_scene for one in opened):
        return None
    names: dict[str, BodyKind] = {}
    hidden: dict[str, bool] = {}
    for one in opened:
        if one.episode.geometry is not None:
            own = one.episode.geometry
            for name, kind, is_hidden in zip(own.body_names, own.body_kinds, own.body_hidden, strict=True):
                names.setdefault(name, kind)
                hidden.setdefault(name, is_hidden)
    rows = {name: row for row, name in enumerate(names)}
    poses, bodies = [], []
    shapes: dict[tuple[str, int, int], tuple[Visual, list[int]]] = {}
    known: dict[tuple[int, int, int], str] = {}
    first: Opened | None = None
    for index, one in enumerate(opened):
        geometry, track = one.episode.geometry, one.episode.poses
        if geometry is None or track is None:
            poses.append(np.zeros((one.length + 1, 0, 7), np.float32))
            bodies.append(np.zeros(0, np.int64))
            continue
        poses.append(track)
        bodies.append(np.array([rows[name] for name in geometry.body_names], np.int64))
        ghost = ghosts and first is not None
        left_out = bodies_at_rest(first, one) if ghost and first is not None else frozenset()
        first = first or one
        for visual in geometry.visuals:
            for body in visual.bodies:
                name = geometry.body_names[int(body)]
                if name in left_out:
                    continue
                shape = replace(visual, material=tinted(visual.material, colour(index))) if ghost else visual
                # Recordings share their shapes (`SharedShapes`), so the id identifies a shape.
                object_ = (id(visual.mesh), id(visual.material), index if ghost else -1)
                if object_ not in known:
                    known[object_] = fingerprint((shape,))
                looks = known[object_]
                number = 0
                # A shape that occurs twice on one body stays two visuals, as in the recording.
                while (looks, rows[name], number) in shapes and index in shapes[looks, rows[name], number][1]:
                    number += 1
                shapes.setdefault((looks, rows[name], number), (shape, []))[1].append(index)
    visuals = tuple(
        Visual(
            name=f"{visual.name} {number}",
            mesh=visual.mesh,
            material=visual.material,
            envs=np.array(envs, np.int32),
            bodies=np.full(len(envs), row, np.int32),
        )
        for number, ((_, row, _), (visual, envs)) in enumerate(shapes.items())
    )
    geometry = SceneGeometry(
        len(opened), tuple(names), tuple(names.values()), tuple(hidden.values()), visuals
    )
    layout = lay_out(geometry, _side_by_side(poses, bodies, len(names), [0] * len(opened)))
    if ghosts:
        layout = replace(layout, offsets=np.zeros_like(layout.offsets))
    return ReviewScene(geometry, layout, ghosts, tuple(poses), tuple(bodies))


def bodies_at_rest(first: Opened, other: Opened) -> frozenset[str]:
    """Bodies that rest for the whole time, at the same place in both recordings."""
    found = []
    a, b = first.episode, other.episode
    if a.geometry is None or b.geometry is None or a.poses is None or b.poses is None:
        return frozenset()
    places = {name: a.poses[:, row] for row, name in enumerate(a.geometry.body_names)}
    for row, name in enumerate(b.geometry.body_names):
        if name in places:
            here, there = places[name], b.poses[:, row]
            if np.all(np.abs(here - here[0]) < _SAME_PLACE_METRES) and np.all(
                np.abs(there - here[0]) < _SAME_PLACE_METRES
            ):
                found.append(name)
    return frozenset(found)


def tinted(material: Material, tone: str) -> Material:
    """The material tinted with the colour `tone` (``#rrggbb``), half transparent, without texture."""
    tint = np.array([int(tone[i : i + 2], 16) / 255 for i in (1, 3, 5)]) ** 2.2
    own = np.array(material.base_color[:3])
    red, green, blue = (float(c) for c in 0.75 * tint + 0.25 * own)
    return Material((red, green, blue, GHOST_ALPHA * material.base_color[3]), 0.0, 1.0)


def _side_by_side(
    poses: Sequence[NDArray[np.float32]],
    bodies: Sequence[NDArray[np.int64]],
    count: int,
    states: Sequence[int],
) -> NDArray[np.float32]:
    found = np.full((len(states), count, 7), np.nan, np.float32)
    for index, state in enumerate(states):
        if len(bodies[index]):
            found[index, bodies[index]] = poses[index][state]
    return found


class ReviewIn3D:
    """Draws the open recordings with marks, names and frustums.

    Args:
        server: The page.
        review: The review of the page; a click in the view selects one of its recordings.
        stage: The 3-D view.
        on_body: Called with the name of the body that was clicked; empty for none.
    """

    def __init__(
        self, server: viser.ViserServer, review: Review, stage: View3D, on_body: Callable[[str], None]
    ) -> None:
        self._review, self._on_body = review, on_body
        self.bodies, self._framing, self._in_software = stage.scene, stage.framing, stage.in_software
        self._mark, self._body_mark = SelectionMark(server), BodyMark(server)
        self._names = [view_label(server, f"/names {index}", "top-center") for index in range(MAX_NAMED)]
        self._choice = stage.choice
        self._frames, self._frustums = BodyFrames(server), CameraFrustums(server)
        self._drawn = TaskDrawingsView(server)
        self._scene: ReviewScene | None = None
        self._view = ReviewView()
        """View that was drawn last. The review's present view may have other recordings."""
        self._scene_of: object = None
        self._looks: DrawStyle | None = None
        """Style with which the bodies were built."""
        # viser awaits coroutines, although its types do not say so.
        server.scene.on_click()(self._on_click)  # type: ignore[arg-type]

    def draw(
        self,
        view: ReviewView,
        ghosts: bool,
        looks: DrawStyle,
        cameras: tuple[CameraInfo, ...],
        pictures: dict[CameraKey, Picture],
        body: str,
    ) -> None:
        """Draw the present states.

        Args:
            ghosts: Whether to overlay the recordings, if there are several.
            looks: Style of the bodies.
            cameras: Cameras of the selected recording.
            pictures: Pictures to draw in the frustums of the cameras.
            body: Name of the selected body; empty for none.
        """
        wanted = (view.opened_serial, ghosts, len(view.opened))
        if wanted != self._scene_of:
            self._scene_of = wanted
            self._scene = review_scene(view.opened, ghosts)
            self._looks = None
        scene, self._view = self._scene, view
        if scene is None:
            self._draw_nothing(view)
            return
        looks = self._in_software.looks(looks, scene.geometry, scene.layout, alone=False)
        if self._looks != looks:
            self._looks = looks
            self.bodies.build(scene.geometry, scene.layout, scene.poses(view.states), None, looks)
        poses = scene.poses(view.states)
        self.bodies.move(poses, scene.layout, None)
        in_grid = len(view.opened) > 1 and not scene.ghosts
        index = solid_recording(view, scene)
        selected = scene.geometry, poses, index, body, scene.layout.offsets[index]
        self._body_mark.draw(*selected)
        if self._choice.frames:
            self._frames.draw(*selected)
        else:
            self._frames.clear()
        self._mark.draw(scene.layout, view.selected, shown=in_grid, name=caption(view, view.selected))
        self._draw_names(view, scene if in_grid else None)
        self._draw_frustums(view, scene, cameras, pictures)
        drawn = view.opened[view.selected].episode.drawings_at(view.states[view.selected])
        self._drawn.draw(drawn, 0, scene.layout.offsets[view.selected])
        self._frame_what_is_new(view, scene, in_grid)
        self._framing.frame_untouched(self._viewpoint)

    def frame(self) -> None:
        """Frame the scene in every open page and in pages opened later."""
        if self._scene is not None:
            self._framing.frame(self._viewpoint)

    def _draw_nothing(self, view: ReviewView) -> None:
        self.bodies.clear()
        self._mark.clear()
        self._body_mark.clear()
        self._frames.clear()
        self._frustums.clear()
        self._drawn.draw({}, 0, np.zeros(3))
        self._draw_names(view, None)
        self._framing.is_new(None)

    def _frame_what_is_new(self, view: ReviewView, scene: ReviewScene, in_grid: bool) -> None:
        size = np.round(np.concatenate([scene.layout.low, scene.layout.high]), 0).tobytes()
        # The live page uses the same key, so a switch between the review and the live page of the same task
        # keeps the view.
        task = view.opened[0].episode.info.task
        if self._framing.is_new((task, len(view.opened) if in_grid else 1, size)):
            self._framing.frame_new(self._viewpoint)

    def _draw_frustums(
        self,
        view: ReviewView,
        scene: ReviewScene,
        cameras: tuple[CameraInfo, ...],
        pictures: dict[CameraKey, Picture],
    ) -> None:
        if len(view.opened) == 1 or scene.ghosts:
            human = human_camera(view)
            there = None if human is None else as_picture(human)
            pictures = without_the_viewpoint(
                pictures, {} if there is None else {("human", there.camera): there}
            )
        self._frustums.draw(cameras, pictures, scene.layout.offsets[view.selected], SMALL_METRES)

    def _draw_names(self, view: ReviewView, scene: ReviewScene | None) -> None:
        """Label the recordings that are not selected, if at most `MAX_NAMED` are open. The selected one's
        label is on its frame."""
        few = scene is not None and len(view.opened) <= MAX_NAMED
        for index, label in enumerate(self._names):
            if scene is None or not few or index >= len(view.opened) or index == view.selected:
                label.draw()
            else:
                layout = scene.layout
                front = np.array([layout.high[0], (layout.low[1] + layout.high[1]) / 2, layout.floor_height])
                label.draw(letter(index), front + layout.offsets[index])

    def _viewpoint(self, aspect: float) -> Viewpoint:
        scene, view = self._scene, self._view
        assert scene is not None, "asked only where a scene is drawn"
        if len(scene.layout.offsets) > 1 and not scene.ghosts:
            return frame_all(scene.layout, aspect)
        human = human_camera(view)
        if human is not None:
            return frame_one(scene.layout, as_picture(human), aspect, human.info.fovy)
        moments = [[int(part * one.length) for one in view.opened] for part in (0.0, 0.5, 1.0)]
        poses = np.concatenate([scene.poses(moment) for moment in moments])
        acting = acting_box(scene.geometry, poses, scene.layout)
        return frame_one(scene.layout, None, aspect, acting=acting)

    async def _on_click(self, event: viser.SceneClickEvent) -> None:
        post(lambda: self._clicked(event))

    def _clicked(self, event: viser.SceneClickEvent) -> None:
        scene, view = self._scene, self._view
        if scene is None:
            return
        origin, direction = np.array(event.ray_origin), np.array(event.ray_direction)
        index: int | None = solid_recording(view, scene)
        if not scene.ghosts and len(view.opened) > 1:
            index = env_under_ray(scene.layout, origin, direction)
            if index is None or index >= len(view.opened):
                return
            with suppress(Refused):  # the recording was closed after the view was drawn
                self._review.do(SelectRecording(id=view.opened[index].id))
        poses = scene.poses(view.states)
        body = body_under_ray(scene.geometry, poses, index, origin - scene.layout.offsets[index], direction)
        self._on_body("" if body is None else scene.geometry.body_names[body])


def solid_recording(view: ReviewView, scene: ReviewScene) -> int:
    """Index of the recording whose bodies a click selects: the first if the recordings are overlaid, since
    all others are ghosts; else the selected one."""
    return 0 if scene.ghosts else view.selected


def human_camera(view: ReviewView) -> CameraTrack | None:
    """The human camera of the selected recording; if it has none, that of another open recording, or None."""
    chosen = view.chosen
    several = () if chosen is None else (chosen, *view.opened)
    tracks = (track for one in several for track in one.episode.cameras)
    return next((track for track in tracks if track.info.kind == "human" and len(track.pose)), None)


def as_picture(track: CameraTrack) -> Picture:
    """A picture without pixels, with the camera's initial pose."""
    return Picture(track.info.name, "human", 0, track.pose[0])


def caption(view: ReviewView, index: int) -> str:
    """Label of a recording in the view."""
    one = view.opened[index]
    seed = f", seed {one.episode.info.seed}" if one.episode.info.seed >= 0 else ""
    return f"{letter(index)}{seed}"
