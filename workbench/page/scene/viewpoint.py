"""The page's viewpoint: framing the grid or one env, and lights."""

from __future__ import annotations

import time
from collections.abc import Callable, Hashable, Set
from dataclasses import dataclass, field

import numpy as np
import viser
from numpy.typing import NDArray
from viser.transforms import SO3

from workbench.envs.camera_data import Picture
from workbench.page.door.viser_private import remove_nodes_except
from workbench.page.scene.bodies import NAMES as BODIES
from workbench.page.scene.bodies import SceneView
from workbench.page.scene.env_grid import MARGIN_METRES, EnvLayout, box_corners
from workbench.page.scene.software_rendering import InSoftware
from workbench.page.widgets.parts import Clock

FOV_RADIANS = 0.75
"""Vertical field of view. viser's default of 75 degrees distorts the edges of a grid."""
DEFAULT_ASPECT = 1.385
"""Aspect ratio (width over height) of the view in a 1280 x 720 window, used until a page has sent its own."""
LABEL_SHARE = 0.06
"""Margin around all envs, as a share of their width."""
FROM_THE_FRONT = np.array([1.0, 0.12, 1.1])
"""Direction from the scene to the eye: ManiSkill's robots face +x, so the eye is in front of them, slightly
to the side."""


@dataclass(frozen=True)
class Viewpoint:
    """A camera in the page: metres, z up, always upright."""

    position: NDArray[np.float64]
    look_at: NDArray[np.float64]


def frame_box(low: NDArray, high: NDArray, aspect: float = DEFAULT_ASPECT) -> Viewpoint:
    """The closest upright view from the front and above with the whole box in it.

    Let the camera be at ``target - d * forward - k * up``. A corner c, relative to the target, is inside the picture when
    ``|right . c| <= tan(fov_x / 2) * (d + forward . c)`` and ``|up . c + k| <= tan(fov_y / 2) * (d + forward . c)``. So d is
    the largest of the bounds from corners and pairs of corners, and k is the middle of the range that remains.
    """
    target = (np.asarray(low, np.float64) + high) / 2
    forward = -FROM_THE_FRONT / np.linalg.norm(FROM_THE_FRONT)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    up = np.cross(right, forward)
    corners = box_corners(low, high) - target
    tall = np.tan(FOV_RADIANS / 2)
    wide = tall * float(np.clip(aspect, 0.3, 4.0))
    ahead, height = corners @ forward, corners @ up
    pairs = height[:, None] - height - tall * (ahead[:, None] + ahead)
    distance = 1.04 * max(
        float((np.abs(corners @ right) / wide - ahead).max()),
        float(pairs.max()) / (2 * tall),
        0.3,
    )
    least = float((-tall * (distance + ahead) - height).max())
    most = float((tall * (distance + ahead) - height).min())
    look_at = target - up * (least + most) / 2
    return Viewpoint(position=look_at - forward * distance, look_at=look_at)


def frame_all(layout: EnvLayout, aspect: float = DEFAULT_ASPECT) -> Viewpoint:
    """The view of all envs, with room for their labels, which hang from the front edges."""
    low, high = layout.box_of_all()
    margin = np.array([1.0, 1.0, 0.0]) * max(MARGIN_METRES, LABEL_SHARE * float((high - low)[:2].max()))
    return frame_box(low - margin, high + margin, aspect)


def frame_one(
    layout: EnvLayout,
    picture: Picture | None,
    aspect: float = DEFAULT_ASPECT,
    fovy: float = FOV_RADIANS,
    acting: tuple[NDArray, NDArray] | None = None,
) -> Viewpoint:
    """The view of one env at the origin.

    With a human camera, the view has the camera's direction, at a distance at which the camera's picture fits
    the view.

    Args:
        picture: Picture of the human camera; only its pose is used.
        fovy: The human camera's vertical field of view, radians.
        acting: Box to frame without a human camera; None takes the whole env.
    """
    if picture is None:
        low, high = (layout.low, layout.high) if acting is None else acting
        return frame_box(low, high, aspect)
    position = picture.pose[:3].astype(np.float64)
    forward = SO3(picture.pose[3:].astype(np.float64)).apply(np.array([1.0, 0.0, 0.0]))
    centre = (layout.low + layout.high) / 2
    # The page orbits around its look-at point, which must therefore be at the depth of the env.
    depth = max(float((centre - position) @ forward), 0.2)
    tall = float(np.tan(FOV_RADIANS / 2))
    away = depth * float(np.tan(fovy / 2)) / (tall * min(1.0, float(np.clip(aspect, 0.3, 4.0))))
    look_at = position + forward * depth
    return Viewpoint(position=look_at - forward * away, look_at=look_at)


Frame = Callable[[float], Viewpoint]
"""Returns the viewpoint for a view of this aspect ratio (width over height)."""


MAX_SCENES = 8
"""Maximum number of scenes whose viewpoints are stored."""


class Framing:
    """Points the open pages at the scene until the user has moved the view.

    A page's panels take their places some time after the page has connected (later on a busy machine), and
    the user opens more panels. Each of these events changes the shape of the view: while the view is
    untouched, the scene is framed for the new shape.
    """

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self._pointed: dict[int, tuple[np.ndarray, float]] = {}
        self._framed: Hashable = None
        self._left: dict[Hashable, dict[int, tuple[NDArray, NDArray]]] = {}
        """Position and look-at of pages on which the user had moved the view, by framed object and client id."""
        self._came_back: frozenset[int] = frozenset()
        """Client ids of pages that returned to the viewpoint that they had on the framed object before."""

    def is_new(self, what: Hashable) -> bool:
        """Whether `what` differs from the object of the last call, so that it must be framed. Pages on which
        the user had already moved the view of this object return to their earlier viewpoint, and `frame_new`
        leaves them there."""
        if what == self._framed:
            return False
        clients = self._server.get_clients()
        if self._framed is not None:
            self._left[self._framed] = {
                number: (np.array(client.camera.position), np.array(client.camera.look_at))
                for number, client in clients.items()
                if not self._is_untouched(client)
            }
            while len(self._left) > MAX_SCENES:
                del self._left[next(iter(self._left))]
        self._framed = what
        back = {} if what is None else self._left.pop(what, {})
        self._came_back = frozenset(back.keys() & clients.keys())
        for number in self._came_back:
            clients[number].camera.position, clients[number].camera.look_at = back[number]
        return True

    def frame_new(self, frame: Frame) -> None:
        """Frame the new scene in every open page and in pages opened later, except pages that returned to their earlier
        viewpoint."""
        self.frame(frame, exclude=self._came_back)

    def follow(self) -> int:
        """Drop closed pages; returns the number of open ones."""
        clients = self._server.get_clients()
        for number in self._pointed.keys() - clients.keys():
            del self._pointed[number]
        return len(clients)

    @property
    def pointed(self) -> frozenset[int]:
        """Client ids of the open pages that were pointed at the scene."""
        return frozenset(self._pointed)

    def frame(self, frame: Frame, untouched_only: bool = False, exclude: Set[int] = frozenset()) -> None:
        """Frame the scene in every open page (or only untouched ones) and in pages opened later."""
        clients = self._server.get_clients()
        # Before the initial viewpoint changes: a page may still be at the present one.
        framed = [
            client
            for number, client in clients.items()
            if number not in exclude and (not untouched_only or self._is_untouched(client))
        ]
        usual = frame(DEFAULT_ASPECT)
        self._server.initial_camera.position = usual.position
        self._server.initial_camera.look_at = usual.look_at
        for client in framed:
            self._point(client, frame)

    def frame_untouched(self, frame: Frame) -> None:
        """Frame the scene again in each untouched page whose viewpoint or aspect ratio differs from the framed one."""
        for number, client in self._server.get_clients().items():
            position, aspect = self._pointed.get(
                number, (self._server.initial_camera.position, DEFAULT_ASPECT)
            )
            as_framed = _is_at(client, position) and abs(aspect_of(client) / aspect - 1) <= 0.05
            # An untouched page that is not as framed: it reconnected, or its view has another shape.
            if not as_framed and self._is_untouched(client):
                self._point(client, frame)

    def _is_untouched(self, client: viser.ClientHandle) -> bool:
        """Whether the page is at the viewpoint that was last sent to it, or at the initial viewpoint, with
        which every new page begins.

        The initial viewpoint counts too, since it may reach a new page after the viewpoint that was sent to
        this page.
        """
        position, _ = self._pointed.get(client.client_id, (None, None))
        begins = self._server.initial_camera.position
        return _is_at(client, begins) or (position is not None and _is_at(client, position))

    def _point(self, client: viser.ClientHandle, frame: Frame) -> None:
        viewpoint = frame(aspect_of(client))
        client.camera.position = viewpoint.position
        client.camera.look_at = viewpoint.look_at
        # Last: a caller that waits for this entry may close the page, and viser warns about writes to a
        # closed page.
        self._pointed[client.client_id] = (viewpoint.position, aspect_of(client))


def _is_at(client: viser.ClientHandle, position: NDArray[np.float64]) -> bool:
    return np.allclose(client.camera.position, position, atol=0.02)


def aspect_of(client: viser.ClientHandle) -> float:
    """Width over height of the view in this page."""
    camera = client.camera
    if not camera.image_height or not camera.image_width:
        return DEFAULT_ASPECT
    return camera.image_width / camera.image_height


def light(server: viser.ViserServer) -> None:
    """Add the lights to the scene; once per server.

    viser's own lights overexpose white plastic and textures; a browser without a graphics card would need
    time for each pixel of an environment map or of shadows.
    """
    server.scene.configure_default_lights(enabled=False, cast_shadow=False)
    server.scene.configure_environment_map(None)
    server.scene.add_light_hemisphere(
        "/lights/sky", sky_color=(255, 255, 255), ground_color=(125, 125, 135), intensity=1.5
    )
    server.scene.add_light_directional(
        "/lights/lamp", color=(255, 251, 244), intensity=1.5, position=(3.0, -2.0, 5.0), cast_shadow=False
    )


class View3D:
    """The 3-D view of a server, shared by its pages: bodies, lights and viewpoint.

    The bodies stay in the browser while one page replaces another. So bodies that look the same on both pages
    are not sent again, and the view is empty only until a task has loaded. Labels, frustums, marks and
    handles are removed with their page.
    """

    def __init__(self, server: viser.ViserServer, clock: Clock = time.monotonic) -> None:
        self._server = server
        server.scene.set_up_direction("+z")
        light(server)
        server.initial_camera.fov = FOV_RADIANS
        # The depth buffer has 24 bits: with viser's near plane of one centimetre, a goal painted a millimetre above a table
        # flickers from a few metres on.
        server.initial_camera.near = 0.05
        server.initial_camera.far = 300.0
        self.scene = SceneView(server, clock)
        self.framing = Framing(server)
        self.in_software = InSoftware(server)
        self.choice = ViewChoice()

    def clear(self) -> None:
        """Remove everything of a page except the bodies and lights."""
        # Callbacks first: a click that arrives now has no page to handle it.
        self._server.scene.remove_click_callback("all")
        remove_nodes_except(self._server, (*BODIES, "/lights"))
        for client in self._server.get_clients().values():
            remove_nodes_except(client, ())


DETAILS = {"fine": 1_000_000, "normal": 200_000, "coarse": 50_000}
"""Number of triangles in the view by level of detail. A browser without a graphics card needs the fewest."""


@dataclass
class ViewChoice:
    """What the user chose to see. The choice is kept when the review replaces the live page, or the
    reverse."""

    all_envs: set[str] = field(default_factory=set)
    """The tasks for which all envs are shown. For all other tasks, only the selected env is shown."""
    frustums: bool = True
    """Whether the cameras are drawn in the view."""
    frames: bool = False
    """Whether the coordinate frames are drawn in the view."""
    collisions: bool = False
    """Whether collision shapes are drawn in place of the visuals, where the scene has them."""
    detail: str = "normal"
    table: bool | None = None
    """Whether the table of envs is open; None before it was opened or closed."""
