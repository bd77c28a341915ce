"""Several recordings in one scene: as ghosts and side by side."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tests.drive.episodes import BODY, geometry_of, made, poses_of
from tests.drive.scenes import camera
from workbench.envs.camera_data import CameraKind
from workbench.episodes.episode import CameraTrack, Episode
from workbench.page.scene.glb import group_visuals
from workbench.review.scene_view import (
    GHOST_ALPHA,
    bodies_at_rest,
    caption,
    human_camera,
    review_scene,
    shown_together,
    solid_recording,
)
from workbench.review.view import Opened, ReviewView, find_events


def opened(*episodes: Episode) -> tuple[Opened, ...]:
    return tuple(Opened(str(i), str(i), e, find_events(e)) for i, e in enumerate(episodes))


def test_side_by_side_recordings_share_shapes_and_are_placed_apart() -> None:
    scene = review_scene(opened(made(10), made(4, speed=0.02)), ghosts=False)
    assert scene is not None
    assert len(group_visuals(scene.geometry)) == 4, "visuals with equal shapes share one node"
    assert all(len(visual.envs) == 2 for visual in scene.geometry.visuals)
    assert not np.allclose(scene.layout.offsets[0], scene.layout.offsets[1])
    poses = scene.poses((7, 3))
    assert np.allclose(poses[:, BODY["cube"], 0], (0.07, 0.06))


def test_a_ghost_is_tinted_and_drawn_only_where_it_differs() -> None:
    a, b = made(10), made(10)
    poses_of(b)[5:, BODY["cube"], 1] += 0.1
    scene = review_scene(opened(a, b), ghosts=True)
    assert scene is not None and not scene.layout.offsets.any()
    ghosts = {int(v.bodies[0]): v.material for v in scene.geometry.visuals if 1 in v.envs}
    assert set(ghosts) == {BODY["cube"]}, "bodies at rest at the same pose are drawn once"
    assert ghosts[BODY["cube"]].base_color[3] == GHOST_ALPHA
    assert np.isnan(scene.poses((4, 4))[1]).all(), "no ghost is drawn while the poses are equal"
    apart = scene.poses((6, 6))[1]
    assert np.isfinite(apart[BODY["cube"]]).all() and np.isnan(apart[BODY["arm/hand"]]).all()


def test_recordings_with_different_bodies_or_without_a_scene() -> None:
    a, b, c = made(3), made(3), made(3)
    b.geometry = replace(geometry_of(b), body_names=("ground", "table", "arm/hand", "box"))
    c.geometry = c.poses = None
    scene = review_scene(opened(a, b, c), ghosts=False)
    assert scene is not None
    names = scene.geometry.body_names
    assert names == ("ground", "table", "arm/hand", "cube", "box")
    poses = scene.poses((0, 0, 0))
    assert np.isnan(poses[0, 4]).all() and np.isnan(poses[1, 3]).all() and np.isnan(poses[2]).all()
    assert review_scene(opened(c), ghosts=True) is None


def test_what_stands_still_at_the_same_place_is_no_ghost() -> None:
    a, b = opened(made(6), made(4, speed=0.02))
    assert bodies_at_rest(a, b) == {"ground", "table", "arm/hand"}
    poses_of(b.episode)[3, BODY["arm/hand"], 2] += 0.01
    poses_of(b.episode)[:, BODY["table"], 0] += 0.01
    assert bodies_at_rest(a, b) == {"ground"} == bodies_at_rest(b, a)


def test_few_recordings_are_drawn_together_and_a_click_is_on_the_solid_one() -> None:
    def view(count: int, selected: int) -> ReviewView:
        return ReviewView(opened=opened(*(made(2, seed=at - 1) for at in range(count))), selected=selected)

    assert shown_together(view(4, 2)) == (0, 1, 2, 3) and shown_together(view(5, 2)) == (2,)
    three = view(3, 2)
    for ghosts, solid in ((True, 0), (False, 2)):
        scene = review_scene(three.opened, ghosts)
        assert scene is not None and solid_recording(three, scene) == solid
    assert [caption(three, at)[0] for at in range(3)] == ["A", "B", "C"]
    assert "seed" not in caption(three, 0) and "seed 1" in caption(three, 2)


def test_the_viewpoint_is_that_of_the_selected_recordings_human_camera() -> None:
    def seen(name: str, kind: CameraKind, pictures: int = 1) -> CameraTrack:
        return CameraTrack(camera(name, kind), np.arange(pictures), np.zeros((pictures, 7), np.float32))

    a, b, c = opened(made(2), made(2), made(2))
    a.episode.cameras = [seen("base", "sensor"), seen("render", "human")]
    b.episode.cameras = [seen("other", "human", 0), seen("other", "human")]
    view = ReviewView(opened=(a, b, c))
    for selected, track in ((0, a.episode.cameras[1]), (1, b.episode.cameras[1]), (2, a.episode.cameras[1])):
        assert human_camera(replace(view, selected=selected)) is track
    assert human_camera(ReviewView(opened=(c,))) is None and human_camera(ReviewView()) is None
