"""Driving by keys and gamepad: the buttons and the list of keys on the Run tab, and the sign in the bar."""

from __future__ import annotations

import json
from collections.abc import Sequence

import numpy as np
import viser

from workbench.hands.commands import (
    BeginAgain,
    DiscardEpisode,
    DriveRobot,
    KeepEpisode,
    ToggleDriving,
    ToggleReach,
)
from workbench.hands.drive_keys import GRIPPER_KEY, KEYS, KeyBinding, bindings, gripper, is_end_effector
from workbench.hands.gamepad import GRIPPER_LABEL, LABELS, B, X, Y, pad_amounts, pad_grips
from workbench.hands.reach import why_no_arm
from workbench.hands.state import Driven, Hands
from workbench.live.session_protocol import LiveSession
from workbench.live.view import SessionView
from workbench.page.command import SHORT_NAMES, Command, key_in_words, name_of
from workbench.page.widgets.keys_and_palette import with_key
from workbench.page.widgets.parts import PagePart
from workbench.page.widgets.templates import render
from workbench.page.widgets.tools import Tool, tool, tools_html
from workbench.page.widgets.visitors import Visitor
from workbench.record.state import RecordingStatus

SET = (("Keep", KeepEpisode(), Y), ("Discard", DiscardEpisode(), X), ("Again", BeginAgain(), B))
"""Label, command and gamepad button of what ends the driven episode."""


class DrivePanel(PagePart[SessionView]):
    """The buttons *Drive by keys* and *Reach*, and what each key does while a person drives.

    Args:
        order: viser's order of the panel in its folder.
    """

    does = (DriveRobot,)

    def __init__(self, server: viser.ViserServer, session: LiveSession, order: float) -> None:
        self._session = session
        self._html = server.gui.add_html("", order=order)

    def key(self, view: SessionView) -> object:
        hands = view.of(Hands)
        recording = view.of(RecordingStatus)
        saving = recording.kept, recording.saving.progress
        return hands.driving, hands.reach.shown, hands.note, saving, view.task_serial, view.selected_env

    def draw(self, view: SessionView) -> None:
        hands = view.of(Hands)
        driving, reaches = hands.driving, hands.reach.shown
        actions = () if view.task is None else view.task.actions
        button = Tool(
            "Stop driving" if driving else "Drive by keys",
            ToggleDriving(),
            with_key(ToggleDriving),
            on=driving,
            off=not actions,
        )
        armless = "" if view.task is None or view.task.arms else why_no_arm(view.task.armless)
        reach = Tool(
            "Reach",
            ToggleReach(),
            armless or with_key(ToggleReach),
            on=reaches,
            off=view.task is None or bool(armless),
        )
        bound, grips = bindings(actions), gripper(actions)
        rows = _rows(bound, bool(grips)) if driving else []
        of_set = [tool(name, command) for name, command, _ in SET] if driving else []
        recording = view.of(RecordingStatus)
        self._html.content = tools_html([button, reach], of_set) + render(
            "drive_keys",
            rows=rows,
            note=hands.note,
            kept=recording.kept,
            progress=recording.saving.progress,
            follows_view=is_end_effector(bound),
            keyless=len(actions) - len(bound) - len(grips),
        )

    def do(self, command: Command, visitor: Visitor) -> None:
        match command:
            case DriveRobot(keys=keys, axes=axes, buttons=buttons):
                known = tuple(
                    key for key in KEYS if key in keys or (key == GRIPPER_KEY and pad_grips(buttons))
                )
                sticks = pad_amounts(axes, buttons)
                yaw = yaw_of(visitor.client.camera.wxyz)
                self._session.dispatch(Driven(known, yaw, sticks if any(sticks) else ()))


class DrivingSign(PagePart[SessionView]):
    """The sign in the bar while a person drives. While it is shown, the page sends the driving keys."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._html = server.gui.add_html("", visible=False)

    def key(self, view: SessionView) -> object:
        return view.of(Hands).driving, view.selected_env, view.task_serial

    def draw(self, view: SessionView) -> None:
        driving = view.of(Hands).driving and view.task is not None
        self._html.visible = driving
        if driving:
            presses = {button: name_of(type(command)) for _, command, (button, _) in SET}
            self._html.content = render(
                "driving",
                env=view.selected_env,
                drives=json.dumps([name_of(DriveRobot), "keys", KEYS, "axes", "buttons", presses]),
                stop=ToggleDriving(),
                hint=with_key(ToggleDriving),
            )


def yaw_of(wxyz: Sequence[float] | np.ndarray) -> float:
    """Direction in which a camera of the page looks, in radians: counter-clockwise from x, seen from above.

    Args:
        wxyz: the camera's orientation; the camera looks along its z axis.
    """
    w, x, y, z = wxyz
    ahead = 2 * (x * z + w * y), 2 * (y * z - w * x)
    return float(np.arctan2(ahead[1], ahead[0]))


def _rows(bound: Sequence[KeyBinding], has_gripper: bool) -> list[tuple[str, str, str]]:
    """Rows of the list: keys, gamepad controls, and what both do."""
    rows = [
        (f"{key_in_words(one.raises, SHORT_NAMES)} / {key_in_words(one.lowers, SHORT_NAMES)}", pad, one.name)
        for one, pad in zip(bound, LABELS, strict=False)
    ]
    grip = key_in_words(GRIPPER_KEY), GRIPPER_LABEL, "gripper"
    ends = [(key_in_words(command.key), pad, name.lower()) for name, command, (_, pad) in SET]
    return [*rows, *([grip] if has_gripper else []), *ends]
