"""The light of the 3-D view: soft from above, with one lamp that gives shapes their form.

viser's own lights are made for bare grey meshes; on the white plastic of a robot and the textures of a
table they burn out. No environment map either: it doubles what a pixel costs, and a browser without a
graphics card pays for every pixel. No shadows: each would draw the whole batch a second time.
"""

from __future__ import annotations

import viser


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
