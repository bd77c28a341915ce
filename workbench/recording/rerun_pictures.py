"""Pictures of an ``.rrd``, read where they lie when one is looked at.

An episode of ten thousand steps with four cameras is a few hundred megabytes of encoded pictures, and a review may have
sixty recordings open. The index of a file says where each chunk of pictures lies and which states it is of, so nothing
of a picture is read until somebody looks. Then its chunk is, a few megabytes, and kept for a while: whoever looks at a
picture looks at the next one next. What is kept is bounded for all recordings of the process together.

A file stays open for as long as its pictures may be asked for, so one that is deleted meanwhile can still be looked at.
"""

from __future__ import annotations

import os
import threading
from collections import OrderedDict
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from workbench.machine.regular_file import open_regular_file
from workbench.recording.encoded_pictures import EncodedPictures, LazyPictures, Modality, encode
from workbench.recording.rerun_chunks import STEP
from workbench.recording.rerun_seam import IndexedChunk, decode_chunk

KEPT_BYTES = 64 << 20
"""Of decompressed chunks, in the whole process; the newest is kept however large it is."""
MOST_ROWS = 1_000_000
"""Of a chunk: its index is believed before anything of it is read."""
PICTURE_COMPONENTS: dict[Modality, str] = {
    "rgb": "EncodedImage:blob",
    "depth": "EncodedDepthImage:blob",
    "segmentation": "SegmentationImage:buffer",
}


class OpenFile:
    """A file that can be read from any thread."""

    def __init__(self, path: Path) -> None:
        """Raises OSError."""
        self.name = path.name
        with open_regular_file(path) as file:
            self._descriptor = os.dup(file.fileno())

    def __del__(self) -> None:
        if hasattr(self, "_descriptor"):
            os.close(self._descriptor)

    def __reduce__(self) -> str:
        # The number of a descriptor means another file in another process, which would be closed with it.
        raise TypeError("An open recording cannot be sent to another process; send its path.")

    def chunk(self, place: IndexedChunk) -> pa.RecordBatch:
        """Raises OSError where it is no chunk."""
        content = os.pread(self._descriptor, place.end - place.begin, place.begin)
        try:
            return decode_chunk(content)
        except ValueError as error:
            raise OSError(f"{self.name} is damaged at byte {place.begin}: {error}") from error


class _Kept:
    """The chunks that were looked at last."""

    def __init__(self) -> None:
        self._chunks: OrderedDict[tuple[int, int], tuple[OpenFile, pa.Array]] = OrderedDict()
        self._bytes = 0
        self._lock = threading.Lock()

    def rows(self, file: OpenFile, place: IndexedChunk, component: str) -> pa.Array:
        """The rows of that component. Raises OSError."""
        # The file is kept with it, so its id is nobody else's.
        key = (id(file), place.begin)
        with self._lock:
            if key in self._chunks:
                self._chunks.move_to_end(key)
                return self._chunks[key][1]
        rows = file.chunk(place).column(component)
        with self._lock:
            if key not in self._chunks:
                self._chunks[key] = (file, rows)
                self._bytes += rows.nbytes
            while self._bytes > KEPT_BYTES and len(self._chunks) > 1:
                _, (_, gone) = self._chunks.popitem(last=False)
                self._bytes -= gone.nbytes
        return rows


_kept = _Kept()


def pictures_in(
    file: OpenFile, places: Sequence[IndexedChunk], modality: Modality, height: int, width: int
) -> tuple[NDArray[np.int64], EncodedPictures]:
    """One modality of one camera, and (P,) the state of each picture; `places` are its chunks, in order of time. Raises OSError."""
    component, ends = PICTURE_COMPONENTS[modality], np.cumsum([place.rows for place in places])

    def one(number: int) -> bytes:
        part = int(np.searchsorted(ends, number, side="right"))
        rows = _kept.rows(file, places[part], component)
        content = rows[number - int(ends[part]) + len(rows)].values[0].values.to_numpy().tobytes()
        if modality != "segmentation":
            return content
        # Plain ids, as the PNG that they were, or would have been.
        wide = len(content) == 4 * height * width
        ids = np.frombuffer(content, np.int32 if wide else np.uint16).reshape(height, width)
        return encode("segmentation", ids.astype(np.int32))

    frames = np.concatenate([_steps(file, place) for place in places])
    return frames, EncodedPictures(modality, LazyPictures(int(ends[-1]), one))


def _steps(file: OpenFile, place: IndexedChunk) -> NDArray[np.int64]:
    if place.rows > MOST_ROWS:
        raise OSError(f"{file.name} claims {place.rows:,} pictures in one piece")
    if place.steps is not None and place.steps[1] - place.steps[0] + 1 == place.rows:
        return np.arange(place.steps[0], place.steps[1] + 1)
    # A picture here and there: only the chunk itself says of which states.
    return file.chunk(place).column(STEP).cast(pa.int64(), safe=False).to_numpy()
