"""Compares two placements of a camera: two pictures of the same moment, and the differences in numbers."""

from __future__ import annotations

import math

import numpy as np
import viser

from workbench.core.camera_data import CameraKey, CameraSettings, Picture
from workbench.core.cameras.conventions import angle_between
from workbench.session.cameras.view import StudioCamera
from workbench.session.live.session import Session
from workbench.session.live.view import SessionView
from workbench.ui.widgets.images import data_address
from workbench.ui.widgets.inputs import refusals_told
from workbench.ui.widgets.progress import JobResult
from workbench.ui.widgets.templates import render

FILE, BEFORE, KEPT = "as in the file", "as in the file before", "saved as A"
LARGEST = 256
"""Pixels along the longer side of each picture."""


class CameraCompare:
    """The folder in the present container: the placement now, next to the file's or one that was kept as A."""

    def __init__(self, server: viser.ViserServer, session: Session) -> None:
        self._session = session
        self._kept: dict[CameraKey, CameraSettings] = {}
        self._in_file: dict[CameraKey, CameraSettings] = {}
        self._before: dict[CameraKey, CameraSettings] = {}
        """As the file placed it before the newest change of that."""
        self._asked: tuple[CameraKey, CameraSettings, CameraSettings, str] | None = None
        with server.gui.add_folder("Compare", expand_by_default=False) as self.folder:
            self._other = server.gui.add_dropdown(
                "Now, with",
                (FILE, BEFORE, KEPT),
                hint="The placement to compare with the camera's current one. The file before: as it was before the "
                "last change of this camera that was saved.",
            )
            self._keep = server.gui.add_button(
                "Keep this placement as A",
                icon=viser.Icon.PIN,
                color="gray",
                hint="To compare it later, or return to it.",
            )
            self._compare = server.gui.add_button(
                "Show side by side", icon=viser.Icon.COLUMNS_2, color="gray"
            )
            self._pair = JobResult(server, session)
            self._take = server.gui.add_button(
                "Return to A", icon=viser.Icon.ARROW_BACK_UP, color="gray", visible=False
            )
        self._keep.on_click(lambda _: self._keep_now())
        self._compare.on_click(self._ask)
        self._take.on_click(lambda _: self._take_kept())

    def _chosen(self) -> StudioCamera | None:
        return self._session.view().studio.chosen

    def _keep_now(self) -> None:
        camera = self._chosen()
        if camera is not None and camera.now is not None:
            self._kept[camera.key] = camera.now
            self._other.value = KEPT

    def _take_kept(self) -> None:
        camera = self._chosen()
        if camera is not None and camera.key in self._kept:
            self._session.studio.place(camera.key, self._kept[camera.key])

    def _ask(self, event: viser.GuiEvent) -> None:
        camera = self._chosen()
        if camera is None or camera.now is None or camera.info.settings is None:
            return
        choice = self._other.value
        with refusals_told(event.client):
            if choice == KEPT and camera.key not in self._kept:
                raise ValueError(
                    "No placement of this camera is kept yet: click Keep this placement as A, then move the camera."
                )
            if choice == BEFORE and camera.key not in self._before:
                raise ValueError("The file has placed this camera in one way since the page was opened.")
            earlier = self._before if choice == BEFORE else self._kept
            other = camera.info.settings if choice == FILE else earlier[camera.key]
            self._asked = (camera.key, camera.now, other, choice)
            self._pair.asked(self._session.view().studio.results.compared)
            self._session.studio.reports.compare(other)

    def _note_file(self, cameras: tuple[StudioCamera, ...]) -> None:
        for camera in cameras:
            settings, known = camera.info.settings, self._in_file.get(camera.key)
            if settings is None:
                continue
            if known is not None and what_differs(known, settings):
                self._before[camera.key] = known
            self._in_file[camera.key] = settings

    def draw(self, view: SessionView) -> None:
        studio = view.studio
        camera = studio.chosen
        self._note_file(studio.cameras)
        usable = camera is not None and camera.now is not None
        for button in (self._keep, self._compare):
            button.disabled = not usable
        kept = None if camera is None else self._kept.get(camera.key)
        back = camera is not None and kept is not None and kept != camera.now
        self._take.visible = back
        both = studio.results.compared
        mine = camera is not None and both is not None and both[0].key == camera.key
        now = None if camera is None else camera.now
        self._pair.draw(studio.progress, both if mine else None, now, lambda _: self._html(both, camera))

    def _html(self, both: tuple[Picture, Picture] | None, camera: StudioCamera | None) -> str:
        assert both is not None and camera is not None, "drawn only then"
        asked = self._asked if self._asked is not None and self._asked[0] == camera.key else None
        return render(
            "camera_pair",
            pictures=[data_address(picture.rgb, LARGEST) for picture in both if picture.rgb is not None],
            captions=(
                "now" if asked is None or asked[1] == camera.now else "as it was then",
                "the other" if asked is None else asked[3],
            ),
            env=both[0].env,
            differences=[] if asked is None else what_differs(asked[2], asked[1]),
        )


def what_differs(old: CameraSettings, new: CameraSettings) -> list[str]:
    """The differences of `new` from `old`, each in a few words."""
    said = []
    moved = float(np.linalg.norm(np.subtract(new.position, old.position)))
    if moved > 1e-6:
        said.append(f"moved {1000 * moved:.1f} mm" if moved < 0.1 else f"moved {moved:.3f} m")
    turned = math.degrees(angle_between(old.quaternion, new.quaternion))
    if turned > 1e-4:
        said.append(f"turned {turned:.2f}°")
    if old.fov is not None and new.fov is not None and abs(old.fov - new.fov) > 1e-9:
        said.append(f"fov {math.degrees(old.fov):.1f}° → {math.degrees(new.fov):.1f}°")
    elif old.fov != new.fov or old.intrinsic != new.intrinsic:
        said.append("another lens")
    if (old.width, old.height) != (new.width, new.height):
        said.append(f"{old.width} × {old.height} → {new.width} × {new.height}")
    for name, was, now in (("near", old.near, new.near), ("far", old.far, new.far)):
        if was != now:
            said.append(f"{name} {was:g} → {now:g} m")
    if old.shader_pack != new.shader_pack:
        said.append(f"shader {old.shader_pack} → {new.shader_pack}")
    return said
