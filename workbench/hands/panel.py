"""Moves and pulls the selected body: by dragging it in the 3-D view, by handles, and by numbers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import count
from typing import Any, Literal, get_args

import numpy as np
import viser
from numpy.typing import NDArray
from viser.transforms import SO3

from workbench.envs.scene.shapes import SceneGeometry
from workbench.hands.commands import (
    Angle,
    Axis,
    ChooseMovedEnvs,
    HideSpawn,
    SetBodyAngle,
    SetBodyPosition,
    ShowSpawn,
    ToggleHandles,
    WriteBodyPose,
)
from workbench.hands.spawn import SpawnAsked, SpawnBox
from workbench.hands.spawn_panel import SpawnPanel
from workbench.hands.start_edit import BodyPose, RobotQpos, StartEdit, StartWanted
from workbench.hands.start_panel import start_edit_html
from workbench.hands.state import (
    BodyMoved,
    BodyPulled,
    Hands,
    envs_of_move,
    why_not_moved,
    why_not_pulled,
)
from workbench.live.messages import PullBody
from workbench.live.session_protocol import LiveSession
from workbench.live.view import SessionView
from workbench.machine.loop import post
from workbench.page.command import Command, Refused
from workbench.page.scene.body_pick import box_of_body
from workbench.page.scene.env_grid import COLOUR, InView, view_label
from workbench.page.widgets.fields import Field, choice
from workbench.page.widgets.keys_and_palette import with_key
from workbench.page.widgets.notices import refusals_shown
from workbench.page.widgets.parts import PagePart, name_fold
from workbench.page.widgets.templates import render
from workbench.page.widgets.tools import Tool, tools_html
from workbench.page.widgets.visitors import Visitor
from workbench.pictures.camera_conventions import quaternion_from_rpy, rpy_of

Floats = NDArray[np.floating[Any]]
Phase = Literal["start", "update", "end"]
XYZ, ANGLES = get_args(Axis), get_args(Angle)
TITLE = "Move"
GIZMO_PIXELS = 76.0
MIN_GRIP_METRES = 0.01
"""Minimum side of the box that is dragged, so that a thin body can be hit."""
MAX_KINEMATIC_METRES = 1.0
"""Maximum side of a kinematic body that a drag moves. A table fills the view: after a click on it, a drag that is
meant to turn the view must not move it."""
MAX_RAY = 4.0
"""Maximum distance of a moved point from the page's camera, as a multiple of its distance in the view's plane. Near
the horizon a pixel is many metres."""
HINT = (
    "Drag the body in the view: while the envs play, a spring pulls it; while they are paused, it moves parallel "
    "to the ground, and with Shift up and down. Shift+U undoes a move."
)
KINEMATIC_HINT = (
    "Pause, and drag the body in the view: it moves parallel to the ground, and with Shift up and down. Forces do "
    "not move a kinematic body. Shift+U undoes a move."
)
LARGE_HINT = "The body is large: a drag turns the view. Pause, and move it by handles (M) or numbers."


@dataclass(frozen=True)
class Selected:
    """The selected body in the selected env, as it is drawn."""

    body: str
    kind: str
    row: int
    """Its place along B of the poses."""
    env: int
    pose: Floats
    """(7,) in the env's frame."""
    box: NDArray[np.float32]
    """(2, 3) lowest and highest corner in the body's frame."""
    offset: Floats
    """(3,) position of the env in the view."""
    steps: int
    """Control steps so far in the env's episode, when it was last looked at."""


@dataclass(frozen=True)
class _Drag:
    """A drag of the selected body on one page."""

    client: int
    how: Literal["move", "pull"]
    of: Selected
    """The body when the drag began."""
    grabbed: Floats
    """(3,) the grabbed point in the body's frame."""
    pose: Floats
    """(7,) where the body is moved to; for a pull, where it was when the drag began."""
    target: Floats
    """(3,) where the grabbed point is pulled to, in the env's frame; for a move, where it was when the drag began."""


class HandsPanel(PagePart[SessionView]):
    """The fold *Move* of the Inspect tab, and what a hand drags in the view.

    While a body is moved, only the page shows it at its new pose; the env gets the pose when the drag ends. So a drag is
    one event of the history.

    Args:
        body: returns the name of the selected body; empty for none.
        order: viser's order of the fold in its tab.
    """

    does = (SetBodyPosition, SetBodyAngle, ToggleHandles, WriteBodyPose, ShowSpawn)

    def __init__(
        self,
        server: viser.ViserServer,
        session: LiveSession,
        body: Callable[[], str],
        order: float | None = None,
    ) -> None:
        self._server, self._session, self._body = server, session, body
        self._handles_on = False
        self.selected: Selected | None = None
        """The selected body as it is drawn; None if none is selected, or nothing of it is visible."""
        self._drag: _Drag | None = None
        self._offset: Floats = np.zeros(3)
        self._box_of: tuple[int, int, int] | None = None
        self._box: NDArray[np.float32] | None = None
        self._fold = server.gui.add_folder(TITLE, order=order, visible=False)
        with self._fold:
            self._note = server.gui.add_html("", visible=False)
            self._position = self._row("Position", SetBodyPosition, XYZ, "In the env's frame, metres.", 0.01)
            self._angles = self._row("Rotation", SetBodyAngle, ANGLES, "Degrees about fixed axes.", 1.0)
            self._scope = scope_choice(server)
            self._tools = server.gui.add_html("")
            self.spawn = SpawnPanel(server, session)
            """The range in which resets put the selected body."""
            self._change = server.gui.add_html("", visible=False)
        self._grips = count()
        self._ends_drag = False
        """Whether the browser still drags, after `let_go`."""
        self._grip = InView(self._add_grip, "dimensions", "position", "wxyz")
        self._gizmo = server.scene.add_transform_controls(
            "/hands/gizmo", GIZMO_PIXELS, fixed=True, depth_test=False, visible=False
        )
        self._gizmo.on_update(self._on_gizmo)
        self._force = view_label(server, "/hands/force", "bottom-left")

    def _row(self, label: str, kind: type[Command], parts: Sequence[str], hint: str, step: float) -> Field:
        given = [{"of": part} for part in parts]
        return Field(self._server, label, kind, "to", [0.0] * 3, given=given, hint=hint, step=step)

    def _add_grip(self, **place: object) -> viser.BoxHandle:
        # A browser ends its drag, and removes viser's arrow, when the dragged node is gone: so each grip has another name.
        name = f"/hands/grip_{next(self._grips)}"
        box = self._server.scene.add_box(name, color=COLOUR, opacity=0.15, **place)  # type: ignore[arg-type]
        box.on_drag(self._on_drag)
        box.on_drag("left", modifier="shift")(self._on_drag)
        return box

    # --- the panel -----------------------------------------------------------------------------------

    def key(self, view: SessionView) -> object:
        shown = view.step_serial, view.task_serial, view.selected_env, self._body(), id(self._drag)
        return (
            *shown,
            self._handles_on,
            view.of(Hands).all_envs,
            view.playing,
            view.of(StartEdit),
            view.of(SpawnBox),
        )

    def draw(self, view: SessionView) -> None:
        task, step = view.task, view.step
        poses = None if task is None or step is None else self.moved(task.geometry, step.poses)
        known = self.selected = None if poses is None else self._find(view, poses)
        self._fold.visible = known is not None
        if known is None:
            return
        why = why_not_moved(known.kind)
        degrees = [round(angle, 2) for angle in rpy_of(known.pose[3:])]
        self._position.show([round(float(value), 4) for value in known.pose[:3]], off=bool(why))
        self._angles.show(degrees, off=bool(why))
        self._scope.show(view.of(Hands).all_envs, off=bool(why))
        on_gpu = view.task is not None and view.task.backend == "gpu"
        self._note.content, self._note.visible = render("note", text=_note(known, on_gpu)), True
        handles = Tool(
            "Handles", ToggleHandles(), with_key(ToggleHandles), on=self._handles_on, off=bool(why)
        )
        write = Tool(
            "Write into the file", WriteBodyPose(), WriteBodyPose.help(), off=bool(why) or view.playing
        )
        box = view.of(SpawnBox)
        ranged = box.stage != "none" and box.body == known.body
        spawn: Command = HideSpawn() if ranged else ShowSpawn()
        of_range = Tool("Spawn range", spawn, type(spawn).help(), on=ranged, off=bool(why))
        self._tools.content = tools_html([handles, of_range, write])
        self.spawn.show(box, known.body)
        edit = view.of(StartEdit)
        of_body = edit.stage != "none" and not isinstance(edit.wanted, RobotQpos)
        self._change.content, self._change.visible = start_edit_html(edit), of_body
        name_fold(self._fold, TITLE, known.body)

    def do(self, command: Command, visitor: Visitor) -> None:
        match command:
            case ToggleHandles():
                self._handles_on = not self._handles_on
            case WriteBodyPose():
                of = self._required()
                if why := why_not_moved(of.kind):
                    raise Refused(why)
                self._session.dispatch(StartWanted(BodyPose(of.body, tuple(map(float, of.pose)))))
            case ShowSpawn():
                of = self._required()
                if why := why_not_moved(of.kind):
                    raise Refused(why)
                self._session.dispatch(SpawnAsked(of.body))
            case SetBodyPosition(of=axis, to=metres):
                pose = self._required().pose.copy()
                pose[XYZ.index(axis)] = metres
                self._move(self._required(), pose)
            case SetBodyAngle(of=angle, to=degrees):
                pose = self._required().pose.copy()
                angles = list(rpy_of(pose[3:]))
                angles[ANGLES.index(angle)] = degrees
                pose[3:] = quaternion_from_rpy(*angles)
                self._move(self._required(), pose)

    def _required(self) -> Selected:
        if self.selected is None:
            raise Refused("Select a body first: click it in the view.")
        return self.selected

    def _move(self, of: Selected, pose: Floats) -> None:
        """Put a body at a pose in the env's frame. Raises `Refused`."""
        view = self._session.view()
        envs = envs_of_move(view.of(Hands), of.env, 0 if view.task is None else view.task.num_envs)
        self._session.dispatch(BodyMoved(of.body, envs, tuple(map(float, pose))))

    def follow(self, view: SessionView) -> None:
        """Let go if the page that drags has closed, if the pulled env was reset, or if a body that is being moved plays or
        another moment is shown."""
        self.spawn.end_lost_drag()
        drag = self._drag
        if drag is None:
            return
        if drag.how == "pull":
            steps = _steps(view, drag.of.env)
            over = steps < drag.of.steps
            self._drag = replace(drag, of=replace(drag.of, steps=steps))
        else:
            over = view.playing or view.timeline.shown is not None
        if over or drag.client not in self._server.get_clients():
            self.let_go()

    # --- the 3-D view --------------------------------------------------------------------------------

    def moved(self, geometry: SceneGeometry, poses: NDArray[np.float32]) -> NDArray[np.float32]:
        """`poses` (N, B, 7), with the body at the pointer while a drag moves it."""
        drag = self._drag
        if drag is None or drag.how == "pull" or drag.of.body not in geometry.body_names:
            return poses
        if poses.shape[:2] != (geometry.num_envs, len(geometry.body_names)):
            return poses  # the step of another version
        moved = poses.copy()
        moved[drag.of.env, geometry.body_names.index(drag.of.body)] = drag.pose
        return moved

    def draw_in_view(self, view: SessionView, poses: NDArray[np.float32], offset: Floats) -> None:
        """Draw the grip at the selected body, the handles, and the force of a pull.

        Args:
            poses: (N, B, 7), as `moved` returns them.
            offset: (3,) position of the selected env in the view.
        """
        self._offset = np.asarray(offset, np.float64)
        known = self.selected = self._find(view, poses)
        if self._ends_drag:
            self._ends_drag = False
            self._grip.draw()
        if known is None or not _can_be_dragged(known, view):
            self._grip.draw()
        else:
            size = np.maximum(known.box[1] - known.box[0], MIN_GRIP_METRES) * 1.02
            middle = SO3(known.pose[3:]).apply(known.box.mean(axis=0)) + known.pose[:3] + offset
            self._grip.draw(tuple(size.tolist()), tuple(middle.tolist()), tuple(known.pose[3:].tolist()))
        movable = known is not None and not why_not_moved(known.kind)
        still = not view.playing and view.timeline.shown is None
        self._gizmo.visible = self._handles_on and movable and still
        if known is not None and self._drag is None:
            self._gizmo.position = tuple((known.pose[:3] + offset).tolist())
            self._gizmo.wxyz = tuple(known.pose[3:].tolist())
        self._draw_force(view)
        body, height = ("", 0.0) if known is None else (known.body, float(known.pose[2]))
        self.spawn.draw_in_view(view, body, height, offset)

    def _find(self, view: SessionView, poses: NDArray[np.float32]) -> Selected | None:
        task, body, env = view.task, self._body(), view.selected_env
        if task is None or body not in task.geometry.body_names:
            return None
        if poses.shape[:2] != (task.num_envs, len(task.geometry.body_names)):
            return None  # the step of another version
        row = task.geometry.body_names.index(body)
        if (of := (id(task.geometry), env, row)) != self._box_of:
            self._box_of, self._box = of, box_of_body(task.geometry, env, row)
        box = self._box
        pose = poses[env, row].astype(np.float64)
        if box is None or not np.isfinite(pose).all():
            return None
        return Selected(
            body, task.geometry.body_kinds[row], row, env, pose, box, self._offset, _steps(view, env)
        )

    def _draw_force(self, view: SessionView) -> None:
        """Show the spring's force at the end of the arrow that viser draws during a drag."""
        drag, pulled = self._drag, view.pulled
        if drag is None or drag.how == "move":
            self._force.draw()
            return
        newtons = pulled.newtons if pulled is not None and pulled.body == drag.of.body else 0.0
        self._force.draw(f"{newtons:.3g} N", tuple((drag.target + drag.of.offset).tolist()))

    # --- dragging ------------------------------------------------------------------------------------

    # Async, since viser runs callbacks that are not async in its thread pool, in any order.
    async def _on_drag(self, event: viser.SceneNodeDragEvent) -> None:
        start, end = np.array(event.start_position), np.array(event.end_position)
        eye, lifts = np.array(event.client.camera.position), event.modifier == "shift"

        def handle() -> None:
            with refusals_shown(event.client, then=self.let_go):
                self.drag(event.client_id, event.phase, start, end, eye, lifts)

        post(handle)

    async def _on_gizmo(self, event: viser.TransformControlsEvent) -> None:
        pose = np.concatenate([event.target.position, event.target.wxyz])
        post(partial(self._turned, event.client, event.phase, pose))

    def drag(
        self, client: int, phase: Phase, start: Floats, end: Floats, eye: Floats, lifts: bool = False
    ) -> None:
        """Handle a drag of the selected body with the mouse. A move is parallel to the ground, or vertical.

        Args:
            client: id of the page.
            start: (3,) the point of the body at which it is held, in the view.
            end: (3,) the pointer, in the plane through `start` that faces the page's camera.
            eye: (3,) position of the page's camera in the view.
            lifts: whether a move is vertical.

        Raises:
            Refused: the body can neither be moved nor pulled now.
        """
        if phase == "start":
            self._begin(client, start)
        drag = self._drag
        if drag is None or drag.client != client:
            return
        if drag.how == "pull":
            self._pull(drag, end - drag.of.offset)
        else:
            target = moved_point(drag.target, eye - drag.of.offset, end - drag.of.offset, lifts)
            turned = SO3(drag.of.pose[3:]).apply(drag.grabbed)
            if target is not None:
                self._drag = _with_pose(drag, np.concatenate([target - turned, drag.of.pose[3:]]))
        if phase == "end":
            self._end()

    def _begin(self, client: int, point: Floats) -> None:
        """Begin a drag at a point of the view. Raises `Refused` if the body can neither be moved nor pulled."""
        of, view = self._required(), self._session.view()
        on_gpu = view.task is not None and view.task.backend == "gpu"
        how: Literal["move", "pull"] = "pull" if view.playing else "move"
        why = why_not_pulled(of.kind, on_gpu) if how == "pull" else why_not_moved(of.kind)
        if why:
            raise Refused(why)
        grabbed = SO3(of.pose[3:]).inverse().apply(point - of.offset - of.pose[:3])
        self._drag = _Drag(client, how, of, grabbed, of.pose, point - of.offset)

    def _pull(self, drag: _Drag, target: Floats) -> None:
        self._drag = _Drag(drag.client, "pull", drag.of, drag.grabbed, drag.pose, target)
        x, y, z = map(float, drag.grabbed)
        a, b, c = map(float, target)
        self._session.dispatch(BodyPulled(PullBody(drag.of.body, drag.of.env, (x, y, z), (a, b, c))))

    def _turned(self, client: viser.ClientHandle | None, phase: str, pose: Floats) -> None:
        """Handle a drag of the handles."""
        if client is None:
            return
        with refusals_shown(client, then=self.let_go):
            if phase == "start" or self._drag is None:
                of = self._required()
                self._drag = _Drag(client.client_id, "move", of, np.zeros(3), of.pose, of.pose[:3])
            drag = self._drag
            if drag.client == client.client_id:
                pose = pose.copy()
                pose[:3] -= drag.of.offset
                self._drag = _with_pose(drag, pose)
                if phase == "end":
                    self._end()

    def _end(self) -> None:
        """End the drag: the env gets the pose, or the spring lets go."""
        drag, self._drag = self._drag, None
        if drag is None:
            return
        if drag.how == "pull":
            self._session.dispatch(BodyPulled(PullBody()))
        else:
            self._move(drag.of, drag.pose)

    def let_go(self) -> None:
        """Cancel the drag."""
        self.spawn.let_go()
        drag, self._drag = self._drag, None
        self._ends_drag |= drag is not None
        if drag is not None and drag.how == "pull":
            self._session.dispatch(BodyPulled(PullBody()))


def scope_choice(server: viser.ViserServer) -> Field:
    """The choice of the envs that a move applies to."""
    return choice(
        server,
        "In",
        ChooseMovedEnvs,
        "all_envs",
        {"this env": False, "all envs": True},
        False,
        hint="Whether a move applies to the selected env or to all envs.",
    )


def moved_point(point: Floats, eye: Floats, pointer: Floats, lifts: bool) -> Floats | None:
    """Where a grabbed point is moved to: where the ray through the pointer meets the horizontal plane through the point,
    or, if `lifts`, comes closest to the vertical line through it. None if that is behind the camera or too far away.

    Args:
        point: (3,) the point when the drag began.
        eye: (3,) the page's camera.
        pointer: (3,) a point under the pointer, as far from the camera as `point`.
    """
    ray, gap = pointer - eye, point - eye
    above, below = (gap[:2] @ ray[:2], ray[:2] @ ray[:2]) if lifts else (gap[2], ray[2])
    if not abs(above) <= MAX_RAY * abs(below) or above * below <= 0:
        return None
    met = eye + above / below * ray
    return np.array([*point[:2], met[2]] if lifts else [*met[:2], point[2]])


def _is_large(known: Selected) -> bool:
    return known.kind == "kinematic" and bool(np.max(known.box[1] - known.box[0]) > MAX_KINEMATIC_METRES)


def _note(known: Selected, on_gpu: bool) -> str:
    """How to move the body, or why it cannot be moved."""
    if known.kind == "kinematic":
        return LARGE_HINT if _is_large(known) else KINEMATIC_HINT
    if known.kind == "link" and (why := why_not_pulled(known.kind, on_gpu)):
        return why
    return why_not_moved(known.kind) or HINT


def _can_be_dragged(known: Selected, view: SessionView) -> bool:
    """Whether a drag on the body moves or pulls it now; if not, the drag turns the view."""
    if view.timeline.shown is not None:
        return False
    if view.playing:
        return not why_not_pulled(known.kind, view.task is not None and view.task.backend == "gpu")
    return not why_not_moved(known.kind) and not _is_large(known)


def _steps(view: SessionView, env: int) -> int:
    return 0 if view.step is None else int(view.step.elapsed_steps[env])


def _with_pose(drag: _Drag, pose: Floats) -> _Drag:
    return _Drag(drag.client, drag.how, drag.of, drag.grabbed, pose, drag.target)
