"""Reads the random generators of a running task, and restores them."""

from __future__ import annotations

import ctypes
import random
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch

_KEY = 624
_WORDS = ctypes.c_char * 16
"""Words 1 to 4 of the key in numpy's ``mt19937_state``. The key is 624 words of 4 bytes; the position in it
follows. A draw advances the position; the last draw of a key regenerates all words. Word 0 is the same for
every seed."""
_POSITION = ctypes.c_char * 4
_HAS_GAUSS = 3
"""Index in ``RandomState.get_state()`` of the flag for a cached normal number."""

RngState = tuple[Any, ...]
"""State of a generator, as returned by ``RandomState.get_state()``."""


class SharedRng(NamedTuple):
    """The generators of the process: torch's, numpy's and Python's.

    They belong to no env: the author's training loop uses them as much as the task does. So they are restored
    only together with all envs.
    """

    torch_cpu: np.ndarray
    torch_device: np.ndarray | None
    """State of the CUDA generator of the env's device; None for an env on the CPU."""
    numpy: RngState
    python: Any


@dataclass
class _ReadStates:
    generators: list[np.random.RandomState]
    """Generators, kept alive since their memory is read by address."""
    memory: list[ctypes.Array[ctypes.c_char]]
    """Views of the numbers that distinguish states: some words of the key, and the position."""
    copied: bytes
    """Content of `memory` at the last read."""
    states: list[RngState]
    settled: bool
    """Whether no generator holds a cached normal number."""


class RngReader:
    """Reads the generators of one env object, and caches the result.

    ``RandomState.get_state`` takes 55 us per generator, for 64 envs a third of a control step. So a generator
    is read only if its position or words 1 to 4 of its key changed. These bytes are compared in memory (0.2
    us, at numpy's public ``BitGenerator.ctypes.state_address``; the whole keys of many envs do not fit into a
    core's cache). One exception: numpy caches every second normal number, and drawing it changes none of
    these bytes. While a normal number is cached, all generators are read.
    """

    def __init__(self) -> None:
        self._seen: dict[str, _ReadStates] = {}

    def read(self, purpose: str, generators: list[np.random.RandomState]) -> list[RngState]:
        """``get_state()`` of each generator; `purpose` is the name under which the list is cached."""
        seen = self._seen.get(purpose)
        if seen is not None and seen.settled and seen.generators == generators:
            if b"".join(seen.memory) == seen.copied:
                return seen.states
        states: list[RngState] = [generator.get_state() for generator in generators]  # type: ignore[misc]
        bit_generators = [generator._bit_generator for generator in generators]
        # Other bit generators have another memory layout.
        if all(isinstance(b, np.random.MT19937) for b in bit_generators):
            places = [b.ctypes.state_address for b in bit_generators]
            memory = [
                view
                for place in places
                for view in (_WORDS.from_address(place + 4), _POSITION.from_address(place + 4 * _KEY))
            ]
            settled = not any(state[_HAS_GAUSS] for state in states)
            self._seen[purpose] = _ReadStates(list(generators), memory, b"".join(memory), states, settled)
        return states

    def write(
        self,
        purpose: str,
        generators: list[np.random.RandomState],
        env_idx: list[int],
        states: list[RngState],
    ) -> None:
        """Restore the generators of some envs, in place: ManiSkill has several references to the first env's
        generator."""
        now = list(self.read(purpose, generators))
        for i, state in zip(env_idx, states, strict=True):
            if now[i] is not state:
                generators[i].set_state(state)
                now[i] = state
        seen = self._seen.get(purpose)
        if seen is not None:
            # So that a second restore of the same snapshot has nothing to write.
            seen.states, seen.copied = now, b"".join(seen.memory)
            seen.settled = not any(state[_HAS_GAUSS] for state in now)


def read_shared_rng(device: torch.device) -> SharedRng:
    # The functions of np.random are methods of this generator.
    (numpy_state,) = _shared_reader.read("numpy", [np.random.get_state.__self__])  # type: ignore[attr-defined]
    return SharedRng(
        torch.get_rng_state().numpy(),
        torch.cuda.get_rng_state(device).numpy() if device.type == "cuda" else None,
        numpy_state,
        random.getstate(),
    )


def write_shared_rng(state: SharedRng, device: torch.device) -> None:
    torch.set_rng_state(torch.from_numpy(state.torch_cpu.copy()))
    if state.torch_device is not None and device.type == "cuda":
        torch.cuda.set_rng_state(torch.from_numpy(state.torch_device.copy()), device)
    np.random.set_state(state.numpy)
    random.setstate(state.python)


_shared_reader = RngReader()
