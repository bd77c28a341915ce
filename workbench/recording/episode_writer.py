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

from workbench.core.geometry import SceneGeometry
from workbench.core.pictures import CameraInfo, CameraKind, Picture
from workbench.core.step import OtherEntry
from workbench.recording.batch_rows import Layout
from workbench.recording.columns import RowPacker
from workbench.recording.encode_soon import encode_soon
from workbench.recording.encoded_pictures import MODALITIES, Modality
from workbench.recording.entry_texts import KIND as TEXT
from workbench.recording.entry_texts import TextWriter
from workbench.recording.episode import EpisodeInfo
from workbench.recording.journal import FOLDER, Entry, Journal
from workbench.recording.journal import Item as JournalItem
from workbench.recording.landing import RecordingError, reason
from workbench.recording.make_files import EpisodeFiles as EpisodeFiles
from workbench.recording.make_files import make_files
from workbench.recording.row import EpisodeRow
from workbench.recording.scene_file import keep_scene
from workbench.recording.survey import Header, header_text

SCENE_SUFFIX = ".scene"
NO_OTHERS: Mapping[str, OtherEntry] = MappingProxyType({})
_PIXELS: dict[Modality, tuple[tuple[int, ...], str, str]] = {
    "rgb": ((3,), "u", "(H, W, 3) of uint8"),
    "depth": ((), "f", "(H, W) of floats"),
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
        self._packer = RowPacker(len(geometry.body_names), len(self._header.action_names))
        self._cameras: dict[tuple[CameraKind, str], int] = {
            camera.key: index for index, camera in enumerate(self._header.cameras)
        }
        self._given: dict[int, tuple[Modality, ...]] = {}
        self._shared: dict[Layout, int] = {}
        self._encoded: dict[int | None, object] = {}
        """By camera, the form of pictures that `encode` has found well."""
        self._texts = TextWriter()
        self._states = 0
        self._written = False
        self._finished: EpisodeFiles | None = None
        path = self._folder / FOLDER / f"{info.id}.arrow"
        self._scene = path.with_suffix(SCENE_SUFFIX)
        try:
            self._journal = Journal(path)
            try:
                keep_scene(geometry, self._scene)
                self._journal.add("header", 0, header_text(self._header).encode())
                self._journal.commit()
            except OSError:
                self.discard()
                raise
        except OSError as error:
            raise self._failed(error) from error

    @property
    def info(self) -> EpisodeInfo:
        return self._header.info

    @property
    def folder(self) -> Path:
        return self._folder

    @property
    def bytes_written(self) -> int:
        """What the episode takes on the disk so far."""
        return self._journal.size

    def __len__(self) -> int:
        return max(self._states - 1, 0)

    def append(self, row: EpisodeRow) -> None:
        """The next state.

        Raises:
            ValueError: `row` does not fit the episode; the episode is as it was.
            RecordingError: the journal cannot be written any more (also of an earlier row, since writing lags behind).
        """
        if (row.action is None) != (self._states == 0):
            raise ValueError(
                "the first row is the state after a reset, which no action led to."
                if self._states == 0
                else f"step {self._states} has no action, so it cannot be replayed."
            )
        self._append(*self._packer.pack(row), row.pictures, row.others)

    def acted_by(self, what: str) -> None:
        """What chooses the actions from the next one on, where it is not what `info` says.

        Raises:
            RecordingError: as `append`.
        """
        try:
            self._journal.put("acted", len(self), what.encode())
        except OSError as error:
            raise self._failed(error) from error

    def append_steps(
        self, layout: Layout, packed: bytes, steps: int, pictures: Sequence[JournalItem] = ()
    ) -> None:
        """As `append`, with the rows of several steps one behind the other, and what `encode` gave for them."""
        if self._states == 0:
            raise ValueError("the first row is the state after a reset, which no action led to.")
        number, text = self._shared.get(layout), None
        if number is None:
            number, text = self._packer.number_of(layout.key)
        self._keep(number, packed, text, pictures)
        self._shared[layout] = number
        self._states += steps

    def encode(
        self, state: int, camera: tuple[CameraKind, str], pose: NDArray, images: Mapping[Modality, NDArray]
    ) -> list[JournalItem]:
        """The pictures of a state to come, on their way: for `append_steps`. Nobody may write to `images` any more.

        Args:
            images: as in a `Picture`, all that the camera gives; depth may be whole millimetres.

        Raises:
            ValueError: they do not fit the episode.
        """
        index = self._cameras.get(camera)
        form = (index, tuple([(name, image.shape, image.dtype) for name, image in images.items()]))
        if form != self._encoded.get(index):
            millimetres = images.get("depth")
            checked = dict(images)
            if millimetres is not None and millimetres.dtype.kind in "iu":
                checked["depth"] = millimetres.astype(np.float32)
            index = self._check(Picture(camera[1], camera[0], self.info.env_index, pose, **checked), {})
            self._given[index] = tuple(modality for modality in MODALITIES if modality in images)
            self._encoded[index] = form
        assert index is not None
        entry = Entry(f"camera/{index}", state, np.asarray(pose, dtype=np.float32).tobytes())
        return [
            entry,
            encode_soon([(f"picture/{index}/{m}", state, m, image) for m, image in images.items()]),
        ]

    def texts(self, state: int, others: Mapping[str, OtherEntry]) -> list[JournalItem]:
        """What a state to come says in texts: for `append_steps`. `others` as in an `EpisodeRow`; states in order."""
        return [Entry(TEXT, *line) for line in self._texts.news(state, others)]

    def append_packed(
        self,
        layout: Layout,
        packed: bytes,
        pictures: Sequence[Picture] = (),
        others: Mapping[str, OtherEntry] = NO_OTHERS,
    ) -> None:
        """As `append`, with a row after the first that was packed together with those of other envs."""
        if self._states == 0:
            raise ValueError("the first row is the state after a reset, which no action led to.")
        number = self._shared.get(layout)
        # Nearly always: there is nothing but numbers, of a layout that is known.
        if number is not None and not pictures and not others and self._texts.is_silent:
            try:
                self._journal.put("row", number, packed)
            except OSError as error:
                raise self._failed(error) from error
            self._states += 1
            return
        text = None
        if number is None:
            number, text = self._packer.number_of(layout.key)
        self._append(number, packed, text, pictures, others)
        self._shared[layout] = number

    def _append(
        self,
        number: int,
        packed: bytes,
        layout: str | None,
        pictures: Sequence[Picture],
        others: Mapping[str, OtherEntry],
    ) -> None:
        try:
            given, items = self._pictures_of(pictures) if pictures else ({}, [])
        except ValueError:
            if layout is not None:
                self._packer.forget(number)
            raise
        self._keep(number, packed, layout, [*items, *self.texts(self._states, others)])
        self._given |= given
        self._states += 1

    def _keep(self, number: int, packed: bytes, layout: str | None, pictures: Sequence[JournalItem]) -> None:
        journal = self._journal
        try:
            for item in pictures:
                journal.take(item)
            if layout is not None:
                journal.add("layout", number, layout.encode())
            journal.add("row", number, packed)
            journal.commit()
        except OSError as error:
            journal.rollback()
            if layout is not None:
                self._packer.forget(number)
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
        if not self._written:
            try:
                self._journal.finish()
            except OSError as error:
                raise self._failed(error) from error
            self._written = True
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
        index = self._cameras.get((picture.kind, picture.camera))
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
