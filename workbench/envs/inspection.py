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
    """Shape without the leading dimension N."""
    dtype: str
    values: NDArray
    """(K,) the first numbers of the flattened array, at most `inspect_env.MAX_VALUES`."""
    low: float
    """Minimum; NaN if the array is empty, contains a NaN or is not numeric."""
    high: float


@dataclass(frozen=True)
class JointReadings:
    """The J active joints of one articulation. Positions, targets and limits are in radians for revolute
    joints, in metres for prismatic joints."""

    articulation: str
    names: tuple[str, ...]
    kinds: tuple[str, ...]
    """(J,) SAPIEN's joint types: ``revolute``, ``revolute_unwrapped``, ``prismatic``."""
    position: NDArray[np.float32]
    """(J,)"""
    velocity: NDArray[np.float32]
    """(J,) rad/s or m/s."""
    target: NDArray[np.float32]
    """(J,) targets of the position drives; NaN for a joint without a position drive (no stiffness)."""
    low: NDArray[np.float32]
    """(J,) lower limits; infinite for a joint without a limit."""
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
class Overlap:
    """Two bodies inside each other."""

    bodies: tuple[str, str]
    """Names as in `SceneIndex.names`."""
    depth: float
    """Metres."""


@dataclass(frozen=True)
class LinkJoint:
    """The joint that moves a link against its parent."""

    name: str
    kind: str
    """SAPIEN's type: ``revolute``, ``revolute_unwrapped``, ``prismatic``."""
    low: float
    """Lower limit in radians or metres; infinite without a limit."""
    high: float
    origin: NDArray[np.float32]
    """(3,) in the link's frame, metres."""
    axis: NDArray[np.float32]
    """(3,) unit vector in the link's frame."""


@dataclass(frozen=True)
class BodyReadings:
    """Physical properties and velocities of one body. Of a static body only the shapes and materials are known."""

    name: str
    mass: float | None
    """Kilograms."""
    inertia: NDArray[np.float32] | None
    """(3,) principal moments, kg m²."""
    centre_of_mass: NDArray[np.float32] | None
    """(3,) in the body's frame, metres."""
    velocity: NDArray[np.float32] | None
    """(3,) m/s, in the env's own frame."""
    angular_velocity: NDArray[np.float32] | None
    """(3,) rad/s, in the env's own frame."""
    has_gravity: bool
    shapes: tuple[str, ...]
    """Kinds of the collision shapes: ``box``, ``convex mesh``."""
    materials: tuple[tuple[float, float, float], ...]
    """Distinct materials of the shapes: static friction, dynamic friction, restitution."""
    joint: LinkJoint | None = None
    """The joint that moves the body; None for a body that no joint moves."""


@dataclass(frozen=True)
class Inspection:
    """The requested sections of one env at one moment."""

    env: int
    elapsed_steps: int
    """Control steps since the env's reset."""
    observation: tuple[Leaf, ...] | None = None
    state: tuple[Leaf, ...] | None = None
    joints: tuple[JointReadings, ...] | None = None
    contacts: tuple[Touching, ...] | None = None
    """Contacts of the last substep, strongest first; after a reset, still those from before the reset."""
    body: BodyReadings | None = None
    """The selected body; None if none was requested, or the env has no such body."""
    refused: tuple[tuple[Section, str], ...] = ()
    """Sections that could not be read, each with the reason."""
    milliseconds: float = 0.0
    """Time that reading took."""
