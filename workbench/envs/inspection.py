"""State of one env for a person, as plain data without a simulator."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Section = Literal["observation", "state", "joints", "contacts"]
SECTIONS: tuple[Section, ...] = ("observation", "state", "joints", "contacts")


@dataclass(frozen=True)
class Leaf:
    """One array of the observation or of the state dict, of one env."""

    name: str
    """Path of keys: ``agent/qpos``."""
    shape: tuple[int, ...]
    """Without the leading dimension N."""
    dtype: str
    values: NDArray
    """(K,) its first numbers, flattened; all of them unless it is as large as a picture."""
    low: float
    """Minimum; NaN if it is empty or holds a NaN."""
    high: float


@dataclass(frozen=True)
class JointReadings:
    """The active joints of one articulation. J joints; radians for revolute ones, metres for prismatic."""

    articulation: str
    names: tuple[str, ...]
    kinds: tuple[str, ...]
    """(J,) as SAPIEN says: ``revolute``, ``revolute_unwrapped``, ``prismatic``."""
    position: NDArray[np.float32]
    """(J,)"""
    velocity: NDArray[np.float32]
    """(J,) a second."""
    target: NDArray[np.float32]
    """(J,) of the position drive; NaN for a joint without one (no stiffness)."""
    low: NDArray[np.float32]
    """(J,) limits; infinite without one."""
    high: NDArray[np.float32]


@dataclass(frozen=True)
class Touching:
    """Contact of two bodies, over all their shapes, in the last substep."""

    bodies: tuple[str, str]
    force: NDArray[np.float32]
    """(3,) newtons ON the first body, BY the second; a mean over the substep; env's own frame."""
    impulse: NDArray[np.float32]
    """(3,) newton seconds on the first body."""
    points: NDArray[np.float32]
    """(K, 3) metres, env's own frame."""
    forces: NDArray[np.float32]
    """(K, 3) newtons on the first body at each point."""
    separation: float
    """Least distance between the surfaces, metres; negative if they overlap."""


@dataclass(frozen=True)
class Inspection:
    """The requested sections of one env at one moment."""

    env: int
    elapsed_steps: int
    """Control steps of its episode."""
    observation: tuple[Leaf, ...] | None = None
    state: tuple[Leaf, ...] | None = None
    joints: tuple[JointReadings, ...] | None = None
    contacts: tuple[Touching, ...] | None = None
    """Strongest first, of the last substep: after a reset, still of the one before it."""
    refused: tuple[tuple[Section, str], ...] = ()
    """Sections that could not be read, each with the reason."""
    milliseconds: float = 0.0
    """Time that reading took."""
