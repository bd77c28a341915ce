"""The 3-D view, which outlives the pages that draw into it.

The live page and the review come and go (`pages`), and what they draw is mostly the same: the robot, the table, the
cube. So the bodies stay in the browser while one page takes the other's place. What looks as before is not sent
again, and the view is never empty in between: until a live env is there, one sees the recording that it begins from.
Where one looks from stays as well, if the same is to be seen; everything else (labels, frustums, marks, handles) goes
with its page.

The light of the 3-D view: soft from above, with one lamp that gives shapes their form.

viser's own lights are made for bare grey meshes; on the white plastic of a robot and the textures of a
table they burn out. No environment map either: it doubles what a pixel costs, and a browser without a
graphics card pays for every pixel. No shadows: each would draw the whole batch a second time.
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
