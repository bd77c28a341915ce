"""The fold *Joints* of the Run tab: a slider for each joint, and the keyframes of each robot."""

from __future__ import annotations

import os
from collections.abc import Iterable
from typing import ClassVar

import numpy as np
import viser
from numpy.typing import NDArray

from workbench.envs.robots import Joint, RobotDescription
from workbench.hands.commands import DragJoint, SetJoint, UseKeyframe, WriteQpos
from workbench.hands.joints import (
    display_value,
    keyframe_code,
    limits_text,
    qpos_code,
    slider_bounds,
)
from workbench.hands.link_poses import link_poses
from workbench.hands.panel import scope_choice
from workbench.hands.start_edit import RobotQpos, StartEdit
from workbench.hands.start_panel import start_edit_html
from workbench.hands.state import Hands
from workbench.live.panels.run_panel import control_modes
from workbench.live.view import SessionView
from workbench.page.commands import TellUnfolded
from workbench.page.widgets.fields import Field, slider
from workbench.page.widgets.parts import PagePart, name_fold
from workbench.page.widgets.templates import render
from workbench.page.widgets.tools import Label, Tool, tools_html

TITLE = "Joints"
POSITION_MODE = "pd_joint_pos"
"""The control mode of absolute joint positions that ManiSkill's agents have."""
PAST = "This is a past moment. Press End to go live."
SETS = "A slider sets its joint's position, at rest. Shift+U undoes it."
DRIVES = "A slider drives its joint; sliders become the source of actions."


class JointsPanel(PagePart[SessionView]):
    """The fold *Joints*.

    While a slider is dragged and nothing plays, only the page shows the joint at its new position (`with_dragged_joint`);
    the env gets the position when the drag ends. So a drag is one event of the history.

    Args:
        order: viser's order of the fold in its tab.
    """

    every: ClassVar[float] = 0.1

    def __init__(self, server: viser.ViserServer, order: float) -> None:
        self._server = server
        self._robots: tuple[RobotDescription, ...] = ()
        self._unfolded = False
        """Whether a page has unfolded the fold; until then, its content is neither made nor sent."""
        self._parts: list[_RobotPart] = []
        self._fold = server.gui.add_folder(TITLE, order=order, expand_by_default=False, visible=False)
        with self._fold:
            server.gui.add_html(render("tell_seen", command=TellUnfolded(panel=TITLE)))
            self._note = server.gui.add_html("")
            self._scope = scope_choice(server)

    def unfold(self) -> None:
        """Handle a page's report that a person has unfolded the fold."""
        self._unfolded = True

    def key(self, view: SessionView) -> object:
        shown = view.step_serial, view.task_serial, view.selected_env, view.timeline.shown, view.playing
        hands = view.of(Hands)
        moves = hands.dragged, hands.all_envs
        edit = view.of(StartEdit)
        return shown, view.settings.action_source, id(view.slider_action), moves, self._unfolded, edit

    def urgent(self, view: SessionView) -> object:
        return view.of(Hands).dragged, view.task_serial, view.playing, self._unfolded

    def draw(self, view: SessionView) -> None:
        robots = () if view.task is None or _qpos(view) is None else view.task.robots
        self._fold.visible = bool(robots)
        if not robots:
            return
        count = sum(len(robot.joints) for robot in robots)
        name_fold(self._fold, TITLE, f"{len(robots)} robots" if len(robots) > 1 else str(count))
        if not self._unfolded:
            return
        if robots != self._robots:
            for part in self._parts:
                part.remove()
            with self._fold:
                self._parts = [_RobotPart(self._server, robot, alone=len(robots) == 1) for robot in robots]
            self._robots = robots
        self._note.content = render("note", text=note_of(view))
        self._scope.visible = view.task is not None and view.task.num_envs > 1
        self._scope.show(view.of(Hands).all_envs)
        for part in self._parts:
            part.draw(view)


class _RobotPart:
    """The keyframes and sliders of one robot."""

    def __init__(self, server: viser.ViserServer, robot: RobotDescription, alone: bool) -> None:
        self._robot, self._alone = robot, alone
        self._head = server.gui.add_html("")
        self._change = server.gui.add_html("", visible=False)
        self._sliders: list[Field] = []
        for number, (joint, name) in enumerate(zip(robot.joints, short_names(robot.joints), strict=True)):
            self._sliders.append(
                slider(
                    server,
                    name,
                    DragJoint,
                    "to",
                    slider_bounds(joint, 0.0),
                    step=0.001 if joint.prismatic else 1.0,
                    given={"robot": robot.name, "joint": number},
                    hint=f"{joint.name}, {'prismatic' if joint.prismatic else 'revolute'}",
                    done=SetJoint,
                    note=limits_text(joint),
                )
            )

    def draw(self, view: SessionView) -> None:
        robot, qpos = self._robot, _qpos(view)
        assert view.task is not None and view.step is not None and qpos is not None, "the fold is visible"
        env, past = min(view.selected_env, len(qpos) - 1), view.timeline.shown is not None
        for number, (joint, field) in enumerate(zip(robot.joints, self._sliders, strict=True)):
            position = shown_position(view, robot, number)
            off = past or (view.playing and joint.target is None)
            field.show(display_value(joint, position), off=off, bounds=slider_bounds(joint, position))
        keyframes = [
            Tool(one.name, UseKeyframe(robot=robot.name, name=one.name), off=past or view.playing)
            for one in robot.keyframes
        ]
        label = Label("Keyframe", f"{UseKeyframe.help()}.")
        now, root = qpos[env, [joint.column for joint in robot.joints]], robot.links[0].body
        copies = render(
            "joints",
            name="" if self._alone else robot.name,
            qpos=qpos_code(now),
            keyframe=keyframe_code(now, view.step.poses[env, root]),
        )
        write = Tool(
            "Write into the file", WriteQpos(robot=robot.name), WriteQpos.help(), off=past or view.playing
        )
        rows = [[label, *keyframes], [write]] if keyframes else [[write]]
        self._head.content = copies + tools_html(*rows)
        edit = view.of(StartEdit)
        shows = isinstance(edit.wanted, RobotQpos) and edit.wanted.of == robot.name
        self._change.visible, self._change.content = shows, start_edit_html(edit)

    def remove(self) -> None:
        self._head.remove()
        self._change.remove()
        for one in self._sliders:
            one.remove()


def note_of(view: SessionView) -> str:
    """What a slider does now; if it is disabled, why, and what to choose."""
    if view.timeline.shown is not None:
        return PAST
    if view.task is None or not view.playing:
        return SETS
    joints = [joint for robot in view.task.robots for joint in robot.joints]
    driven = sum(joint.target is not None for joint in joints)
    if driven == len(joints):
        return DRIVES
    mode = view.task.control_mode or "The control mode"
    advice = "Pause to set them"
    if POSITION_MODE in control_modes(view) and mode != POSITION_MODE:
        advice += f", or choose {POSITION_MODE} under Control"
    which = " for the disabled joints" if driven else ""
    return f"{mode} takes no positions{which}. {advice}."


def short_names(joints: Iterable[Joint]) -> list[str]:
    """The joints' names without the words with which all of them begin or end."""
    names = [joint.name for joint in joints]
    if len(names) == 1:
        return names
    start = os.path.commonprefix(names).rfind("_") + 1
    backwards = [name[start:][::-1] for name in names]
    end = os.path.commonprefix(backwards).rfind("_") + 1
    return [name[end:][::-1] for name in backwards]


def shown_position(view: SessionView, robot: RobotDescription, number: int) -> float:
    """The position that a joint's slider shows, in radians or metres: the dragged one, else the target of a
    driven joint, else the joint's position."""
    qpos, joint, dragged = _qpos(view), robot.joints[number], view.of(Hands).dragged
    assert qpos is not None, "the fold is visible"
    env, target = min(view.selected_env, len(qpos) - 1), joint.target
    if dragged is not None and (dragged.robot, dragged.joint) == (robot.name, number):
        if env in dragged.env_idx:
            return dragged.position
    is_driven = view.playing and view.settings.action_source == "sliders"
    if is_driven and target is not None and view.slider_action is not None and env < len(view.slider_action):
        return float(view.slider_action[env, target.dimension]) / target.scale + target.zero
    return float(qpos[env, joint.column])


def with_dragged_joint(view: SessionView, poses: NDArray[np.float32]) -> NDArray[np.float32]:
    """`poses` (N, B, 7), in which a dragged slider has moved the links of its robot."""
    dragged, qpos = view.of(Hands).dragged, _qpos(view)
    if dragged is None or qpos is None or view.task is None or view.timeline.shown is not None:
        return poses
    robot = next((one for one in view.task.robots if one.name == dragged.robot), None)
    if robot is None or len(qpos) != len(poses):
        return poses
    envs = list(dragged.env_idx)
    positions = qpos[np.ix_(envs, [joint.column for joint in robot.joints])].astype(np.float64)
    positions[:, dragged.joint] = dragged.position
    moved = poses.copy()
    moved[envs] = link_poses(robot, poses[envs], positions)
    return moved


def _qpos(view: SessionView) -> NDArray[np.float32] | None:
    """(N, J) joint positions of the shown step; None if the step does not fit the task."""
    if view.task is None or view.step is None or view.step.qpos is None:
        return None
    columns = max((joint.column for robot in view.task.robots for joint in robot.joints), default=0)
    qpos = view.step.qpos
    return qpos if len(qpos) == view.task.num_envs and columns < qpos.shape[1] else None
