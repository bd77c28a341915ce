"""The 3-D view, its light and where one looks from: what outlives the pages that draw into it.

The bodies stay in the browser while one page takes the other's place, so what looks as before is not sent again and the
view is never empty in between. Labels, frustums, marks and handles go with their page. viser's own lights burn white
plastic and textures out; an environment map or shadows would make a browser without a graphics card pay for each pixel.
"""

from __future__ import annotations

import viser

from workbench.ui.scene_view import NAMES as BODIES
from workbench.ui.scene_view import SceneView
from workbench.ui.viewpoint import FOV, Framing
from workbench.ui.viser_seam import remove_nodes_but


def light(server: viser.ViserServer) -> None:
    """Put the lights into the scene; once a server."""
    server.scene.configure_default_lights(enabled=False, cast_shadow=False)
    server.scene.configure_environment_map(None)
    server.scene.add_light_hemisphere(
        "/lights/sky", sky_color=(255, 255, 255), ground_color=(125, 125, 135), intensity=1.5
    )
    server.scene.add_light_directional(
        "/lights/lamp", color=(255, 251, 244), intensity=1.5, position=(3.0, -2.0, 5.0), cast_shadow=False
    )


class Stage:
    """Bodies, light and viewpoint on this server; one for all its pages."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        server.scene.set_up_direction("+z")
        light(server)
        server.initial_camera.fov = FOV
        # Depth is 24 bit: with viser's near plane of a centimetre a goal that is painted a millimetre
        # above a table flickers from a few metres on.
        server.initial_camera.near = 0.05
        server.initial_camera.far = 300.0
        self.scene = SceneView(server)
        self.framing = Framing(server)

    def clear(self) -> None:
        """Take away what a page has put up besides the bodies."""
        # Callbacks first: a click that comes now is nobody's.
        self._server.scene.remove_click_callback("all")
        remove_nodes_but(self._server, (*BODIES, "/lights"))
