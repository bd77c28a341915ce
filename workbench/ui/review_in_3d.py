"""Opened recordings in the 3-D view: their scene, marks and names, and where one looks from."""

from __future__ import annotations

import numpy as np
import viser

from workbench.core.camera_settings import CameraKey
from workbench.core.pictures import CameraInfo, Picture
from workbench.recording.episode import CameraTrack
from workbench.session.review import Review
from workbench.session.review_view import ReviewView
from workbench.ui.camera_frustums import SMALL, CameraFrustums, without_the_viewpoint
from workbench.ui.env_layout import acting_box, env_under_ray
from workbench.ui.ground_numbers import GroundNumbers
from workbench.ui.review_scene import ReviewScene, letter, review_scene
from workbench.ui.selection_mark import SelectionMark
from workbench.ui.stage import Stage
from workbench.ui.timeline_panel import HEIGHT as TIMELINE_HEIGHT
from workbench.ui.viewpoint import Viewpoint, frame_all, frame_one


class ReviewIn3D:
    """
    Args:
        server: The page.
        review: What is shown, and told which recording is clicked at.
        stage: The view that is drawn into.
    """

    def __init__(self, server: viser.ViserServer, review: Review, stage: Stage) -> None:
        self._review = review
        self.bodies, self._framing = stage.scene, stage.framing
        self._mark = SelectionMark(server)
        self._numbers = GroundNumbers(server)
        self._frustums = CameraFrustums(server)
        self._scene: ReviewScene | None = None
        self._scene_of: object = None
        self._triangles = 0
        """How many the bodies were built for."""
        server.scene.on_click()(self._on_click)

    def draw(
        self,
        view: ReviewView,
        ghosts: bool,
        triangles: int,
        cameras: tuple[CameraInfo, ...],
        pictures: dict[CameraKey, Picture],
    ) -> None:
        """
        Args:
            ghosts: Over each other, where there are several.
            triangles: About how many may be drawn.
            cameras: Of the selected recording.
            pictures: What is shown in their frustums.
        """
        wanted = (view.opened_serial, ghosts, len(view.opened))
        if wanted != self._scene_of:
            self._scene_of = wanted
            self._scene = review_scene(view.opened, ghosts)
            self._triangles = 0
        scene = self._scene
        if scene is None:
            self._draw_nothing(view)
            return
        if self._triangles != triangles:
            self._triangles = triangles
            self.bodies.build(scene.geometry, scene.layout, scene.poses(view.states), None, triangles)
        self.bodies.move(scene.poses(view.states), scene.layout, None)
        in_grid = len(view.opened) > 1 and not scene.ghosts
        self._mark.draw(scene.layout, view.selected, shown=in_grid, name=caption(view, view.selected))
        self._draw_names(view, scene if in_grid else None)
        self._draw_frustums(view, scene, cameras, pictures)
        self._frame_what_is_new(view, scene, in_grid)
        self._framing.frame_arrivals(self._viewpoint)

    def frame(self) -> None:
        """Point every open page, and those to come, at the scene."""
        if self._scene is not None:
            self._framing.frame(self._viewpoint)

    def _draw_nothing(self, view: ReviewView) -> None:
        self.bodies.clear()
        self._mark.clear()
        self._frustums.clear()
        self._draw_names(view, None)
        self._framing.is_new(None)

    def _frame_what_is_new(self, view: ReviewView, scene: ReviewScene, in_grid: bool) -> None:
        size = np.round(np.concatenate([scene.layout.low, scene.layout.high]), 0).tobytes()
        # As the live page has it: where the same is to be seen there, the view stays.
        task = view.opened[0].episode.info.task
        if self._framing.is_new((task, len(view.opened) if in_grid else 1, size)):
            self.frame()

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
        self._frustums.draw(cameras, pictures, scene.layout.offsets[view.selected], SMALL)

    def _draw_names(self, view: ReviewView, scene: ReviewScene | None) -> None:
        """The names of those that are not selected; the selected one's is on its frame."""
        if scene is None:
            self._numbers.clear()
            return
        names = ("" if index == view.selected else letter(index) for index in range(len(view.opened)))
        self._numbers.draw(scene.layout, tuple(names))

    def _viewpoint(self, aspect: float, height: float) -> Viewpoint:
        scene, view = self._scene, self._review.view()
        assert scene is not None, "asked only where a scene is drawn"
        covered = TIMELINE_HEIGHT / height
        if len(scene.layout.offsets) > 1 and not scene.ghosts:
            return frame_all(scene.layout, aspect, covered)
        human = human_camera(view)
        if human is not None:
            return frame_one(scene.layout, as_picture(human), aspect, covered, human.info.fovy)
        moments = [[int(part * one.length) for one in view.opened] for part in (0.0, 0.5, 1.0)]
        poses = np.concatenate([scene.poses(moment) for moment in moments])
        acting = acting_box(scene.geometry, poses, scene.layout)
        return frame_one(scene.layout, None, aspect, covered, acting=acting)

    def _on_click(self, event: viser.SceneClickEvent) -> None:
        scene, view = self._scene, self._review.view()
        if scene is None or scene.ghosts or len(view.opened) < 2:
            return
        index = env_under_ray(scene.layout, np.array(event.ray_origin), np.array(event.ray_direction))
        if index is not None:
            self._review.select(index)


def human_camera(view: ReviewView) -> CameraTrack | None:
    """The recordings' own camera for people: the selected one's, or of another where that has none."""
    chosen = view.chosen
    several = () if chosen is None else (chosen, *view.opened)
    tracks = (track for one in several for track in one.episode.cameras)
    return next((track for track in tracks if track.info.kind == "human" and len(track.pose)), None)


def as_picture(track: CameraTrack) -> Picture:
    """Where it stood at the start; the picture itself is not looked at."""
    return Picture(track.info.name, "human", 0, track.pose[0])


def caption(view: ReviewView, index: int) -> str:
    """The name of a recording in the view."""
    one = view.opened[index]
    seed = f", seed {one.episode.info.seed}" if one.episode.info.seed >= 0 else ""
    return f"{letter(index)}{seed}"
