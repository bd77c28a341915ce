"""An episode while it happens: rows go in, and the files of a recording come out at the end.

Whoever records (the page, the command line, a wrapper around an env) has a row a step and must not wait for the disk, must
not fill the memory, and may be killed at any moment. So a row is checked, packed and handed to a `Journal`, its pictures to
`encode_soon`; that is all that a step pays for. The rest (`make_files`) is done once, when the episode is over, and may be done on another
thread.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from workbench.core.camera_data import CameraInfo, CameraKind, Picture
from workbench.core.env.step_result import OtherEntry
from workbench.core.scene.shapes import SceneGeometry
from workbench.recording.episode.columns import TEXT, Layout, TextWriter
from workbench.recording.episode.encoded_pictures import MODALITIES, Modality
from workbench.recording.episode.episode import EpisodeInfo
from workbench.recording.writing.encode_pool import encode_soon
from workbench.recording.writing.finish import EpisodeFiles as EpisodeFiles
from workbench.recording.writing.finish import make_files
from workbench.recording.writing.from_journal import Header, header_text
from workbench.recording.writing.journal import FOLDER, Entry, Journal, keep_scene
from workbench.recording.writing.journal import Item as JournalItem
from workbench.recording.writing.publish import RecordingError, reason

SCENE_SUFFIX = ".scene"
NO_OTHERS: Mapping[str, OtherEntry] = MappingProxyType({})
_PIXELS: dict[Modality, tuple[tuple[int, ...], str, str]] = {
    "rgb": ((3,), "u", "(H, W, 3) of uint8"),
    "depth": ((), "fi", "(H, W) of numbers"),
    "segmentation": ((), "iu", "(H, W) of integers"),
}
"""Shape of a pixel, kinds of numbers, and both in words."""


class EpisodeWriter:
    """`append` rows (the first is the state after the reset), then `finish` or `discard`.

    It has one owner at a time, which may hand it to another thread for `finish`. `len()` is the number of control steps so far.
    """

    def __init__(
        self,
        folder: Path,
        info: EpisodeInfo,
        geometry: SceneGeometry,
        segmentation: Mapping[int, str],
        action_names: Sequence[str],
        cameras: Sequence[CameraInfo],
    ) -> None:
        """`folder` is made if missing.

        Raises:
            RecordingError: nothing can be written there.
        """
        self._folder = Path(folder)
        self._header = Header(info, geometry, dict(segmentation), tuple(action_names), tuple(cameras))
        self._cameras: dict[tuple[CameraKind, str], int] = {
            camera.key: index for index, camera in enumerate(self._header.cameras)
        }
        self._given: dict[int, tuple[Modality, ...]] = {}
        self._layouts: dict[Layout, int] = {}
        self._texts = TextWriter()
        self._states = 0
        self._finished: EpisodeFiles | None = None
        path = self._folder / FOLDER / f"{info.id}.arrow"
        self._scene = path.with_suffix(SCENE_SUFFIX)
        try:
            self._journal = Journal(path)
            try:
                keep_scene(geometry, self._scene)
                self._journal.append(Entry("header", 0, header_text(self._header).encode()))
            except OSError:
                self.discard()
                raise
        except OSError as error:
            raise self._failed(error) from error

    @property
    def info(self) -> EpisodeInfo:
        return self._header.info

    @property
    def actions(self) -> int:
        """Numbers of an action."""
        return len(self._header.action_names)

    @property
    def bytes_written(self) -> int:
        """What the episode takes on the disk so far."""
        return self._journal.size

    def __len__(self) -> int:
        return max(self._states - 1, 0)

    def append(
        self,
        layout: Layout,
        row: bytes,
        pictures: Sequence[Picture] = (),
        others: Mapping[str, OtherEntry] = NO_OTHERS,
    ) -> None:
        """The next state, as `BatchPacker` packs it: the first is that after a reset, the others hold the action that led there.

        Args:
            pictures: of this env alone; every state keeps the modalities that the first picture of a camera had. They are
                encoded while the episode goes on, so nobody may write to them any more.
            others: its entries of ``evaluate()`` that are no rows, each as `OtherEntry.of_env` gives it.

        Raises:
            ValueError: it does not fit the episode; the episode is as it was.
            RecordingError: the journal cannot be written any more (also of an earlier row, since writing lags behind).
        """
        number = self._layouts.get(layout)
        items: list[JournalItem] = []
        given: dict[int, tuple[Modality, ...]] = {}
        if number is None:
            layout.check(self._header.bodies, self.actions)
            number = len(self._layouts)
            items.append(Entry("layout", number, layout.text.encode()))
        if pictures:
            given, encoded = self._pictures_of(pictures)
            items += encoded
        if others or not self._texts.is_silent:
            items += [Entry(TEXT, *line) for line in self._texts.news(self._states, others)]
        try:
            self._journal.append(*items, Entry("row", number, row))
        except OSError as error:
            raise self._failed(error) from error
        self._layouts[layout] = number
        self._given |= given
        self._states += 1

    def acted_by(self, what: str) -> None:
        """What chooses the actions from the next one on, where it is not what `info` says.

        Raises:
            RecordingError: as `append`.
        """
        try:
            self._journal.append(Entry("acted", len(self), what.encode()))
        except OSError as error:
            raise self._failed(error) from error

    def finish(self) -> EpisodeFiles:
        """Make the files of the episode so far, and be done; again after an error, if the cause is gone.

        Raises:
            ValueError: there is no state yet.
            RecordingError: they cannot be written; the journal stays for `recover`, nothing else does. `close` when
                there is no second try.
        """
        if self._finished is not None:
            return self._finished
        try:
            self._journal.finish()  # of one that is closed, since making the files failed, nothing is left to be written
        except OSError as error:
            raise self._failed(error) from error
        try:
            self._finished = make_files(self._journal.path, self._header, self._folder, self._states)
        except Exception:
            self._journal.sync()
            self.close()
            raise
        self.discard()
        return self._finished

    def close(self) -> None:
        """Let go of the episode as it is; `recover` finds what was written of it."""
        self._journal.close()

    def discard(self) -> None:
        """Forget the episode: nothing of it stays on the disk, but for the files that `finish` has made."""
        # What the disk does not let go of is left to `recover`: files that were made are no failure for it.
        for remove in (self._journal.remove, self._scene.unlink):
            with contextlib.suppress(OSError):
                remove()
        tidy(self._folder)

    def _pictures_of(
        self, pictures: Sequence[Picture]
    ) -> tuple[dict[int, tuple[Modality, ...]], list[JournalItem]]:
        """What each camera gave, and what is to go into the journal."""
        seen: dict[int, tuple[Modality, ...]] = {}
        for picture in pictures:
            seen[self._check(picture, seen)] = _given(picture)
        items: list[JournalItem] = []
        for (index, modalities), picture in zip(seen.items(), pictures):
            pose = np.asarray(picture.pose, dtype=np.float32).tobytes()
            items.append(Entry(f"camera/{index}", self._states, pose))
            items.append(
                encode_soon(
                    [(f"picture/{index}/{m}", self._states, m, getattr(picture, m)) for m in modalities]
                )
            )
        return seen, items

    def _check(self, picture: Picture, seen: Mapping[int, object]) -> int:
        index = self._cameras.get(picture.key)
        if index is None:
            raise ValueError(f"a picture of {picture.kind} camera {picture.camera}, which the task has not.")
        if index in seen:
            raise ValueError(f"camera {picture.camera} gave two pictures of one state.")
        info = self._header.cameras[index]
        given = _given(picture)
        for modality in given:
            self._check_numbers(info.name, modality, getattr(picture, modality))
            shape = getattr(picture, modality).shape
            if shape[:2] != (info.height, info.width):
                raise ValueError(
                    f"camera {info.name} gave a {modality} picture of {shape[1]} x {shape[0]}, "
                    f"but the camera is {info.width} x {info.height}."
                )
        before = self._given.get(index, given)
        if given != before or not given:
            raise ValueError(
                f"camera {info.name} gave {', '.join(before) or 'nothing'} first and now "
                f"{', '.join(given) or 'nothing'}; a recording keeps the same all through."
            )
        return index

    @staticmethod
    def _check_numbers(camera: str, modality: Modality, pixels: NDArray) -> None:
        """What an encoder would say later, when nobody knows any more of which step."""
        shape, kinds, what = _PIXELS[modality]
        if pixels.dtype.kind not in kinds or pixels.shape[2:] != shape or (shape and pixels.itemsize != 1):
            raise ValueError(
                f"camera {camera} gave a {modality} picture {pixels.shape} of {pixels.dtype}, not {what}."
            )

    def _failed(self, error: OSError) -> RecordingError:
        return RecordingError(
            f"Cannot record {self.info.task} to {self._folder}: {reason(error, self._folder)}"
        )


def tidy(folder: Path) -> None:
    """Take the folder of the journals away if nothing is in it."""
    try:
        os.rmdir(folder / FOLDER)
    except OSError:  # not empty, or not there
        pass


def _given(picture: Picture) -> tuple[Modality, ...]:
    return tuple(modality for modality in MODALITIES if getattr(picture, modality) is not None)
