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
    """(K,) the first of its numbers, flattened; all of them unless it is a picture or the like."""
    low: float
    """Least of all its numbers; NaN where there is none, or one of them is NaN."""
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
    """(J,) of the position drive; NaN for a joint that has none (no stiffness)."""
    low: NDArray[np.float32]
    """(J,) limits; infinite where there are none."""
    high: NDArray[np.float32]


@dataclass(frozen=True)
class Touching:
    """Two bodies that touch, over all their shapes, in the last substep."""

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
    """Metres between the surfaces where they are nearest; negative: they overlap."""


@dataclass(frozen=True)
class Inspection:
    """One env at one moment, as far as was asked."""

    env: int
    elapsed_steps: int
    """Control steps of its episode."""
    observation: tuple[Leaf, ...] | None = None
    state: tuple[Leaf, ...] | None = None
    joints: tuple[JointReadings, ...] | None = None
    contacts: tuple[Touching, ...] | None = None
    """Strongest first. Contacts are of the last substep: after a reset, still of the one before it."""
    refused: tuple[tuple[Section, str], ...] = ()
    """Sections that could not be read, and why, in a sentence."""
    milliseconds: float = 0.0
    """What the reading cost."""
