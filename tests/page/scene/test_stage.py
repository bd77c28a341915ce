from __future__ import annotations

from tests.drive.panels import Panels
from tests.drive.scenes import table_scene
from workbench.page.scene.env_grid import lay_out
from workbench.page.scene.viewpoint import View3D


def test_only_bodies_and_light_outlive_a_page(panels: Panels) -> None:
    server = panels.server
    stage = View3D(server)
    geometry, poses = table_scene(2)
    layout = lay_out(geometry, poses)
    stage.scene.build(geometry, layout, poses)
    bodies = stage.scene.handles
    server.scene.add_label("/labels/0", "A")
    server.scene.add_frame("/labels/0/below")
    stage.clear()
    nodes = panels.nodes("")
    assert panels.labels() == [] and {*map(id, bodies)} <= {*map(id, nodes)}
    names = [node.name for node in nodes]
    assert {name.split("/")[1] for name in names if name} <= {"envs", "floor", "lights", "WorldAxes"}
    assert any(name.startswith("/lights/") for name in names)
    # The next page shows the same bodies: none is sent again.
    stage.scene.build(geometry, layout, poses)
    assert stage.scene.handles == bodies
