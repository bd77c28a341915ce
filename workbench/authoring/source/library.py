"""Library functions whose value hangs on their arguments alone, so that a call of one may be read and made again.

For the process that runs the author's code: it imports the simulator. Functions are known by identity, whatever a file
calls them.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import sapien
import torch
from mani_skill.utils import sapien_utils
from mani_skill.utils.structs.pose import Pose
from transforms3d import euler

from workbench.authoring.source.trace import Plain
from workbench.core import maniskill_private


@dataclass(frozen=True)
class Known:
    """A function that may be called again."""

    name: str = ""
    """What it is to be called; empty where nothing needs to tell it from others."""
    parameters: tuple[str, ...] = ()
    """In their order, of one whose arguments may be changed."""
    same: bool = False
    """Its value is its first argument's in another type, so that is what is changed."""


@cache
def known_functions() -> dict[Callable[..., Any], Known]:
    maniskill_private.mark_camera_configs()  # puts a look_at of its own before ManiSkill's, which others may have imported before
    same, number, look_at = Known(same=True), Known(), Known("look_at", ("eye", "target", "up", "device"))
    table: dict[Callable[..., Any], Known] = {
        sapien_utils.look_at: look_at,
        inspect.unwrap(sapien_utils.look_at): look_at,
        sapien.Pose: Known("pose", ("p", "q")),
        Pose.create_from_pq: Known("pose", ("p", "q", "device")),
        euler.euler2quat: Known("euler", ("ai", "aj", "ak", "axes")),
    }
    for function in (Pose.create, float, list, tuple, np.array, np.asarray, torch.tensor, torch.as_tensor):
        table[function] = same
    for name in ("sin", "cos", "tan", "sqrt", "radians", "degrees"):
        table[getattr(np, name)] = table[getattr(math, name)] = number
    for name in ("deg2rad", "rad2deg", "arctan", "arcsin", "arccos"):
        table[getattr(np, name)] = number
    for name in ("atan", "asin", "acos"):
        table[getattr(math, name)] = number
    return table


def plain(value: Any) -> Plain:
    """Numbers as floats, whatever holds them as tuples, a pose as its seven numbers.

    Raises:
        ValueError: it is nothing that a person writes as numbers.
    """
    if value is None or isinstance(value, str):
        return value
    if isinstance(value, sapien.Pose):
        return plain([*value.p, *value.q])
    if isinstance(value, Pose):
        return plain(value.raw_pose[0])
    if isinstance(value, (list, tuple)):
        return tuple(plain(item) for item in value)
    if isinstance(value, (int, float, np.number)) and not isinstance(value, bool):
        return float(value)
    if isinstance(value, (np.ndarray, torch.Tensor)):
        return plain(value.tolist())
    raise ValueError(f"a {type(value).__name__} is no number")
