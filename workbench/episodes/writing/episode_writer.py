"""Records an episode while it runs: rows and pictures go in, the files of a recording come out."""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from types import MappingProxyType

import msgspec
import numpy as np
from numpy.typing import NDArray

from workbench.envs.camera_data import CameraInfo, CameraKey, CameraKind, CameraSettings, MovedCamera, Picture
from workbench.envs.scene.shapes import SceneGeometry
from workbench.envs.step_result import OtherEntry
from workbench.envs.task_drawings import Drawing
from workbench.episodes.columns import TEXT, Layout, TextWriter
from workbench.episodes.drawings import DRAWING, DrawingWriter
from workbench.episodes.encoded_pictures import Modality, encode
from workbench.episodes.episode import EpisodeInfo
from workbench.episodes.writing.files_process import FilesProcess
from workbench.episodes.writing.finish_or_recover import EpisodeFiles as EpisodeFiles
from workbench.episodes.writing.finish_or_recover import make_files
from workbench.episodes.writing.from_journal import Header, header_text
from workbench.episodes.writing.journal import (
    FOLDER,
    SCENE_SUFFIX,
    Journal,
    JournalEntry,
    JournalItem,
    remove_empty_folder,
    write_scene,
)
from workbench.episodes.writing.publish import RecordingError, reason

NO_OTHERS: Mapping[str, OtherEntry] = MappingProxyType({})
NO_DRAWINGS: Mapping[str, Drawing] = MappingProxyType({})
_PIXELS: dict[Modality, tuple[tuple[int, ...], str, str]] = {
    "rgb": ((3,), "u", "(H, W, 3) of uint8"),
    "depth": ((), "fi", "(H, W) of numbers"),
    "segmentation": ((), "iu", "(H, W) of integers"),
}
"""(shape of a pixel, dtype kinds, text of both for messages)."""


class EpisodeWriter:
    """Writes one episode: `append` rows, the state after the reset first, then call `finish` or `discard`.

    The caller must not wait for the disk, memory must stay bounded, and the process may be killed at any
    moment. So `append` only checks a row and queues it in a `Journal`; pictures go to `encode_async`.
    `finish` makes the files.

    Only one thread at a time may use a writer; `finish` may run on another thread than `append`. `len()` is
    the number of control steps.
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
        """Creates `folder` if it is missing.

        Raises:
            RecordingError: `folder` cannot be written to.
        """
        self._folder = Path(folder)
        self._header = Header(info, geometry, dict(segmentation), tuple(action_names), tuple(cameras))
        self._cameras: dict[tuple[CameraKind, str], int] = {
            camera.key: index for index, camera in enumerate(self._header.cameras)
        }
        self._given: dict[int, tuple[Modality, ...]] = {}
        self._layouts: dict[Layout, int] = {}
        self._texts, self._drawn = TextWriter(), DrawingWriter()
        self._states = 0
        self._finished: EpisodeFiles | None = None
        path = self._folder / FOLDER / f"{info.id}.arrow"
        self._scene = path.with_suffix(SCENE_SUFFIX)
        try:
            self._journal = Journal(path)
            try:
                write_scene(geometry, self._scene)
                self._journal.append(JournalEntry("header", 0, header_text(self._header).encode()))
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
        """Size of an action."""
        return len(self._header.action_names)

    @property
    def bytes_written(self) -> int:
        """Size of the journal."""
        return self._journal.size

    def __len__(self) -> int:
        return max(self._states - 1, 0)

    def append(
        self,
        layout: Layout,
        row: bytes,
        pictures: Sequence[Picture] = (),
        others: Mapping[str, OtherEntry] = NO_OTHERS,
        drawn: Mapping[str, Drawing] = NO_DRAWINGS,
    ) -> None:
        """Add a state as packed by `BatchPacker`: the first call adds the state after the reset, each later
        call a state with the action that led to it.

        Args:
            pictures: pictures of this env alone; later pictures of a camera must have the modalities of its
                first picture. The pictures are encoded in the background: do not modify them afterwards.
            others: `StepResult.others`, each entry as returned by `OtherEntry.of_env`.
            drawn: `StepResult.drawn`, each drawing as returned by `Drawing.of_env`.

        Raises:
            ValueError: the row does not fit the episode, which is unchanged.
            RecordingError: the journal could not be written. Writing is delayed, so an earlier row may have
                failed.
        """
        number = self._layouts.get(layout)
        items: list[JournalItem] = []
        given: dict[int, tuple[Modality, ...]] = {}
        if number is None:
            layout.check(self._header.bodies, self.actions)
            number = len(self._layouts)
            items.append(JournalEntry("layout", number, layout.text.encode()))
        if pictures:
            given, encoded = self._pictures_of(pictures)
            items += encoded
        if others or not self._texts.is_empty:
            items += [JournalEntry(TEXT, *line) for line in self._texts.changes(self._states, others)]
        items += [JournalEntry(DRAWING, *line) for line in self._drawn.changes(self._states, drawn)]
        try:
            self._journal.append(*items, JournalEntry("row", number, row))
        except OSError as error:
            raise self._failed(error) from error
        self._layouts[layout] = number
        self._given |= given
        self._states += 1

    def acted_by(self, what: str) -> None:
        """Set the source of the actions from the next action on.

        Raises:
            RecordingError: as `append` does.
        """
        try:
            self._journal.append(JournalEntry("acted", len(self), what.encode()))
        except OSError as error:
            raise self._failed(error) from error

    def placed(
        self, key: CameraKey, used: CameraSettings | None, in_file: CameraSettings | None = None
    ) -> None:
        """Record how a camera is placed from the next state on.

        Args:
            used: its settings; None for those in the task's description.
            in_file: its settings in the recorded source, if they differ from the description.

        Raises:
            RecordingError: as `append` does.
        """
        info = self._header.cameras[self._cameras[key]]
        if info.settings is None:
            return  # the file's settings of this camera cannot be expressed, and such a camera cannot be placed
        moved = MovedCamera(self._states, *key, used or info.settings, in_file or info.settings)
        try:
            self._journal.append(JournalEntry("placed", self._states, msgspec.json.encode(moved)))
        except OSError as error:
            raise self._failed(error) from error

    def finish(self, process: FilesProcess | None = None) -> EpisodeFiles:
        """Make the files of the episode, in `process` if possible. After an error, call `finish` again, or
        call `close`.

        Raises:
            ValueError: there is no state yet.
            RecordingError: the files cannot be written; only the journal stays, for `recover`.
        """
        if self._finished is not None:
            return self._finished
        try:
            self._journal.finish()  # writes nothing if an earlier call has written all
        except OSError as error:
            raise self._failed(error) from error
        try:
            self._finished = self._make_files(process)
        except BaseException:  # including panics of rerun
            self._journal.sync()
            self.close()
            raise
        self.discard()
        return self._finished

    def _make_files(self, process: FilesProcess | None) -> EpisodeFiles:
        made = process and process.make(self._journal, self._header, self._states)
        return made or make_files(
            self._journal.path, self._header, self._folder, self._states, again=process is not None
        )

    def close(self) -> None:
        """Close the journal, which stays for `recover`."""
        self._journal.close()

    def discard(self) -> None:
        """Delete everything of the episode except the files that `finish` made."""
        # A failed deletion is left to `recover`: it must not turn a finished recording into an error.
        for remove in (self._journal.remove, self._scene.unlink):
            with contextlib.suppress(OSError):
                remove()
        remove_empty_folder(self._folder)

    def _pictures_of(
        self, pictures: Sequence[Picture]
    ) -> tuple[dict[int, tuple[Modality, ...]], list[JournalItem]]:
        """Modalities by camera, and the entries for the journal."""
        seen: dict[int, tuple[Modality, ...]] = {}
        for picture in pictures:
            seen[self._check(picture, seen)] = tuple(_arrays_of(picture))
        items: list[JournalItem] = []
        for index, picture in zip(seen, pictures):
            pose = np.asarray(picture.pose, dtype=np.float32).tobytes()
            items.append(JournalEntry(f"camera/{index}", self._states, pose))
            items.append(
                encode_async(
                    [
                        (f"picture/{index}/{m}", self._states, m, pixels)
                        for m, pixels in _arrays_of(picture).items()
                    ]
                )
            )
        return seen, items

    def _check(self, picture: Picture, seen: Mapping[int, object]) -> int:
        index = self._cameras.get(picture.key)
        if index is None:
            raise ValueError(
                f"there is a picture of {picture.kind} camera {picture.camera}, which the task does not have."
            )
        if index in seen:
            raise ValueError(f"camera {picture.camera} gave two pictures of one state.")
        info = self._header.cameras[index]
        arrays = _arrays_of(picture)
        given = tuple(arrays)
        for modality, pixels in arrays.items():
            self._check_pixels(info.name, modality, pixels)
            shape = pixels.shape
            if shape[:2] != (info.height, info.width):
                raise ValueError(
                    f"camera {info.name} gave a {modality} picture of {shape[1]} x {shape[0]}, "
                    f"but the camera is {info.width} x {info.height}."
                )
        before = self._given.get(index, given)
        if given != before or not given:
            raise ValueError(
                f"camera {info.name} gave {', '.join(before) or 'nothing'} first and now "
                f"{', '.join(given) or 'nothing'}; within a recording its modalities must stay the same."
            )
        return index

    @staticmethod
    def _check_pixels(camera: str, modality: Modality, pixels: NDArray) -> None:
        """Check dtype and shape now: the encoder would fail later, when the step is unknown."""
        shape, kinds, what = _PIXELS[modality]
        if pixels.dtype.kind not in kinds or pixels.shape[2:] != shape or (shape and pixels.itemsize != 1):
            raise ValueError(
                f"camera {camera} gave a picture ({modality}) of shape {pixels.shape} and dtype {pixels.dtype}, not {what}."
            )

    def _failed(self, error: OSError) -> RecordingError:
        return RecordingError(
            f"Cannot record {self.info.task} to {self._folder}: {reason(error, self._folder)}"
        )


def _arrays_of(picture: Picture) -> dict[Modality, NDArray]:
    arrays: dict[Modality, NDArray | None] = {
        "rgb": picture.rgb,
        "depth": picture.depth,
        "segmentation": picture.segmentation,
    }
    return {modality: pixels for modality, pixels in arrays.items() if pixels is not None}


# --- pictures encoded on threads ---------------------------------------------------------------


MAX_PENDING_BYTES = 8 << 20
"""Maximum size of pictures that wait for a thread: a few hundredths of a second of work, which a killed process loses."""
_BATCH_BYTES = 1 << 20
"""Total size from which queued pictures are submitted to the threads together. Waking a thread at every step
for one small picture costs the step as much time as encoding the picture, and with cold caches the encoding
takes three times as long (measured)."""

_Pictures = Sequence[tuple[str, int, Modality, NDArray]]


class PendingEntries(Future[list[JournalEntry]]):
    """Entries that are being encoded; `result` submits them if they are still queued."""

    def __init__(self, pool: _EncoderPool, pictures: _Pictures) -> None:
        super().__init__()
        self._pool, self._pictures = pool, pictures
        self.size = sum(picture.nbytes for *_, picture in pictures)

    def result(self, timeout: float | None = None) -> list[JournalEntry]:
        if not self.done():
            self._pool.begin()
        return super().result(timeout)

    def make(self) -> None:
        pictures, self._pictures = self._pictures, ()
        try:
            self.set_result(
                [
                    JournalEntry(kind, number, encode(which, picture))
                    for kind, number, which, picture in pictures
                ]
            )
        except BaseException as error:
            self.set_exception(error)


class _EncoderPool:
    """Encodes pictures on a few threads: JPEG and zlib release the GIL.

    Encoding colour, depth and segmentation takes 0.5 ms for 128 x 128 and 8 ms for 512 x 512: without
    threads, each step would wait that long for each camera of each env. The queue is bounded; beyond the
    limit the caller encodes its own pictures.
    """

    def __init__(self) -> None:
        self._threads = ThreadPoolExecutor(
            max(1, min(4, (os.cpu_count() or 2) - 1)), thread_name_prefix="episode-pictures"
        )
        self._lock = threading.Lock()
        self._bytes = 0
        self._gathered: list[PendingEntries] = []
        self._gathered_bytes = 0

    def take(self, pictures: _Pictures) -> PendingEntries:
        pending = PendingEntries(self, pictures)
        with self._lock:
            full = self._bytes > 0 and self._bytes + pending.size > MAX_PENDING_BYTES
            if not full:
                self._bytes += pending.size
                self._gathered.append(pending)
                self._gathered_bytes += pending.size
            enough = self._gathered_bytes >= _BATCH_BYTES
        if full:
            pending.make()
        if full or enough:
            self.begin()
        return pending

    def begin(self) -> None:
        """Submit the queued pictures."""
        with self._lock:
            gathered, self._gathered, self._gathered_bytes = self._gathered, [], 0
        if not gathered:
            return
        try:
            self._threads.submit(self._make, gathered)
        except RuntimeError:  # the interpreter is shutting down and has ended its threads
            self._make(gathered)

    def _make(self, gathered: list[PendingEntries]) -> None:
        for pending in gathered:
            pending.make()
            with self._lock:
                self._bytes -= pending.size


_pool: _EncoderPool | None = None
_making = threading.Lock()


def encode_async(pictures: _Pictures) -> PendingEntries:
    """Encode `pictures`, each (kind and number of its journal entry, modality, picture), on threads. Do not
    modify the pictures afterwards."""
    global _pool
    with _making:
        if _pool is None:
            _pool = _EncoderPool()
        pool = _pool
    return pool.take(pictures)


def _reset_pool() -> None:
    global _pool, _making
    _pool, _making = None, threading.Lock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_reset_pool)  # a forked child lacks the threads
