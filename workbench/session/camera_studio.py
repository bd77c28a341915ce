"""The camera studio: cameras placed by hand, judged over the batch, and written into the author's file.

The page calls the methods here, on any thread; each returns at once. What comes of them is in `StudioView`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from workbench.core.camera_settings import CameraKey, CameraKind, CameraSettings
from workbench.session.studio_view import StudioView


class CameraStudio:
    """See the module's text."""

    # --- placing -------------------------------------------------------------------------------------

    def select(self, key: CameraKey | None) -> None:
        """Choose the camera that the page works on."""

    def place(self, key: CameraKey, settings: CameraSettings, gesture: int | None = None) -> None:
        """Place a camera, live. Of placements faster than the worker only the newest is made.

        Args:
            gesture: calls with the same number, one behind the other, are one step of undo (a drag).
        """

    def undo(self) -> None:
        """Take the last step back."""

    def redo(self) -> None:
        """Make the step again that was taken back last."""

    def back_to_file(self, key: CameraKey) -> None:
        """Place a camera as the file says."""

    # --- into the file -------------------------------------------------------------------------------

    def plan_write(self, key: CameraKey) -> None:
        """Find the edit that writes the placement of a camera; it becomes `StudioView.writing`."""

    def plan_add(self, kind: CameraKind, name: str, settings: CameraSettings) -> None:
        """Find the edit that adds a camera."""

    def plan_duplicate(self, key: CameraKey, name: str) -> None:
        """Find the edit that adds a copy of a camera, placed as that one is now."""

    def plan_rename(self, key: CameraKey, name: str) -> None:
        """Find the edit that gives a camera another name."""

    def plan_remove(self, key: CameraKey) -> None:
        """Find the edit that removes a camera."""

    def write(self) -> None:
        """Make the planned edit; the file is reloaded, and the new camera compared with what was written."""

    def undo_write(self) -> None:
        """Take the edit that was made last out of the file again."""

    def drop_plan(self) -> None:
        """Forget the plan (or the message about the last one)."""

    # --- judged ----------------------------------------------------------------------------------------

    def judge(self, key: CameraKey, seeds: int = 0) -> None:
        """Judge a camera as it is placed over all envs.

        Args:
            seeds: 0 for the envs as they are now; else over so many freshly reset ones, in the background.
        """

    def suggest(
        self,
        key: CameraKey,
        objects: Sequence[str],
        low: tuple[float, float, float],
        high: tuple[float, float, float],
        seeds: int,
    ) -> None:
        """Search placements that see these objects over so many seeds, with the eye between two corners."""

    def take_suggestion(self, index: int) -> None:
        """Place the camera as suggested."""

    def stop(self) -> None:
        """Stop whatever runs in the background."""

    def compare(self, key: CameraKey, other: CameraSettings) -> None:
        """Two pictures of the shown env: the camera as it is, and as it would be with other settings."""

    def make_sheet(self, key: CameraKey) -> None:
        """The pictures of all envs by one camera."""

    def pick(self, key: CameraKey, u: float, v: float) -> None:
        """What is seen at a place of the picture: 0, 0 is its upper left corner, 1, 1 its lower right one."""

    # --- in other words --------------------------------------------------------------------------------

    def export(self, keys: Sequence[CameraKey], form: Literal["json", "opencv", "ros"]) -> str:
        """The cameras as they are placed, as the text of a file."""
        raise NotImplementedError

    def import_pose(self, key: CameraKey, text: str, direction: str, convention: str) -> None:
        """Place a camera as a calibration says.

        Raises:
            ValueError: with a sentence for the reader.
        """

    def view(self) -> StudioView:
        raise NotImplementedError
