"""The chosen camera's number fields."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from tests.drive.panels import Panels
from tests.drive.scenes import camera
from workbench.app.session import Session
from workbench.cameras.commands import ChooseShader
from workbench.cameras.events import CameraChosen
from workbench.cameras.number_fields import AXES, FOV, INTRINSIC, RPY, WXYZ, CameraNumbers
from workbench.cameras.pose_math import Placing
from workbench.cameras.view import StudioView
from workbench.envs.camera_data import CameraSettings, differences
from workbench.pictures.camera_conventions import (
    LookAt,
    axes_of,
    intrinsic_of,
    matrix3,
    pose_from_look_at,
    rpy_of,
    target_of,
    with_pose,
)

pytestmark = pytest.mark.thorough

EYE, TARGET = (0.45123456, 0.0, 0.61), (0.08, 0.0, 0.2)
LENS = CameraSettings((0, 0, 0), (1, 0, 0, 0), 1.0123456, None, 128, 96, 0.0123456, 10.0, "minimal")
FILE = replace(with_pose(LENS, pose_from_look_at(LookAt(EYE, TARGET))), distance=math.dist(EYE, TARGET))
MATRIX = replace(FILE, fov=None, intrinsic=((100.123, 0.0, 64.0), (0.0, 90.0, 48.0), (0.0, 0.0, 1.0)))


@dataclass
class Desk:
    session: Session
    numbers: CameraNumbers
    panels: Panels
    two_handles: list[bool]

    @property
    def now(self) -> CameraSettings:
        camera = self.session.view().of(StudioView).chosen
        assert camera is not None and camera.now is not None
        return camera.now

    def draw(self) -> None:
        self.numbers.draw(self.session.view().of(StudioView).placeable)

    def types(self, label: str, value: object, at: int = 0) -> CameraSettings:
        """Type or choose `value`; `at` is the index in a row of fields. Returns the settings after it."""
        self.draw()
        if isinstance(value, str):
            self.panels.set(label, value)
        else:
            self.panels.type(label, value, at)
        self.draw()
        return self.now


@pytest.fixture
def desk(scripted_session: Callable[..., Session], panels: Panels, request: pytest.FixtureRequest) -> Desk:
    info = replace(camera(), settings=request.param)
    session, two_handles = scripted_session(1, camera=info), [False]
    session.dispatch(CameraChosen(info.key))
    numbers = CameraNumbers(panels.server, Placing(session), look_at=lambda: two_handles[0])
    panels.visitors.do = numbers.do
    desk = Desk(session, numbers, panels, two_handles)
    desk.draw()
    return desk


def shown(desk: Desk, label: str) -> Any:
    return desk.panels.field(label).value


with_a_fov, with_a_matrix = (
    pytest.mark.parametrize("desk", [settings], indirect=True, ids=[name])
    for settings, name in ((FILE, "fov"), (MATRIX, "matrix"))
)


@with_a_fov
def test_all_settings_are_shown_with_one_form_of_lens_and_orientation(desk: Desk) -> None:
    fields = {
        label: shown(desk, label)
        for label in (
            "Position",
            "Looks at",
            "Degrees",
            "Vertical fov",
            "Radians",
            "Width, height",
            "Near, far",
        )
    }
    assert fields == {
        "Position": (0.4512, 0.0, 0.61),
        "Looks at": (0.08, 0.0, 0.2),
        "Degrees": pytest.approx((0.0, 47.84, 180.0)),
        "Vertical fov": 58.0,
        "Radians": 1.0123,
        "Width, height": (128, 96),
        "Near, far": (0.0123, 10.0),
    }
    assert shown(desk, "Lens as") == FOV and shown(desk, "Shader") == "minimal"
    assert not any(desk.panels.shows(label) for label in ("fx, fy", "cx, cy", "w x y z", "Forward", "Up"))
    desk.panels.set("Written as", WXYZ)
    desk.draw()
    assert desk.panels.shows("w x y z") and not desk.panels.shows("Degrees")
    assert [float(word) for word in shown(desk, "w x y z").split()] == pytest.approx(
        FILE.quaternion, abs=1e-6
    )
    desk.panels.set("Written as", AXES)
    desk.draw()
    forward, left, up = axes_of(FILE.quaternion)
    assert shown(desk, "Forward") == pytest.approx(forward, abs=1e-4)
    assert shown(desk, "Up") == pytest.approx(up, abs=1e-4)
    assert f"{left[1]:.4f}" in desk.panels.html("Left:")
    desk.numbers.draw(None)
    assert not desk.panels.shows("Position") and not desk.panels.shows("Lens as")


@with_a_fov
def test_a_typed_number_is_set_and_the_others_stay_exact(desk: Desk) -> None:
    now = desk.types("Position", 0.1, at=1)
    assert now == replace(FILE, position=(EYE[0], 0.1, EYE[2]))
    assert now.distance == FILE.distance, "the target must move along"
    desk.types("Looks at", 0.0)
    desk.types("Looks at", 0.1, at=1)
    now = desk.types("Looks at", 0.3, at=2)
    assert now.position == (EYE[0], 0.1, EYE[2])
    np.testing.assert_allclose(target_of(now), (0.0, 0.1, 0.3), atol=1e-9)
    turned = rpy_of(now.quaternion)
    now = desk.types("Degrees", 90.0, at=2)
    np.testing.assert_allclose(rpy_of(now.quaternion), (*turned[:2], 90.0), atol=1e-9)
    desk.types("Width, height", 64)
    now = desk.types("Width, height", 48, at=1)
    assert (now.width, now.height, now.fov) == (64, 48, FILE.fov)
    assert desk.types("Near, far", 5.0, at=1).near == FILE.near and desk.now.far == 5.0
    assert desk.types("Vertical fov", 90.0).fov == pytest.approx(math.pi / 2)
    assert desk.types("Radians", 1.1).fov == 1.1
    assert desk.types("Shader", "default").shader_pack == "default"
    assert not desk.panels.client.notices


@with_a_fov
def test_typing_an_eye_keeps_the_target(desk: Desk) -> None:
    desk.two_handles[0] = True
    now = desk.types("Eye", 0.7, at=2)
    assert now.position == (EYE[0], EYE[1], 0.7) and not desk.panels.shows("Position")
    np.testing.assert_allclose(target_of(now), TARGET, atol=1e-9)
    now = desk.types("Target", 0.3)
    np.testing.assert_allclose(target_of(now), (0.3, *TARGET[1:]), atol=1e-9)
    assert desk.panels.field("Target").value == (0.3, 0.0, 0.2)


@with_a_fov
def test_an_orientation_can_be_typed_as_a_quaternion_or_axes(desk: Desk) -> None:
    desk.panels.set("Written as", WXYZ)
    assert desk.types("w x y z", "[0.5, 0.5, 0.5, 0.5]").quaternion == (0.5, 0.5, 0.5, 0.5)
    desk.panels.set("Written as", AXES)
    desk.types("Forward", -0.75, at=2)
    forward, _, up = axes_of(desk.now.quaternion)
    np.testing.assert_allclose(forward, (0.0, 0.8, -0.6), atol=1e-9)
    np.testing.assert_allclose(up, (1.0, 0.0, 0.0), atol=1e-9)
    desk.types("Up", -1.0)
    desk.types("Up", 0.6, at=1)
    desk.types("Up", 0.0)
    forward, _, up = axes_of(desk.now.quaternion)
    np.testing.assert_allclose([forward, up], [(0.0, 0.8, -0.6), (0.0, 0.6, 0.8)], atol=1e-9)
    desk.panels.set("Written as", RPY)
    desk.draw()
    assert desk.panels.shows("Degrees")


@with_a_matrix
def test_an_intrinsic_matrix_is_typed_in_pixels_and_scales_with_the_size(desk: Desk) -> None:
    assert shown(desk, "Lens as") == INTRINSIC and not desk.panels.shows("Vertical fov")
    assert shown(desk, "fx, fy") == (100.12, 90.0) and shown(desk, "cx, cy") == (64.0, 48.0)
    now = desk.types("fx, fy", 95.0, at=1)
    assert now.intrinsic == ((100.123, 0.0, 64.0), (0.0, 95.0, 48.0), (0.0, 0.0, 1.0))
    now = desk.types("cx, cy", 60.0)
    assert now.intrinsic == ((100.123, 0.0, 60.0), (0.0, 95.0, 48.0), (0.0, 0.0, 1.0))
    desk.types("Width, height", 256)
    now = desk.types("Width, height", 192, at=1)
    assert now.intrinsic == matrix3(np.diag([2.0, 2.0, 1.0]) @ [(100.123, 0, 60), (0, 95, 48), (0, 0, 1)])
    now = desk.types("Lens as", FOV)
    assert now.intrinsic is None and now.fov == pytest.approx(2 * math.atan(48 / 95))
    now = desk.types("Lens as", INTRINSIC)
    assert now.fov is None and intrinsic_of(now)[1, 1] == pytest.approx(190.0)


@pytest.mark.parametrize(
    ("label", "value", "why"),
    [
        ("Near, far", 10.0, "less than far"),
        ("Width, height", 64.4, "`int`"),
        ("Width, height", 5000, "4096"),
        ("Position", 1001.0, "1000"),
        ("w x y z", "1 0 0", "four numbers"),
        ("w x y z", "one 1 0 0 0", "four numbers"),
        ("w x y z", "0 0 0 0", "zeros"),
    ],
)
@with_a_fov
def test_an_invalid_number_is_refused_with_a_reason(desk: Desk, label: str, value: Any, why: str) -> None:
    desk.panels.set("Written as", WXYZ)
    now = desk.types(label, value)
    assert why in desk.panels.client.notices[0]
    assert not differences(FILE, now)


@with_a_fov
def test_a_target_at_the_eye_a_zero_axis_and_an_unknown_shader_are_refused(desk: Desk) -> None:
    desk.types("Looks at", EYE[0])
    desk.types("Looks at", EYE[1], at=1)
    desk.types("Looks at", EYE[2], at=2)
    assert "same point" in desk.panels.client.notices[-1]
    desk.panels.set("Written as", WXYZ)
    desk.types("w x y z", "1 0 0 0")
    desk.panels.set("Written as", AXES)
    desk.types("Forward", 0.0)
    assert "no length" in desk.panels.client.notices[-1]
    desk.panels.do(ChooseShader(shader="none"))
    assert "no shader pack 'none'" in desk.panels.client.notices[-1]
    assert desk.now.quaternion == (1, 0, 0, 0) and len(desk.panels.client.notices) == 3
