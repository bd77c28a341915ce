"""Encode the pictures of a step while the next step is being made.

A picture of 128 x 128 in colour, depth and segmentation takes half a millisecond to encode, one of 512 x 512 eight; an env of sixteen with a
camera each would wait for that at every step. JPEG and zlib work without the interpreter's lock, so a few threads do
it meanwhile. What they have not begun is bounded: where they fall behind, whoever comes with the next picture encodes it, which is
what it would have cost anyway.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor

from numpy.typing import NDArray

from workbench.recording.encoded_pictures import Modality, encode
from workbench.recording.journal import Entry

MOST_BYTES = 8 << 20
"""Of pictures that are not encoded yet: a few hundredths of a second of work, which a killed process loses besides what its journal does."""


class _Pool:
    """The threads of this process."""

    def __init__(self) -> None:
        self._threads = ThreadPoolExecutor(
            max(1, min(4, (os.cpu_count() or 2) - 1)), thread_name_prefix="episode-pictures"
        )
        self._lock = threading.Lock()
        self._bytes = 0

    def encode(self, pictures: Sequence[tuple[str, int, Modality, NDArray]]) -> Future[list[Entry]]:
        size = sum(picture.nbytes for *_, picture in pictures)
        with self._lock:
            full = self._bytes > 0 and self._bytes + size > MOST_BYTES
            self._bytes += 0 if full else size
        if full:
            done: Future[list[Entry]] = Future()
            done.set_result(_entries(pictures))
            return done
        try:
            future = self._threads.submit(_entries, pictures)
        except BaseException:
            self._less(size)
            raise
        future.add_done_callback(lambda _: self._less(size))
        return future

    def _less(self, size: int) -> None:
        with self._lock:
            self._bytes -= size


_pool: _Pool | None = None
_making = threading.Lock()


def encode_soon(pictures: Sequence[tuple[str, int, Modality, NDArray]]) -> Future[list[Entry]]:
    """Journal entries of `pictures`: kind and number of the entry, modality, picture. Nobody may write to these any more."""
    global _pool
    with _making:
        if _pool is None:
            _pool = _Pool()
        pool = _pool
    return pool.encode(pictures)


def _entries(pictures: Sequence[tuple[str, int, Modality, NDArray]]) -> list[Entry]:
    return [Entry(kind, number, encode(modality, picture)) for kind, number, modality, picture in pictures]


def _forget() -> None:
    global _pool, _making
    _pool, _making = None, threading.Lock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget)  # the threads stay behind
