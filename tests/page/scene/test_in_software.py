from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import trimesh

from tests.drive.scenes import table_scene
from tests.drive.waiting import until
from workbench.envs.scene.shapes import Mesh, SceneGeometry
from workbench.machine.loop import do
from workbench.page.scene.bodies import DrawStyle
from workbench.page.scene.env_grid import EnvLayout, lay_out
from workbench.page.scene.software_rendering import InSoftware, pixel_of
from workbench.page.scene.visible_motion import Eye
from workbench.page.widgets.visitors import Visitor

Callback = Callable[[Any], Coroutine[Any, Any, None]]


class Server:
    """A stub server whose pages connect and disconnect."""

    def __init__(self) -> None:
        self.pages: dict[int, Any] = {}
        self.on_come: list[Callback] = []
        self.on_leave: list[Callback] = []
        self.on_client_connect, self.on_client_disconnect = self.on_come.append, self.on_leave.append

    def get_clients(self) -> dict[int, Any]:
        return dict(self.pages)

    def come(self, page: int) -> None:
        camera = SimpleNamespace(position=np.array([5.0, 0.0, 3.0]), fov=0.8, image_height=700)
        self.pages[page] = SimpleNamespace(client_id=page, camera=camera)
        self._tell(self.on_come, page)

    def leave(self, page: int) -> None:
        self._tell(self.on_leave, page)
        del self.pages[page]

    def visitor(self, page: int) -> Visitor:
        return Visitor("", self.pages[page])

    def _tell(self, callbacks: list[Callback], page: int) -> None:
        for callback in callbacks:
            asyncio.run(callback(self.pages[page]))
        do(lambda: None)  # everything posted earlier has run now


def heavy_scene() -> tuple[SceneGeometry, EnvLayout]:
    geometry, poses = table_scene(100)
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.05)
    mesh = Mesh(ball.vertices.astype(np.float32), ball.faces.astype(np.uint32))
    geometry = replace(geometry, visuals=tuple(replace(visual, mesh=mesh) for visual in geometry.visuals))
    return geometry, lay_out(geometry, poses)


def test_a_page_that_does_not_report_in_time_counts_as_using_a_gpu(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    server: Any = Server()
    in_software = InSoftware(server)
    monkeypatch.setattr("workbench.page.scene.software_rendering.REPORT_TIMEOUT_SECONDS", 0.05)
    server.come(1)
    assert not in_software.all_pages
    in_software.report_arrived(server.visitor(1))
    until(lambda: in_software.all_pages, "the page says so")
    server.come(2)
    assert in_software.all_pages, "nothing changes before the page's report is overdue"
    until(lambda: not in_software.all_pages, "the time is over")
    in_software.report_arrived(server.visitor(2))
    until(lambda: in_software.all_pages, "the late report")
    server.come(3)
    until(lambda: not in_software.all_pages, "the time is over")
    server.leave(3)
    assert in_software.all_pages
    server.leave(1)
    server.leave(2)
    assert in_software.all_pages, "a reloaded page gets the same meshes"


def test_meshes_are_simplified_in_the_background_for_software_rendering() -> None:
    server: Any = Server()
    in_software = InSoftware(server)
    geometry, layout = heavy_scene()
    server.come(1)
    assert in_software.looks(DrawStyle(), geometry, layout, alone=False) == DrawStyle()
    in_software.report_arrived(server.visitor(1))
    until(lambda: in_software.looks(DrawStyle(), geometry, layout, alone=False).error > 0, "simpler shapes")
    near = in_software.looks(DrawStyle(), geometry, layout, alone=False).error
    assert in_software.looks(DrawStyle(1_000_000), geometry, layout, alone=False).error == 0
    server.pages[1].camera.position = np.array([50.0, 0.0, 30.0])
    until(
        lambda: in_software.looks(DrawStyle(), geometry, layout, alone=False).error > 4 * near,
        "even simpler meshes for a distant eye",
    )
    server.leave(1)


def test_the_pixel_size_is_that_of_the_nearest_env_and_eye() -> None:
    geometry, poses = table_scene(4)
    layout = lay_out(geometry, poses)
    above = np.array([0.0, 0.0, layout.high[2] + 2.0])
    far = Eye(above + layout.offsets[0] + [0, 0, 3], 0.001)
    near = Eye(above + layout.offsets[3], 0.001)
    assert np.isclose(pixel_of((far,), layout, alone=False), 0.005)
    assert np.isclose(pixel_of((far, near), layout, alone=False), 0.002)
    # A single env is shown at the origin, whichever it is.
    assert np.isclose(pixel_of((Eye(above, 0.001),), layout, alone=True), 0.002)


def test_light_scenes_and_finer_choices_are_not_simplified() -> None:
    server: Any = Server()
    in_software = InSoftware(server)
    geometry, layout = heavy_scene()
    light, poses = table_scene(2)
    server.come(1)
    in_software.report_arrived(server.visitor(1))
    until(lambda: in_software.looks(DrawStyle(), geometry, layout, alone=False).error > 0, "simpler shapes")
    assert in_software.looks(DrawStyle(), light, lay_out(light, poses), alone=False).error == 0
    assert in_software.looks(DrawStyle(), geometry, layout, alone=True).error == 0, (
        "one env has few triangles"
    )
    style = DrawStyle(50_000, dark=False)
    simple = in_software.looks(style, geometry, layout, alone=False)
    assert simple.error > 0 and replace(simple, error=0.0) == style
    other, _ = heavy_scene()
    assert in_software.looks(style, other, layout, alone=False).error == 0, "its shapes are not made yet"
    server.leave(1)
