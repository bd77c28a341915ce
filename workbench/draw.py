"""Draw into the workbench's 3-D view from any hook of a task. Without a workbench, these functions do nothing.

>>> from workbench import draw
>>> draw.points("grasp", self.grasp_pose.p)                       # in evaluate(): a point in every env
>>> draw.arrows("to goal", torch.stack([tcp, goal], dim=1))       # from tcp to goal
>>> draw.frames("spawn", pose, env_idx=env_idx)                   # in _initialize_episode: only these envs

Positions are in the frame of each env, in metres. The first dimension is the env: (N, ...), or (len(env_idx), ...) with
`env_idx`. A drawing stays until one of the same name replaces it; past moments and recordings show what was drawn then.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from workbench.envs.task_drawings import ITEM_SHAPES, MAX_ITEMS, Drawing, DrawingKind, drawings

ORANGE = "#ff922b"


def points(name: str, positions: Any, color: str = ORANGE, size: float = 0.01, env_idx: Any = None) -> None:
    """Draw points.

    Args:
        positions: (N, 3) or (N, K, 3).
        color: ``#rrggbb``.
        size: diameter in metres.
    """
    _draw("points", name, positions, color, size, env_idx)


def lines(name: str, segments: Any, color: str = ORANGE, env_idx: Any = None) -> None:
    """Draw lines.

    Args:
        segments: (N, 2, 3) or (N, K, 2, 3), start and end.
        color: ``#rrggbb``.
    """
    _draw("lines", name, segments, color, 0.0, env_idx)


def arrows(name: str, segments: Any, color: str = ORANGE, size: float = 0.01, env_idx: Any = None) -> None:
    """Draw arrows.

    Args:
        segments: (N, 2, 3) or (N, K, 2, 3), start and end.
        color: ``#rrggbb``.
        size: width in metres.
    """
    _draw("arrows", name, segments, color, size, env_idx)


def frames(name: str, poses: Any, size: float = 0.1, env_idx: Any = None) -> None:
    """Draw coordinate frames: x red, y green, z blue.

    Args:
        poses: a ManiSkill ``Pose``, or (N, 7) or (N, K, 7): position and quaternion wxyz.
        size: length of the axes in metres.
    """
    _draw("frames", name, getattr(poses, "raw_pose", poses), ORANGE, size, env_idx)


def text(name: str, positions: Any, texts: str | Sequence[str], env_idx: Any = None) -> None:
    """Draw a text in each env.

    Args:
        positions: (N, 3).
        texts: one text for all envs, or one for each.
    """
    _draw("text", name, positions, ORANGE, 0.0, env_idx, texts)


def remove(name: str) -> None:
    """Remove a drawing."""
    drawings.remove(name)


def _draw(
    kind: DrawingKind,
    name: str,
    values: Any,
    color: str,
    size: float,
    env_idx: Any,
    texts: str | Sequence[str] = (),
) -> None:
    if not drawings.on:
        return
    data, item = _array(values), ITEM_SHAPES[kind]
    if data.shape[1:] == item:
        data = data[:, None]
    if data.ndim != 2 + len(item) or data.shape[2:] != item:
        wanted = ", ".join(map(str, item))
        raise ValueError(
            f"draw.{kind}({name!r}) got shape {_array(values).shape}; expected (N, {wanted}) or (N, K, {wanted})"
        )
    if data.shape[1] > MAX_ITEMS:
        raise ValueError(f"draw.{kind}({name!r}) got {data.shape[1]} per env; at most {MAX_ITEMS} are drawn")
    envs = None if env_idx is None else [int(env) for env in _array(env_idx).astype(int).ravel()]
    if envs is not None and len(envs) != len(data):
        raise ValueError(f"draw.{kind}({name!r}) got {len(data)} rows for {len(envs)} envs of env_idx")
    each = (texts,) * len(data) if isinstance(texts, str) else tuple(map(str, texts))
    if kind == "text" and len(each) != len(data):
        raise ValueError(f"draw.text({name!r}) got {len(each)} texts for {len(data)} envs")
    red, green, blue = bytes.fromhex(color.removeprefix("#"))
    drawings.put(name, Drawing(kind, data, (red, green, blue), float(size), each), envs)


def _array(values: Any) -> NDArray[np.float32]:
    """A copy on the host."""
    if hasattr(values, "detach"):
        values = values.detach().cpu().numpy()
    return np.array(values, np.float32)
