"""Handles at the end effectors of the selected env, and what the panel says of their targets."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from workbench.hands.reach import ArmDragged, ArmsReleased
from workbench.hands.state import Hands
from workbench.live.messages import Reached
from workbench.live.session_protocol import LiveSession
from workbench.live.view import SessionView
from workbench.machine.loop import post
from workbench.page.scene.env_grid import InView, line_set, view_label
from workbench.page.widgets.notices import refusals_shown
from workbench.page.widgets.parts import PagePart
from workbench.page.widgets.templates import render

Floats = NDArray[np.floating[Any]]
GIZMO_PIXELS = 84.0
MARK_METRES = 0.012
WITHIN, BEYOND = (64, 192, 87), (224, 49, 49)
"""Colours of a target within and out of reach."""


@dataclass(frozen=True)
class _Drag:
    """A drag of handles on one page."""

    client: int
    arm: str
    env: int
    offset: Floats
    """(3,) position of the env in the view."""


class _Handles:
    """What is drawn for one arm."""

    def __init__(self, server: viser.ViserServer, number: int) -> None:
        name = f"/hands/reach/{number}"
        self.gizmo = server.scene.add_transform_controls(
            name, GIZMO_PIXELS, fixed=True, depth_test=False, visible=False
        )
        self.mark = InView(
            partial(server.scene.add_icosphere, f"{name}_target", radius=MARK_METRES), "color", "position"
        )
        self.missing = line_set(server, f"{name}_missing", BEYOND, 3.0)
        self.label = view_label(server, f"{name}_label", "bottom-left")

    def hide(self) -> None:
        self.gizmo.visible = False
        for one in (self.mark, self.missing, self.label):
            one.draw()


class ReachPanel(PagePart[SessionView]):
    """Handles that the arms follow. While the envs play, the arms follow through the action.

    While the envs are paused, only the page shows the arm's new joint positions; the env gets them when the
    drag ends. So a drag is one event of the history.

    Args:
        order: viser's order of the text in its folder.
    """

    def __init__(self, server: viser.ViserServer, session: LiveSession, order: float) -> None:
        self._server, self._session = server, session
        self._html = server.gui.add_html("", order=order, visible=False)
        self._handles: list[_Handles] = []
        self._arms: tuple[str, ...] = ()
        """Body names of the end effectors that have handles now."""
        self._env = 0
        self._offset: Floats = np.zeros(3)
        self._drag: _Drag | None = None

    def key(self, view: SessionView) -> object:
        reach = view.of(Hands).reach
        return reach.shown, reach.targets, reach.reached, view.selected_env, view.task_serial

    def draw(self, view: SessionView) -> None:
        reach, task = view.of(Hands).reach, view.task
        self._html.visible = reach.shown and task is not None
        if task is None or not reach.shown:
            return
        rows = []
        one_robot = len({arm.body.rpartition("/")[0] for arm in task.arms}) == 1
        for arm in task.arms:
            key = view.selected_env, arm.body
            answer = reach.reached.get(key)
            text = "drag the handles" if answer is None else reached_text(answer)
            name = arm.body.rpartition("/")[2] if one_robot else arm.body
            rows.append((arm.body, name, text, answer is not None and bool(answer.why)))
        self._html.content = render("reach", rows=rows)

    # --- the 3-D view --------------------------------------------------------------------------------

    def moved(self, view: SessionView, poses: NDArray[np.float32]) -> NDArray[np.float32]:
        """`poses` (N, B, 7), with new poses for the links of arms that are dragged while paused."""
        reach, task = view.of(Hands).reach, view.task
        tried = [one for key, one in reach.reached.items() if one.how == "try" and key in reach.targets]
        if (
            task is None
            or not tried
            or view.playing
            or poses.shape[:2] != (task.num_envs, len(task.geometry.body_names))
        ):
            return poses
        moved, names = poses.copy(), task.geometry.body_names
        for one in tried:
            for link, pose in zip(one.links, one.poses, strict=True):
                if link in names:
                    moved[one.env, names.index(link)] = pose
        return moved

    def draw_in_view(self, view: SessionView, poses: NDArray[np.float32], offset: Floats) -> None:
        """Draw the handles and the targets.

        Args:
            poses: (N, B, 7), as `moved` returns them.
            offset: (3,) position of the selected env in the view.
        """
        reach, task = view.of(Hands).reach, view.task
        self._offset = np.asarray(offset, np.float64)
        shows = reach.shown and task is not None and view.timeline.shown is None
        self._arms = tuple(arm.body for arm in task.arms) if task is not None and shows else ()
        self._env = view.selected_env
        while len(self._handles) < len(self._arms):
            self._handles.append(self._add(len(self._handles)))
        for handles in self._handles[len(self._arms) :]:
            handles.hide()
        for handles, arm in zip(self._handles, self._arms, strict=False):
            assert task is not None, "there are arms"
            row = task.geometry.body_names.index(arm)
            now = poses[self._env, row].astype(np.float64)
            if not np.isfinite(now).all():
                handles.hide()
                continue
            key = self._env, arm
            target = reach.targets.get(key)
            self._draw(handles, arm, now, target, reach.reached.get(key))

    def _draw(
        self,
        handles: _Handles,
        arm: str,
        now: Floats,
        target: tuple[float, ...] | None,
        answer: Reached | None,
    ) -> None:
        pose = now if target is None else np.array(target)
        if self._drag is None or self._drag.arm != arm:
            handles.gizmo.position = tuple((pose[:3] + self._offset).tolist())
            handles.gizmo.wxyz = tuple(pose[3:].tolist())
        handles.gizmo.visible = True
        if target is None:
            for one in (handles.mark, handles.missing, handles.label):
                one.draw()
            return
        at = pose[:3] + self._offset
        beyond = answer is not None and bool(answer.why)
        handles.mark.draw(BEYOND if beyond else WITHIN, tuple(at.tolist()))
        if not beyond or answer is None:
            handles.missing.draw()
            handles.label.draw()
            return
        ends = np.stack([now[:3] + self._offset, at])[None].astype(np.float32)
        handles.missing.draw(ends)
        handles.label.draw(_left(answer), tuple(at.tolist()))

    def _add(self, number: int) -> _Handles:
        handles = _Handles(self._server, number)

        # Async, since viser runs callbacks that are not async in its thread pool, in any order.
        async def on_update(event: viser.TransformControlsEvent) -> None:
            pose = np.concatenate([event.target.position, event.target.wxyz])
            post(partial(self._turned, number, event.client, event.phase, pose))

        handles.gizmo.on_update(on_update)
        return handles

    # --- dragging ------------------------------------------------------------------------------------

    def _turned(self, number: int, client: viser.ClientHandle | None, phase: str, pose: Floats) -> None:
        if client is not None and number < len(self._arms):
            with refusals_shown(client, then=self.let_go):
                self.drag(client.client_id, self._arms[number], phase, pose)

    def drag(self, client: int, arm: str, phase: str, pose: Floats) -> None:
        """Handle a drag of the handles of an arm.

        Args:
            client: id of the page.
            arm: body name of the end effector.
            phase: ``start``, ``update`` or ``end``.
            pose: (7,) of the handles in the view.

        Raises:
            Refused: the arm cannot be moved now.
        """
        if self._drag is None:
            self._drag = _Drag(client, arm, self._env, self._offset)
        drag = self._drag
        if (drag.client, drag.arm) != (client, arm):
            return
        at = [*(pose[:3] - drag.offset).tolist(), *pose[3:].tolist()]
        if phase == "end":
            self._drag = None
        self._session.dispatch(ArmDragged(arm, drag.env, tuple(map(float, at)), phase == "end"))

    def follow(self) -> None:
        """Let go if the page that drags has closed, or if its handles are no longer shown: they report no end."""
        drag = self._drag
        if drag is None:
            return
        if drag.client not in self._server.get_clients() or drag.arm not in self._arms:
            self.let_go()

    def let_go(self) -> None:
        """Cancel the drag."""
        drag, self._drag = self._drag, None
        if drag is not None:
            self._session.dispatch(ArmsReleased())


def reached_text(answer: Reached) -> str:
    """What the panel says of a target."""
    if not answer.why:
        return "within reach"
    return f"out of reach: {answer.why}; {_left(answer)}"


def _left(answer: Reached) -> str:
    """The remaining errors, as text."""
    turned = f", {answer.degrees:.0f}°" if answer.degrees >= 1 else ""
    return f"{100 * answer.metres:.1f} cm{turned} left"
