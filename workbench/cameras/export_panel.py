"""Shows matrices of a camera in a chosen convention, exports cameras to files, and imports a calibration."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np
import viser
from numpy.typing import NDArray

from workbench.cameras import calibration_files
from workbench.cameras.commands import (
    ApplyCalibration,
    ChooseCameraFile,
    ChooseConvention,
    ChooseDirection,
    ChooseDownloaded,
    ChooseUnits,
    DownloadCamera,
    Form,
    PasteCalibration,
)
from workbench.cameras.events import CameraPlaced
from workbench.cameras.pose_math import chosen_camera
from workbench.cameras.view import StudioCamera, StudioView
from workbench.live.session_protocol import LiveSession
from workbench.live.view import SessionView
from workbench.page.command import Command, Refused
from workbench.page.widgets.fields import Field, choice
from workbench.page.widgets.parts import PagePart
from workbench.page.widgets.templates import render, sentence
from workbench.page.widgets.tools import tool, tools_html
from workbench.page.widgets.visitors import Visitor
from workbench.pictures import camera_conventions as frames
from workbench.pictures.camera_conventions import Convention, Direction

CONVENTIONS: dict[str, Convention] = {
    "OpenCV, ROS optical": "opencv",
    "OpenGL, Blender": "opengl",
    "ManiSkill, ROS body": "maniskill",
}
"""Conventions by label. In ROS (REP 103), the forward axis is x in the frame of a camera's body, and z in the
camera's optical frame."""
AXES = {
    "opencv": "x right, y down, z forward",
    "opengl": "x right, y up, z backward",
    "maniskill": "x forward, y left, z up",
}
DIRECTIONS: dict[str, Direction] = {
    "world to camera": "world_to_camera",
    "camera to world": "camera_to_world",
}
FORMS: dict[str, Form] = {"JSON": "json", "OpenCV YAML": "opencv", "ROS CameraInfo": "ros"}
UNITS = {"metres": 1.0, "centimetres": 0.01, "millimetres": 0.001}
"""Length in metres of each unit of a pasted calibration, which is often in the unit of the calibration
board."""
WHICH = {"this camera": False, "all cameras": True}
CONVENTION_HINT = (
    "The convention of the camera's axes, in the matrix shown below and in a pasted calibration."
)
DIRECTION_HINT = "OpenCV's extrinsic maps world to camera; a pose maps camera to world."
CALIBRATION_HINT = (
    "Paste a matrix of 4 x 4 or 3 x 4 numbers, our JSON, or an OpenCV YAML. It is read in the convention and direction "
    "chosen above."
)
UNITS_HINT = "Units of the pasted calibration. Shown and downloaded poses, and our own JSON, are in metres."


class CameraExport(PagePart[SessionView]):
    """The folder "Matrices and files", in the present container.

    A matrix states neither its direction nor the convention of the camera's axes: both are chosen here, for
    shown and for pasted matrices.
    """

    does = (
        ChooseConvention,
        ChooseDirection,
        ChooseCameraFile,
        ChooseDownloaded,
        DownloadCamera,
        PasteCalibration,
        ChooseUnits,
        ApplyCalibration,
    )

    def __init__(self, server: viser.ViserServer, session: LiveSession) -> None:
        self._session = session
        self._drawn: object = None
        self._convention: Convention = "opencv"
        self._direction: Direction = "world_to_camera"
        self._form: Form = "json"
        self._every = False
        self._text, self._units = "", "metres"
        gui = server.gui
        with gui.add_folder("Matrices and files", expand_by_default=False) as self.folder:
            self._conventions = choice(
                server,
                "Convention",
                ChooseConvention,
                "convention",
                CONVENTIONS,
                self._convention,
                hint=CONVENTION_HINT,
            )
            self._directions = choice(
                server,
                "Direction",
                ChooseDirection,
                "direction",
                DIRECTIONS,
                self._direction,
                hint=DIRECTION_HINT,
            )
            self._html = gui.add_html("")
            self._forms = choice(server, "File", ChooseCameraFile, "form", FORMS, self._form)
            self._which = choice(server, "Of", ChooseDownloaded, "every", WHICH, self._every)
            self._download = gui.add_html("")
            self._pasted = Field(
                server,
                "Calibration",
                PasteCalibration,
                "text",
                hint=CALIBRATION_HINT,
                longest=100_000,
                lines=4,
            )
            self._in_units = choice(
                server, "Units", ChooseUnits, "units", tuple(UNITS), self._units, hint=UNITS_HINT
            )
            self._apply = gui.add_html("")

    def do(self, command: Command, visitor: Visitor) -> None:
        match command:
            case ChooseConvention(convention=convention):
                self._convention = convention
            case ChooseDirection(direction=direction):
                self._direction = direction
            case ChooseCameraFile(form=form):
                self._form = form
            case ChooseDownloaded(every=every):
                self._every = every
            case DownloadCamera():
                self._send_file(visitor.client)
            case PasteCalibration(text=text):
                self._text = text
            case ChooseUnits(units=units):
                self._units = units
            case ApplyCalibration():
                self._place_by_text(visitor.client)

    def _send_file(self, client: viser.ClientHandle) -> None:
        camera, _ = chosen_camera(self._session)
        cameras = self._session.view().of(StudioView).cameras if self._every else (camera,)
        try:
            text = calibration_text(cameras, self._form)
        except ValueError as reason:
            raise Refused(sentence(str(reason))) from None
        name = file_name("cameras" if self._every else camera.key[1], self._form)
        client.send_file_download(name, text.encode("utf-8"), save_immediately=True)

    def _place_by_text(self, client: viser.ClientHandle) -> None:
        camera, now = chosen_camera(self._session)
        if not self._text.strip():
            raise Refused("Paste a calibration into the field first: a matrix, our JSON, or an OpenCV YAML.")
        try:
            pose = calibrated_pose(camera, self._text, self._direction, self._convention, UNITS[self._units])
        except ValueError as reason:
            raise Refused(sentence(str(reason))) from None
        self._session.dispatch(CameraPlaced(camera.key, frames.with_pose(now, pose)))
        client.add_notification(
            "Placed",
            "The pose was applied; the lens was not. If the calibration has an intrinsic matrix, enter it under Lens "
            "and image.",
            color="green",
            auto_close_seconds=8.0,
        )

    def draw(self, view: SessionView) -> None:
        camera = view.of(StudioView).chosen
        off = camera is None or camera.now is None
        self._conventions.show(self._convention)
        self._directions.show(self._direction)
        self._forms.show(self._form)
        self._which.show(self._every)
        self._pasted.show(self._text)
        self._in_units.show(self._units)
        self._download.content = tools_html([tool("Download", DownloadCamera(), off=off)])
        self._apply.content = tools_html([tool("Apply to the camera", ApplyCalibration(), off=off)])
        mount = None if camera is None or camera.mount_pose is None else camera.mount_pose.tobytes()
        shown = None if camera is None else (camera.key, camera.now)
        wanted = (self._convention, self._direction, shown, mount)
        if wanted != self._drawn:
            self._drawn = wanted
            self._html.content = matrices_html(camera, self._convention, self._direction)


def calibration_text(cameras: Sequence[StudioCamera], form: Form) -> str:
    """The text of a calibration file: cameras as placed, at the shown moment of the selected env.

    ROS's format has one camera per file; several cameras become YAML documents in one text.

    Raises:
        ValueError: a camera cannot be exported; the message is for the user.
    """
    to_export = []
    for camera in cameras:
        kind, name = camera.key
        if camera.now is None:
            raise ValueError(f"the {kind} camera {name} cannot be exported: its settings are not known")
        to_export.append(
            calibration_files.CameraToExport(camera.key, camera.now, camera.info.mount, camera.mount_pose)
        )
    if form == "ros":
        return "---\n".join(calibration_files.camera_as_ros_yaml(one) for one in to_export)
    write = calibration_files.cameras_as_json if form == "json" else calibration_files.cameras_as_opencv_yaml
    return write(to_export)


def calibrated_pose(
    camera: StudioCamera,
    text: str,
    direction: Direction | None,
    convention: Convention | None,
    metres_per_unit: float = 1.0,
) -> frames.Floats:
    """(7,) pose from a calibration, in the frame of the camera's mount, or in the env's frame if the camera
    has no mount.

    Our own JSON names its direction and convention; for other texts, the arguments are used.

    Raises:
        ValueError: the text has no usable pose; the message is for the user.
    """
    info = camera.info
    found = calibration_files.find_poses(text)
    chosen = [pose for pose in found if info.name in pose.label] or list(found)
    if len(chosen) > 1:
        labels = ", ".join(pose.label for pose in chosen)
        raise ValueError(f"the text holds several poses ({labels}): paste only one of them")
    pose = calibration_files.camera_pose(chosen[0], convention, direction, metres_per_unit)
    if chosen[0].stated is None or info.mount is None:
        return pose
    if camera.mount_pose is None:
        raise ValueError(f"the pose of {info.mount}, on which {info.name} is mounted, is not known yet")
    return frames.relative_to(camera.mount_pose, pose)  # our JSON is in the env's frame


def file_name(name: str, form: Form) -> str:
    """File name for the download; of the camera's name only letters, digits, - and _ are kept."""
    plain = re.sub(r"[^A-Za-z0-9_-]+", "_", name).strip("_")[:60] or "camera"
    return f"{plain}.json" if form == "json" else f"{plain}_{form}.yaml"


def matrices_html(camera: StudioCamera | None, convention: Convention, direction: Direction) -> str:
    """Intrinsic and extrinsic of the camera at its present pose in the env's frame, as HTML."""
    if camera is None or camera.now is None:
        return render("note", text="Choose a camera first.")
    pose = frames.pose_in_env(camera.now, camera.mount_pose)
    return render(
        "camera_matrices",
        camera=camera,
        extrinsic=frames.matrix_of(pose, convention, direction),
        intrinsic=frames.intrinsic_of(camera.now),
        direction=direction,
        axes=AXES[convention],
        aligned=aligned,
        as_lists=as_lists,
    )


def aligned(matrix: NDArray[np.float64]) -> str:
    """The rows of a matrix with aligned decimal points, for reading."""
    cells = [[f"{number + 0.0:.4f}".replace("-0.0000", "0.0000") for number in row] for row in matrix]
    width = max(len(cell) for row in cells for cell in row)
    return "\n".join("  ".join(cell.rjust(width) for cell in row) for row in cells)


def as_lists(matrix: NDArray[np.float64]) -> str:
    """The matrix for copying, with nine digits: nested lists that are both Python and JSON."""
    rows = (", ".join(f"{number + 0.0:.9g}" for number in row) for row in matrix)
    return "[" + ", ".join(f"[{row}]" for row in rows) + "]"
