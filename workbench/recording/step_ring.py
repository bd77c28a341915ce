"""Steps that wait in memory to be taken apart together.

What a step has to say of a batch is a dozen arrays; taken apart env by env it is hundreds, and a journal entry each. So
a step is copied as it is, an array at a time, to its row of a block, and a block is taken apart when it is full, or when the journals
are about to be written: twice a second, on their thread. There are two blocks, one to fill while the other is taken apart.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_BLOCK_BYTES = 2 << 20
_MOST_STEPS = 512

Arrays = Sequence[tuple[str, NDArray]]


@dataclass(frozen=True)
class Steps:
    """Consecutive steps; good until whoever was given them returns."""

    arrays: dict[str, NDArray]
    """(K, ...) each, K above 0"""
    extras: list[object]
    """(K) whatever came with each."""


class _Block:
    def __init__(self, arrays: Arrays) -> None:
        size = sum(value.nbytes for _, value in arrays)
        self.steps = min(max(_BLOCK_BYTES // max(size, 1), 8), _MOST_STEPS)
        self.places = [
            (name, value.dtype, value.shape, np.empty((self.steps, *value.shape), value.dtype))
            for name, value in arrays
        ]
        self.extras: list[object] = []
        self.count = 0

    def put(self, arrays: Arrays, extra: object) -> bool:
        """False where `arrays` are not what this block is made for."""
        places, row = self.places, self.count
        if len(arrays) != len(places):
            return False
        for (name, value), (known, dtype, shape, place) in zip(arrays, places):
            if name != known or value.shape != shape or value.dtype != dtype:
                return False
            place[row] = value
        self.extras.append(extra)
        self.count = row + 1
        return True

    def taken(self) -> Steps:
        return Steps({name: place[: self.count] for name, _, _, place in self.places}, self.extras)

    def clear(self) -> None:
        self.count, self.extras = 0, []


class StepRing:
    """`take` belongs to one thread, `flush` to any."""

    def __init__(self, deliver: Callable[[Steps], None], learn: Callable[[Arrays], None]) -> None:
        """
        Args:
            deliver: gets the steps in order, on the thread of whoever flushes.
            learn: is told, on the thread that takes, of the first step of a kind that no step before was.
        """
        self._deliver, self._learn = deliver, learn
        self._blocks: list[_Block] = []
        """The first is being filled."""
        self._lock = threading.Lock()  # of the blocks; never held while one is delivered
        self._delivering = threading.Lock()
        self.error: Exception | None = None
        """What `deliver` raised; the steps from there on are lost."""

    def take(self, arrays: Arrays, extra: object = None) -> None:
        """The next step; the arrays are copied."""
        if not self._put(arrays, extra):
            self.flush()
            self._learn(arrays)
            with self._lock:
                self._blocks = [_Block(arrays), _Block(arrays)]
            self._put(arrays, extra)

    def _put(self, arrays: Arrays, extra: object) -> bool:
        with self._lock:
            if not self._blocks:
                return False
            block = self._blocks[0]
            if not block.put(arrays, extra):
                return False
            full = block.count == block.steps
        if full:
            self.flush()
        return True

    def flush(self) -> None:
        """Deliver what there is."""
        with self._delivering:
            with self._lock:
                if not self._blocks or not self._blocks[0].count:
                    return
                self._blocks.reverse()
                block = self._blocks[1]
            try:
                if self.error is None:
                    self._deliver(block.taken())
            except Exception as error:  # whoever takes has to hear of it, and this may be another thread
                self.error = error
            finally:
                block.clear()
