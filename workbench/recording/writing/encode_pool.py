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

from workbench.recording.episode.encoded_pictures import Modality, encode
from workbench.recording.writing.journal import Entry

MOST_BYTES = 8 << 20
"""Of pictures that are not encoded yet: a few hundredths of a second of work, which a killed process loses besides what its journal does."""
_TOGETHER_BYTES = 1 << 20
"""Pictures are handed over so many at a time. A thread that is woken at every step for one small picture costs the step as much as
encoding it, and finds nothing of its own in the processor's caches: it takes three times as long (measured)."""

_Pictures = Sequence[tuple[str, int, Modality, NDArray]]


class Soon(Future[list[Entry]]):
    """Entries that will be there; to ask for them is to have them made."""

    def __init__(self, pool: _EncoderPool, pictures: _Pictures) -> None:
        super().__init__()
        self._pool, self._pictures = pool, pictures
        self.size = sum(picture.nbytes for *_, picture in pictures)

    def result(self, timeout: float | None = None) -> list[Entry]:
        if not self.done():
            self._pool.begin()
        return super().result(timeout)

    def make(self) -> None:
        pictures, self._pictures = self._pictures, ()
        try:
            self.set_result(
                [Entry(kind, number, encode(which, picture)) for kind, number, which, picture in pictures]
            )
        except BaseException as error:  # whoever waits for it has to know
            self.set_exception(error)


class _EncoderPool:
    """The threads of this process."""

    def __init__(self) -> None:
        self._threads = ThreadPoolExecutor(
            max(1, min(4, (os.cpu_count() or 2) - 1)), thread_name_prefix="episode-pictures"
        )
        self._lock = threading.Lock()
        self._bytes = 0
        self._gathered: list[Soon] = []
        self._gathered_bytes = 0

    def take(self, pictures: _Pictures) -> Soon:
        soon = Soon(self, pictures)
        with self._lock:
            full = self._bytes > 0 and self._bytes + soon.size > MOST_BYTES
            if not full:
                self._bytes += soon.size
                self._gathered.append(soon)
                self._gathered_bytes += soon.size
            enough = self._gathered_bytes >= _TOGETHER_BYTES
        if full:
            soon.make()
        if full or enough:
            self.begin()
        return soon

    def begin(self) -> None:
        """Hand over what has gathered."""
        with self._lock:
            gathered, self._gathered, self._gathered_bytes = self._gathered, [], 0
        if not gathered:
            return
        try:
            self._threads.submit(self._make, gathered)
        except RuntimeError:  # the interpreter is about to end, and its threads have
            self._make(gathered)

    def _make(self, gathered: list[Soon]) -> None:
        for soon in gathered:
            soon.make()
            with self._lock:
                self._bytes -= soon.size


_pool: _EncoderPool | None = None
_making = threading.Lock()


def encode_soon(pictures: _Pictures) -> Soon:
    """Journal entries of `pictures`: kind and number of the entry, modality, picture. Nobody may write to these any more."""
    global _pool
    with _making:
        if _pool is None:
            _pool = _EncoderPool()
        pool = _pool
    return pool.take(pictures)


def _forget() -> None:
    global _pool, _making
    _pool, _making = None, threading.Lock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget)  # the threads stay behind
