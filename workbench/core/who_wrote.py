"""Who wrote to the tensors of the simulation, for as long as the write may still be lost.

That a write is lost shows at the fetch after it, which is nobody's fault. So each write is kept with the frames that
led to it until its group of tensors is fetched or applied, and what goes wrong then is told at the line that wrote. A
task may also take a whole tensor and write to it where nobody sees: then whoever took it is the one to name.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from workbench.core.broken_rule import Frame, frames_of_the_task
from workbench.core.mirrors import Group

TENSORS: dict[str, tuple[Group, ...]] = {
    "cuda_rigid_body_data": ("bodies", "links"),
    "cuda_rigid_dynamic_data": ("bodies", "links"),
    "cuda_articulation_link_data": ("bodies", "links"),
    "cuda_articulation_qpos": ("joints",),
    "cuda_articulation_qvel": ("joints",),
    "cuda_articulation_qf": ("forces",),
    "cuda_articulation_target_qpos": ("targets",),
    "cuda_articulation_target_qvel": ("targets",),
}
_OWN_CODE = ("workbench.core.", "mani_skill.")


@dataclass(frozen=True)
class _Write:
    """To some rows of a group; it may still be applied."""

    group: Group
    rows: NDArray[np.int64] | None
    """Rows of the group's tensor; None where the whole tensor was handed out."""
    frames: tuple[Frame, ...]
    """Innermost first."""


class Writes:
    """Those that were neither applied nor fetched over."""

    def __init__(self) -> None:
        self._kept: list[_Write] = []

    def __bool__(self) -> bool:
        return bool(self._kept)

    def note(self, group: Group, rows: NDArray[np.int64]) -> None:
        """Whoever calls the core now writes these rows."""
        self._kept.append(_Write(group, rows, frames_of_the_task()))

    def note_handed_out(self, tensor: str) -> None:
        """Whoever reads the attribute that this is called from has the whole tensor; not told of the core's own code."""
        reader = sys._getframe(2)
        if not reader.f_globals.get("__name__", "").startswith(_OWN_CODE):
            frames = frames_of_the_task(reader)
            self._kept.extend(_Write(group, None, frames) for group in TENSORS[tensor])

    def forget(self, group: Group) -> None:
        """They were applied, or fetched over."""
        if self._kept:
            self._kept = [write for write in self._kept if write.group != group]

    def forget_all(self) -> None:
        self._kept.clear()

    def frames(self, group: Group, rows: NDArray[np.int64]) -> tuple[Frame, ...]:
        """Of the last to write one of these rows, or to take the whole tensor; empty if none is known."""
        for write in reversed(self._kept):
            if write.group == group and write.rows is not None and np.isin(rows, write.rows).any():
                return write.frames
        for write in reversed(self._kept):
            if write.group == group and write.rows is None:
                return write.frames
        return ()
