"""What a camera may be, before any of it becomes a line of somebody's program.

The numbers come from a page in a browser, and what is written into the file is executed. So each is checked to be
what its type says, and the one string to be a word.
"""

from __future__ import annotations

import math
import re

from workbench.authoring.camera_source.result import Refused
from workbench.core.camera_settings import CameraSettings

_MOST_PIXELS = 16384
_FURTHEST = 1e6


def check_wanted(settings: CameraSettings) -> None:
    """Raises `Refused` for settings that no camera can have."""
    numbers = [*settings.position, *settings.quaternion, settings.near, settings.far]
    numbers += [] if settings.fov is None else [settings.fov]
    numbers += [] if settings.intrinsic is None else [x for row in settings.intrinsic for x in row]
    if not all(isinstance(x, (int, float)) and math.isfinite(x) and abs(x) <= _FURTHEST for x in numbers):
        raise Refused("a number of the camera is infinite, or none")
    if math.hypot(*settings.quaternion) < 1e-6:
        raise Refused("a quaternion of length 0 is no orientation")
    if (settings.fov is None) == (settings.intrinsic is None):
        raise Refused("a camera has either a fov or an intrinsic")
    if settings.fov is not None and not 1e-3 <= settings.fov <= math.pi - 1e-3:
        raise Refused(f"a fov of {settings.fov:.4g} radians is none: it lies between 0 and pi")
    if not 0 <= settings.near < settings.far:
        raise Refused(f"near ({settings.near:.4g} m) has to be less than far ({settings.far:.4g} m)")
    for name, size in (("width", settings.width), ("height", settings.height)):
        if not isinstance(size, int) or not 1 <= size <= _MOST_PIXELS:
            raise Refused(f"a {name} of {size!r} pixels is none")
    if not re.fullmatch(r"[A-Za-z0-9_-]{1,60}", settings.shader_pack):
        raise Refused(f"{settings.shader_pack!r} is no shader pack")
