"""Shows where resets put the selected body: points or shapes in the view, histograms, overlaps and reach."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from workbench.envs.scene.shapes import SceneGeometry
from workbench.envs.scene.simplify import reduce_mesh
from workbench.hands.commands import HideResets, SampleResets, ShowReset, ToggleGhosts
from workbench.hands.panel import Selected
from workbench.hands.resets import ResetCloud
from workbench.live.session_protocol import LiveSession
from workbench.live.view import SessionView
from workbench.page.command import Command
from workbench.page.scene.env_grid import InView
from workbench.page.widgets.parts import PagePart
from workbench.page.widgets.templates import render
from workbench.page.widgets.tools import Tool, tool, tools_html
from workbench.page.widgets.visitors import Visitor
from workbench.pictures.camera_conventions import rpy_of

Floats = NDArray[np.floating[Any]]
TITLE = "Where resets put it"
POINT_METRES = 0.006
FINE, OVERLAPS, BEYOND = 0, 1, 2
COLOURS = ("#15aabf", "#e03131", "#be4bdb")
"""Colours of resets that are fine, in which the body overlaps another, and in which no arm reaches the body."""
BINS = 24
SAME = 1e-3
"""Range, in metres or degrees, of values that count as equal."""
MAX_SEEDS = 3
"""Maximum number of resets that a row names."""
MAX_ROWS = 3
"""Maximum number of bodies that are named as overlapping."""
MAX_GHOSTS, MAX_GHOST_FACES = 128, 60_000
"""Maximum number of shapes in the view, and of their triangles."""
MIN_FACES = 60
"""Minimum number of triangles of a simplified part, even if that exceeds `MAX_GHOST_FACES`."""
MAX_PARTS = 12
"""Maximum number of meshes of a body that are drawn."""


@dataclass(frozen=True)
class PoseHistogram:
    """Distribution of a coordinate over the resets."""

    name: str
    low: str
    """The smallest value with its unit; the only value if `bars` is empty."""
    high: str
    bars: tuple[tuple[float, float, float], ...]
    """Heights of each bin's resets by `COLOURS`, in percent of the fullest bin."""


@dataclass(frozen=True)
class ResetsRow:
    """Resets with the same trouble."""

    colour: str
    what: str
    count: str
    resets: tuple[tuple[str, ShowReset], ...]
    """The first resets: name and the command that shows it."""


class ResetsPanel(PagePart[SessionView]):
    """The fold *Where resets put it* of the Inspect tab, and its points or shapes in the view.

    Args:
        selected: returns the selected body as it is drawn.
        order: viser's order of the fold in its tab.
    """

    does = (ToggleGhosts,)

    def __init__(
        self,
        server: viser.ViserServer,
        session: LiveSession,
        selected: Callable[[], Selected | None],
        order: float | None = None,
    ) -> None:
        self._server, self._session, self._selected = server, session, selected
        self._ghosts_on = False
        self._fold = server.gui.add_folder(TITLE, order=order, visible=False)
        with self._fold:
            self._html = server.gui.add_html("")
        self._points = InView(
            partial(
                server.scene.add_point_cloud,
                "/hands/resets",
                point_size=POINT_METRES,
                point_shape="circle",
                precision="float32",
            ),
            "points",
            "colors",
        )
        self._ghosts: list[viser.BatchedMeshHandle] = []
        self._drawn: object = None

    def key(self, view: SessionView) -> object:
        known = self._selected()
        return view.of(ResetCloud).serial, view.task_serial, known and known.row, self._ghosts_on

    def draw(self, view: SessionView) -> None:
        known, cloud = self._selected(), view.of(ResetCloud)
        self._fold.visible = known is not None
        if known is None:
            return
        if cloud.state == "none":
            self._html.content = tools_html([tool("Sample resets", SampleResets())])
            return
        tools = [
            tool("Hide", HideResets()),
            Tool("Shapes", ToggleGhosts(), ToggleGhosts.help(), on=self._ghosts_on),
        ]
        self._html.content = tools_html(tools) + render(
            "resets",
            text=spread_text(cloud, known.row),
            colours=COLOURS,
            histograms=histograms(cloud, known.row, known.body),
            rows=trouble_rows(cloud, known.row, known.body),
            notes=notes(cloud, known.row, known.body),
        )

    def do(self, command: Command, visitor: Visitor) -> None:
        self._ghosts_on = not self._ghosts_on

    # --- the 3-D view --------------------------------------------------------------------------------

    def draw_in_view(self, view: SessionView) -> None:
        """Draw a point or a shape for each reset, at the selected env."""
        known, cloud, task = self._selected(), view.of(ResetCloud), view.task
        wanted = None
        if known is not None and task is not None and cloud.states:
            offset = np.asarray(known.offset).tobytes()
            wanted = cloud.serial, view.task_serial, known.row, known.env, offset, self._ghosts_on
        if wanted == self._drawn:
            return
        self._drawn = wanted
        # viser's points and colours must have equal lengths, and are set one after the other.
        self._points.draw()
        for ghost in self._ghosts:
            ghost.remove()
        self._ghosts = []
        if wanted is None or known is None or task is None:
            return
        poses = cloud.of(known.row)
        colours = _rgb(marks(cloud, known.row, known.body))
        there = np.asarray(np.isfinite(poses).all(axis=-1))
        points = (poses[there][:, :3] + known.offset).astype(np.float32)
        self._points.draw(points, colours[there])
        if self._ghosts_on:
            self._draw_ghosts(task.geometry, known, poses, colours, there)

    def _draw_ghosts(
        self,
        geometry: SceneGeometry,
        known: Selected,
        poses: NDArray[np.float32],
        colours: NDArray[np.uint8],
        present: NDArray[np.bool_],
    ) -> None:
        """Draw the body at `poses` (S, N, 7) in `colours` (S, N, 3) where the mask `present` (S, N) is true."""
        every = np.flatnonzero(present)
        chosen = np.zeros(present.size, bool)
        chosen[every[np.linspace(0, len(every) - 1, min(len(every), MAX_GHOSTS)).astype(int)]] = True
        present = chosen.reshape(present.shape)
        own = [visual for visual in geometry.visuals if (visual.bodies == known.row).any()][:MAX_PARTS]
        limit = max(MIN_FACES, MAX_GHOST_FACES // max(1, len(own) * MAX_GHOSTS))
        for number, visual in enumerate(own):
            # Another env may have another shape.
            envs = np.isin(np.arange(poses.shape[1]), visual.envs[visual.bodies == known.row])
            shown = present & envs
            if not shown.any() or not len(visual.mesh.faces):
                continue
            mesh = reduce_mesh(visual.mesh, limit)
            self._ghosts.append(
                self._server.scene.add_batched_meshes_simple(
                    f"/hands/ghosts/{number}",
                    mesh.vertices,
                    mesh.faces,
                    batched_wxyzs=poses[shown][:, 3:],
                    batched_positions=(poses[shown][:, :3] + known.offset).astype(np.float32),
                    batched_colors=colours[shown],
                    opacity=0.35,
                    lod="off",
                    flat_shading=True,
                    cast_shadow=False,
                    receive_shadow=False,
                )
            )

    def reset_under_ray(self, origin: Floats, direction: Floats) -> ShowReset | None:
        """The command that shows the sampled reset whose point a click hits; None if the click hits no point.

        Args:
            origin, direction: (3,) of the click's ray in the view.
        """
        cloud, known = self._session.view().of(ResetCloud), self._selected()
        if known is None or self._points.handle is None:
            return None
        points = cloud.of(known.row)[..., :3] + known.offset
        towards = points - origin
        direction = direction / np.linalg.norm(direction)
        along = towards @ direction
        apart = np.linalg.norm(towards - along[..., None] * direction, axis=-1)
        near = np.where((along > 0) & np.isfinite(apart), apart, np.inf)
        batch, env = np.unravel_index(int(near.argmin()), near.shape)
        if near[batch, env] > 2 * POINT_METRES:
            return None
        return ShowReset(seed=cloud.seeds[int(batch)], env=int(env))


def marks(cloud: ResetCloud, row: int, body: str) -> NDArray[np.int8]:
    """(S, N) index into `COLOURS` of each reset, for the body of this name at `row`."""
    poses = cloud.of(row)
    found = np.full(poses.shape[:2], FINE, np.int8)
    beyond = cloud.out_of_reach(row)
    if beyond is not None:
        found[beyond] = BEYOND
    for depths in cloud.overlaps(body).values():
        found[depths > 0] = OVERLAPS
    return found


def _rgb(marked: NDArray[np.int8]) -> NDArray[np.uint8]:
    """(S, N, 3) colours."""
    return np.array([list(bytes.fromhex(colour[1:])) for colour in COLOURS], np.uint8)[marked]


def spread_text(cloud: ResetCloud, row: int) -> str:
    """How many resets were sampled."""
    if cloud.state == "failed":
        return f"The resets failed: {cloud.why}"
    count = int(np.isfinite(cloud.of(row)).all(axis=-1).sum())
    if not count:
        return "Resetting in the background ..."
    more = "" if cloud.state == "done" else f" so far, {len(cloud.seeds)} of {cloud.total} batches"
    return f"{count} resets{more}. Click a point to show its reset."


def histograms(cloud: ResetCloud, row: int, body: str) -> list[PoseHistogram]:
    """The histograms of x, y, z and the rotation about z; empty before the first reset."""
    poses, marked = cloud.of(row).reshape(-1, 7).astype(np.float64), marks(cloud, row, body).reshape(-1)
    there = np.isfinite(poses).all(axis=1)
    poses, marked = poses[there], marked[there]
    if not len(poses):
        return []
    yaw = np.array([rpy_of(pose[3:])[2] for pose in poses])
    values = {"x": poses[:, 0], "y": poses[:, 1], "z": poses[:, 2], "yaw": yaw}
    return [_histogram(name, one, marked) for name, one in values.items()]


def _histogram(name: str, values: Floats, marked: NDArray[np.int8]) -> PoseHistogram:
    low, high = float(values.min()), float(values.max())
    written = (lambda value: f"{value:.0f}°") if name == "yaw" else (lambda value: f"{value:.3f} m")
    if high - low < SAME:
        return PoseHistogram(name, written(low), "", ())
    counts = np.stack(
        [np.histogram(values[marked == mark], BINS, (low, high))[0] for mark in (FINE, OVERLAPS, BEYOND)], 1
    )
    heights = 100 * counts / counts.sum(axis=1).max()
    bars = tuple((float(a), float(b), float(c)) for a, b, c in heights)
    return PoseHistogram(name, written(low), written(high), bars)


def trouble_rows(cloud: ResetCloud, row: int, body: str) -> list[ResetsRow]:
    """A row for each body that overlaps this one, and one for the resets that put the body out of reach."""
    count = int(np.isfinite(cloud.of(row)).all(axis=-1).sum())
    rows = [
        _row(cloud, OVERLAPS, f"up to {1000 * depths.max():.0f} mm inside {other},", depths > 0, count)
        for other, depths in list(cloud.overlaps(body).items())[:MAX_ROWS]
    ]
    beyond = cloud.out_of_reach(row)
    if beyond is not None and beyond.any():
        rows.append(_row(cloud, BEYOND, "out of the robot's reach,", beyond, count))
    return rows


def _row(cloud: ResetCloud, mark: int, what: str, bad: NDArray[np.bool_], count: int) -> ResetsRow:
    first = np.argwhere(bad)[:MAX_SEEDS].tolist()
    alone = bad.shape[1] == 1
    resets = tuple(
        (
            f"seed {cloud.seeds[batch]}" + ("" if alone else f" env {env}"),
            ShowReset(seed=cloud.seeds[batch], env=env),
        )
        for batch, env in first
    )
    return ResetsRow(COLOURS[mark], what, f"{np.count_nonzero(bad)} of {count}", resets)


def notes(cloud: ResetCloud, row: int, body: str) -> list[str]:
    """What was checked, and what was not."""
    if not cloud.states:
        return []
    found = []
    others = len(cloud.overlaps(body))
    if not cloud.knows_overlaps():
        found.append("Overlaps are not known in GPU simulation.")
    elif others > MAX_ROWS:
        found.append(f"It is inside {others - MAX_ROWS} more bodies.")
    elif not others:
        found.append("It is never more than 2 mm inside another body.")
    beyond = cloud.out_of_reach(row)
    if beyond is None:
        found.append(
            "Reach is checked only for bodies that move and are no part of the robot, if there is an arm."
        )
    else:
        found.append(
            "Within reach: the joint limits let an end effector be at the body's origin, in any rotation. Collisions of "
            "the arm are not considered."
        )
    return found
