from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import viser.transforms

from tests.drive.panels import Panels
from tests.drive.scenes import camera
from workbench.cameras.frustums import CameraFrustums, PlacedFrustum, frustum_pose, without_the_viewpoint
from workbench.envs.camera_data import CameraKey, CameraKind, CameraSettings, Picture

POSE = np.array([1.0, 2.0, 3.0, 1.0, 0.0, 0.0, 0.0], np.float32)
GREY = np.full((6, 8, 3), 128, np.uint8)


def test_a_camera_that_looks_along_x_has_opencvs_z_along_x() -> None:
    wxyz, position = frustum_pose(POSE, np.array([10, 0, 0], np.float32))
    turn = viser.transforms.SO3(wxyz)
    np.testing.assert_allclose(turn.apply(np.array([0.0, 0.0, 1.0])), [1, 0, 0], atol=1e-9)
    np.testing.assert_allclose(turn.apply(np.array([0.0, 1.0, 0.0])), [0, 0, -1], atol=1e-9)
    np.testing.assert_allclose(position, [11, 2, 3])


def test_frustums_follow_their_pictures_and_are_removed_with_them(panels: Panels) -> None:
    frustums = CameraFrustums(panels.server)
    cameras = (camera("base"), camera("hand"))
    offset = np.zeros(3, np.float32)
    pictures: dict[tuple[CameraKind, str], Picture] = {
        ("sensor", name): Picture(name, "sensor", 0, POSE, GREY) for name in ("base", "hand")
    }
    frustums.draw(cameras, pictures, offset)
    assert len(panels.nodes("/cameras/")) == 2
    moved = Picture("base", "sensor", 0, POSE + [1, 0, 0, 0, 0, 0, 0], GREY)
    frustums.draw(cameras, {("sensor", "base"): moved}, offset)
    (base,) = panels.nodes("/cameras/")
    assert base.name == "/cameras/sensor base"
    np.testing.assert_allclose(base.position, [2, 2, 3])
    wider = replace(camera("base"), fovy=1.5, width=12)
    frustums.draw((wider,), {("sensor", "base"): moved}, offset)
    (base,) = panels.nodes("/cameras/")
    assert (base.fov, base.aspect) == (1.5, 2.0)
    frustums.draw((), {("sensor", "base"): moved}, offset)
    assert panels.nodes("/cameras/") == []


def test_a_click_selects_the_nearest_frustum_on_its_ray(panels: Panels) -> None:
    frustums = CameraFrustums(panels.server)
    behind = POSE + [0.3, 0, 0, 0, 0, 0, 0]
    pictures: dict[tuple[CameraKind, str], Picture] = {
        ("sensor", "base"): Picture("base", "sensor", 0, POSE, GREY),
        ("sensor", "hand"): Picture("hand", "sensor", 0, behind.astype(np.float32), GREY),
    }
    frustums.draw((camera("base"), camera("hand")), pictures, np.zeros(3, np.float32), size=0.1)
    along = np.array([1.0, 0.0, 0.0])
    # They look along x, one behind the other.
    assert frustums.under_ray(np.array([0.0, 2, 3]), along) == ("sensor", "base")
    assert frustums.under_ray(np.array([9.0, 2, 3]), -along) == ("sensor", "hand")
    assert frustums.under_ray(np.array([2.0, 2, 3]), along) is None, "both lie behind the ray's origin"
    assert frustums.under_ray(np.array([0.0, 2.2, 3]), along) is None
    # Just inside and just outside the edges that viser draws.
    frustums.draw(
        (camera("base"),), {("sensor", "base"): pictures["sensor", "base"]}, np.zeros(3, np.float32), size=0.1
    )
    (handle,) = panels.nodes("/cameras/")
    y = np.tan(handle.fov / 2)
    corner = np.array([y * handle.aspect, y, 1.0]) * 0.1 / np.cbrt(y * y * handle.aspect / 3)
    turn = viser.transforms.SO3(handle.wxyz)
    for sign in ([1, 1], [-1, 1], [1, -1], [-1, -1]):
        for share, met in ((0.99, ("sensor", "base")), (1.01, None)):
            aside = turn.apply(np.array([*(corner[:2] * sign * share), 0.0]))
            in_front = handle.position + aside + along * corner[2]
            assert frustums.under_ray(in_front + along, -along) == met


def test_a_placed_camera_is_drawn_where_it_is_placed_and_hidden_at_a_pages_viewpoint(panels: Panels) -> None:
    frustums, offset = CameraFrustums(panels.server), np.array([10.0, 0, 0], np.float32)
    pictures: dict[CameraKey, Picture] = {("sensor", "base"): Picture("base", "sensor", 0, POSE, GREY)}
    settings = CameraSettings((0, 0, 0), (1, 0, 0, 0), 0.5, None, 40, 10, 0.01, 10.0, "minimal")
    there = np.array([5.0, 6.0, 7.0, 1, 0, 0, 0])

    def drawn(**placed: PlacedFrustum) -> list[tuple[str, list[float], float, float, float]]:
        by_key: dict[CameraKey, PlacedFrustum] = {("sensor", name): one for name, one in placed.items()}
        frustums.draw((camera("base"), camera("hand")), pictures, offset, size=0.5, placed=by_key)
        nodes = panels.nodes("/cameras/")
        return [(one.name, one.position.tolist(), one.fov, one.aspect, one.thickness) for one in nodes]

    (name, position, fov, aspect, thin) = drawn()[0]
    assert (name, position, fov, aspect) == ("/cameras/sensor base", [11, 2, 3], 1.0, 8 / 6)
    ((_, position, fov, aspect, thick),) = drawn(base=PlacedFrustum(there, settings))
    assert position == [5, 6, 7] and fov == pytest.approx(0.5) and aspect == 4.0 and thick > thin
    assert [one[0] for one in drawn(hand=PlacedFrustum(there, settings))] == [
        "/cameras/sensor base",
        "/cameras/sensor hand",
    ], "without a picture too"
    assert drawn(base=PlacedFrustum(there, settings, hidden=True)) == []
    assert drawn(gone=PlacedFrustum(there, settings))[0][0] == "/cameras/sensor base"


def test_a_frustum_has_the_newest_picture_shrunk(panels: Panels) -> None:
    frustums = CameraFrustums(panels.server)
    for grey, size, shown in (
        (10, (300, 600), (75, 150)),
        (200, (100, 255), (100, 255)),
        (30, (256, 128), (128, 64)),
    ):
        picture = Picture("base", "sensor", 0, POSE, np.full((*size, 3), grey, np.uint8))
        frustums.draw((camera("base"),), {("sensor", "base"): picture}, np.zeros(3, np.float32))
        (node,) = panels.nodes("/cameras/")
        assert node.image.shape[:2] == shown and node.image.max() == grey


def test_cameras_at_the_viewpoint_of_a_single_env_are_left_out() -> None:
    def at(name: str, kind: CameraKind, x: float) -> tuple[CameraKey, Picture]:
        pose = POSE + np.array([x, 0, 0, 0, 0, 0, 0], np.float32)
        return (kind, name), Picture(name, kind, 0, pose, GREY)

    human = dict([at("people", "human", 0.0)])
    pictures = dict([at("base", "sensor", 0.1), at("hand", "sensor", 0.5), at("people", "human", 0.0)])
    assert [*without_the_viewpoint(pictures, human)] == [("sensor", "hand")]
    assert (
        without_the_viewpoint(pictures, {key: one for key, one in pictures.items() if key[0] == "sensor"})
        == pictures
    )
