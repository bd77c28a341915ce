"""Compares two placements of a camera: two pictures of the same moment, and the numeric differences."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
import viser

from workbench.cameras.commands import ChooseCompared, ComparePlacements, KeepPlacement, ReturnToKept
from workbench.cameras.events import CameraPlaced, ComparisonWanted
from workbench.cameras.job_result import JobResult
from workbench.cameras.pose_math import chosen_camera
from workbench.cameras.view import StudioCamera, StudioView
from workbench.envs.camera_data import CameraKey, CameraSettings, Picture
from workbench.live.session_protocol import LiveSession
from workbench.live.view import SessionView
from workbench.page.command import Command, Refused
from workbench.page.widgets.fields import choice
from workbench.page.widgets.modality_colours import data_address
from workbench.page.widgets.parts import PagePart
from workbench.page.widgets.templates import render
from workbench.page.widgets.tools import tool, tools_html
from workbench.page.widgets.visitors import Visitor
from workbench.pictures.camera_conventions import angle_between

Other = Literal["file", "before", "kept"]
NAMES: dict[Other, str] = {"file": "as in the file", "before": "as in the file before", "kept": "saved as A"}
OTHER_HINT = (
    'The placement to compare with the current one. "As in the file before" is '
    "the file's placement before its last change."
)
PICTURE_PIXELS = 256
"""Longer side of each picture."""


class CameraCompare(PagePart[SessionView]):
    """The Compare folder: the current placement next to a second one. The second is the placement in the
    file, the one before the file's last change, or the one that was kept as A."""

    does = (ChooseCompared, KeepPlacement, ComparePlacements, ReturnToKept)

    def __init__(self, server: viser.ViserServer, session: LiveSession) -> None:
        self._session = session
        self._kept: dict[CameraKey, CameraSettings] = {}
        self._in_file: dict[CameraKey, CameraSettings] = {}
        self._before: dict[CameraKey, CameraSettings] = {}
        """Previous placement in the file of each camera whose placement changed there."""
        self._asked: tuple[CameraKey, CameraSettings, CameraSettings, str] | None = None
        self._other: Other = "file"
        with server.gui.add_folder("Compare", expand_by_default=False) as self.folder:
            options = {name: other for other, name in NAMES.items()}
            self._others = choice(
                server, "Now, with", ChooseCompared, "other", options, self._other, hint=OTHER_HINT
            )
            self._tools = server.gui.add_html("")
            self._pair = JobResult(server)
            self._return = server.gui.add_html(
                tools_html([tool("Return to A", ReturnToKept())]), visible=False
            )

    def do(self, command: Command, visitor: Visitor) -> None:
        match command:
            case ChooseCompared(other=other):
                self._other = other
            case KeepPlacement():
                camera, now = chosen_camera(self._session)
                self._kept[camera.key] = now
                self._other = "kept"
            case ComparePlacements():
                self._compare()
            case ReturnToKept():
                camera, _ = chosen_camera(self._session)
                self._session.dispatch(CameraPlaced(camera.key, self._kept_of(camera)))

    def _kept_of(self, camera: StudioCamera) -> CameraSettings:
        if camera.key not in self._kept:
            raise Refused(
                "No placement of this camera is kept yet: click Keep this placement as A, then move the camera."
            )
        return self._kept[camera.key]

    def _compare(self) -> None:
        camera, now = chosen_camera(self._session)
        in_file = camera.info.settings if self._other == "file" else self._before.get(camera.key)
        other = self._kept_of(camera) if self._other == "kept" else in_file
        if other is None:
            raise Refused(
                "The file's placement of this camera has not changed since the page was opened: "
                "compare with another one."
            )
        self._asked = (camera.key, now, other, NAMES[self._other])
        self._pair.asked(self._session.view().of(StudioView).results.compared)
        self._session.dispatch(ComparisonWanted(other))

    def _note_file(self, cameras: tuple[StudioCamera, ...]) -> None:
        for camera in cameras:
            settings, known = camera.info.settings, self._in_file.get(camera.key)
            if settings is None:
                continue
            if known is not None and what_differs(known, settings):
                self._before[camera.key] = known
            self._in_file[camera.key] = settings

    def draw(self, view: SessionView) -> None:
        studio = view.of(StudioView)
        camera = studio.chosen
        self._note_file(studio.cameras)
        off = camera is None or camera.now is None
        self._others.show(self._other)
        self._tools.content = tools_html(
            [
                tool("Keep this placement as A", KeepPlacement(), off=off),
                tool("Show side by side", ComparePlacements(), off=off),
            ]
        )
        kept = None if camera is None else self._kept.get(camera.key)
        self._return.visible = camera is not None and kept is not None and kept != camera.now
        both = studio.results.compared
        mine = camera is not None and both is not None and both[0].key == camera.key
        now = None if camera is None else camera.now
        self._pair.draw(studio.progress, both if mine else None, now, lambda _: self._html(both, camera))

    def _html(self, both: tuple[Picture, Picture] | None, camera: StudioCamera | None) -> str:
        assert both is not None and camera is not None, "drawn only then"
        asked = self._asked if self._asked is not None and self._asked[0] == camera.key else None
        return render(
            "camera_pair",
            pictures=[
                data_address(picture.rgb, PICTURE_PIXELS) for picture in both if picture.rgb is not None
            ],
            captions=(
                "now" if asked is None or asked[1] == camera.now else "when compared",
                "other placement" if asked is None else asked[3],
            ),
            env=both[0].env,
            differences=[] if asked is None else what_differs(asked[2], asked[1]),
        )


def what_differs(old: CameraSettings, new: CameraSettings) -> list[str]:
    """The differences of `new` from `old`, each in a few words."""
    texts = []
    moved = float(np.linalg.norm(np.subtract(new.position, old.position)))
    if moved > 1e-6:
        texts.append(f"moved {1000 * moved:.1f} mm" if moved < 0.1 else f"moved {moved:.3f} m")
    turned = math.degrees(angle_between(old.quaternion, new.quaternion))
    if turned > 1e-4:
        texts.append(f"turned {turned:.2f}°")
    if old.fov is not None and new.fov is not None and abs(old.fov - new.fov) > 1e-9:
        texts.append(f"fov {math.degrees(old.fov):.1f}° → {math.degrees(new.fov):.1f}°")
    elif old.fov != new.fov or old.intrinsic != new.intrinsic:
        texts.append("lens changed")
    if (old.width, old.height) != (new.width, new.height):
        texts.append(f"{old.width} × {old.height} → {new.width} × {new.height}")
    for name, was, now in (("near", old.near, new.near), ("far", old.far, new.far)):
        if was != now:
            texts.append(f"{name} {was:g} → {now:g} m")
    if old.shader_pack != new.shader_pack:
        texts.append(f"shader {old.shader_pack} → {new.shader_pack}")
    return texts
