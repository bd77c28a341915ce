"""Matrices of a camera in a chosen convention, files of cameras, and import of a calibration."""

from __future__ import annotations

import re
from typing import Literal

import numpy as np
import viser
from numpy.typing import NDArray

from workbench.core.cameras import conventions as frames
from workbench.core.cameras.conventions import Convention, Direction
from workbench.session.cameras.view import StudioCamera
from workbench.session.live.session import Session
from workbench.session.live.view import SessionView
from workbench.ui.server.control_values import limit_text
from workbench.ui.widgets.inputs import refusals_told
from workbench.ui.widgets.templates import render

Form = Literal["json", "opencv", "ros"]
CONVENTIONS: dict[str, Convention] = {
    "OpenCV, ROS optical": "opencv",
    "OpenGL, Blender": "opengl",
    "ManiSkill, ROS body": "maniskill",
}
"""In ROS x is forward in the frame of a camera's body, and z is forward in its optical frame (REP 103)."""
AXES = {
    "opencv": "x right, y down, z forward",
    "opengl": "x right, y up, z backward",
    "maniskill": "x forward, y left, z up",
}
DIRECTIONS: dict[str, Direction] = {
    "world to camera": "world_to_camera",
    "camera to world": "camera_to_world",
}
FORMS: dict[str, tuple[Form, str]] = {
    "JSON": ("json", "json"),
    "OpenCV YAML": ("opencv", "yaml"),
    "ROS CameraInfo": ("ros", "yaml"),
}
UNITS = {"metres": 1.0, "centimetres": 0.01, "millimetres": 0.001}
"""Metres in one of each: calibrations are often in the unit of the calibration board."""
THIS, ALL = "this camera", "all cameras"
LONGEST = 20_000
"""Characters of a pasted calibration."""


class CameraExport:
    """The folder in the present container.

    A matrix of sixteen numbers does not tell its direction and the names of the camera's axes: both are chosen here, and
    hold for what is shown and for what is pasted.
    """

    def __init__(self, server: viser.ViserServer, session: Session) -> None:
        self._session = session
        self._drawn: object = None
        with server.gui.add_folder("Matrices and files", expand_by_default=False) as self.folder:
            self._convention = server.gui.add_dropdown(
                "Convention",
                tuple(CONVENTIONS),
                hint="The convention of the camera's own axes, for what is shown and what is pasted.",
            )
            self._direction = server.gui.add_dropdown(
                "Direction",
                tuple(DIRECTIONS),
                hint="OpenCV's extrinsic maps world to camera; a pose maps camera to world.",
            )
            self._html = server.gui.add_html("")
            self._form = server.gui.add_dropdown("File", tuple(FORMS))
            self._which = server.gui.add_dropdown("Of", (THIS, ALL))
            self._download = server.gui.add_button("Download", icon=viser.Icon.DOWNLOAD, color="gray")
            self._text = server.gui.add_text(
                "Calibration",
                "",
                multiline=True,
                hint="Paste a matrix of 4 x 4 or 3 x 4 numbers, our JSON, or an OpenCV YAML. It is read in the "
                "convention and direction chosen above.",
            )
            limit_text(self._text, LONGEST)
            self._unit = server.gui.add_dropdown(
                "Units",
                tuple(UNITS),
                hint="Units of what is pasted. What is shown or downloaded, and our own JSON, is in metres.",
            )
            self._import = server.gui.add_button(
                "Apply to the camera", icon=viser.Icon.FILE_IMPORT, color="gray"
            )
        self._download.on_click(self._on_download)
        self._import.on_click(self._on_import)

    def _choices(self) -> tuple[Convention, Direction]:
        return CONVENTIONS[self._convention.value], DIRECTIONS[self._direction.value]

    def _on_download(self, event: viser.GuiEvent) -> None:
        view = self._session.view()
        camera = view.studio.chosen
        if event.client is None or camera is None:
            return
        with refusals_told(event.client):
            form, suffix = FORMS[self._form.value]
            every = self._which.value == ALL
            keys = tuple(c.key for c in view.studio.cameras) if every else (camera.key,)
            text = self._session.studio.export(keys, form)
            name = file_name("cameras" if every else camera.key[1], form, suffix)
            event.client.send_file_download(name, text.encode("utf-8"), save_immediately=True)

    def _on_import(self, event: viser.GuiEvent) -> None:
        camera = self._session.view().studio.chosen
        if event.client is None or camera is None:
            return
        with refusals_told(event.client, "Not placed"):
            text = self._text.value
            if not text.strip():
                raise ValueError(
                    "Paste a calibration into the field first: a matrix, our JSON, or an OpenCV YAML."
                )
            convention, direction = self._choices()
            metres = UNITS[self._unit.value]
            self._session.studio.import_pose(camera.key, text, direction, convention, metres)
            event.client.add_notification(
                "Placed",
                "The pose was applied. The lens, if the text has one, was not: its matrix goes into Lens and image.",
                color="green",
                auto_close_seconds=8.0,
            )

    def draw(self, view: SessionView) -> None:
        camera = view.studio.chosen
        idle = camera is None or camera.now is None
        for button in (self._download, self._import):
            button.disabled = idle
        convention, direction = self._choices()
        mount = None if camera is None or camera.mount_pose is None else camera.mount_pose.tobytes()
        wanted = (convention, direction, None if camera is None else (camera.key, camera.now), mount)
        if wanted != self._drawn:
            self._drawn = wanted
            self._html.content = matrices_html(camera, convention, direction)


def file_name(name: str, form: Form, suffix: str) -> str:
    """A name for the download, with only letters, digits, - and _ of the camera's name."""
    plain = re.sub(r"[^A-Za-z0-9_-]+", "_", name).strip("_") or "camera"
    return f"{plain[:60]}{'' if form == 'json' else f'_{form}'}.{suffix}"


def matrices_html(camera: StudioCamera | None, convention: Convention, direction: Direction) -> str:
    """Intrinsic and extrinsic of the camera at its present place, in the env's frame."""
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
    """Rows of a matrix with aligned decimal points, for reading."""
    cells = [[f"{number + 0.0:.4f}".replace("-0.0000", "0.0000") for number in row] for row in matrix]
    width = max(len(cell) for row in cells for cell in row)
    return "\n".join("  ".join(cell.rjust(width) for cell in row) for row in cells)


def as_lists(matrix: NDArray[np.float64]) -> str:
    """The matrix as Python and JSON lists, for copying, with nine digits."""
    rows = (", ".join(f"{number + 0.0:.9g}" for number in row) for row in matrix)
    return "[" + ", ".join(f"[{row}]" for row in rows) + "]"
