"""Drive targets of the joints, which are written otherwise than the rest of the state.

A target that is set wakes a sleeping articulation even when its value stays, and ManiSkill's CPU controllers set
theirs on every control step. So what was ever driven is written at every apply, or a robot at rest would fall asleep
here and not there; and what nobody ever drove must not be, since it would never sleep. And they are many, 1200
calls a control step of 64 Pandas: in the envs' threads, just before the step, they cost nobody's waiting.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from workbench.core.cpu_layout import Layout

Setters = list[list[Callable[[float], None]]]
"""Of each articulation, of each of its active joints: what sets the target in PhysX."""


class DriveTargets:
    """Position, or velocity, targets of every articulation."""

    def __init__(self, layout: Layout, setters: Setters, articulations_of: Sequence[Sequence[int]]) -> None:
        """
        Args:
            articulations_of: the rows of each env.
        """
        self.now: NDArray[np.float32] = np.zeros(layout.qpos_at.shape, dtype=np.float32)
        """(A, D) the tensor that tasks write to."""
        self.seen = np.zeros_like(self.now)
        """(A, D) what the simulation is known to hold."""
        self.driven = np.zeros(len(layout.articulations), dtype=bool)
        """(A,) whether they were ever set."""
        self._articulations = layout.articulations
        self._setters = setters
        self._articulations_of = articulations_of

    def fetched(self, values: NDArray[np.float32]) -> None:
        self.now[:] = self.seen[:] = values

    def drop_writes(self) -> None:
        """Forget what was written to `now` and not applied."""
        self.now[:] = self.seen

    def apply(self, keep_awake: bool) -> tuple[bool, Callable[[int], None]]:
        """Take what was written.

        Args:
            keep_awake: write the targets of all that was ever driven, not only those that changed.

        Returns:
            Whether any changed; and what writes those of one env, to be called before its next step.

        Raises:
            ValueError: one of them is NaN or infinite.
        """
        changed = (self.now != self.seen).any(axis=1)
        self.driven |= changed
        chosen = np.flatnonzero(self.driven if keep_awake else changed).tolist()
        if not np.isfinite(self.now).all():
            for i in chosen:
                refuse_nan(self.now[i], self._articulations[i].name)
        self.seen[:] = self.now
        values, written = self.now.tolist(), set(chosen)

        def write(env: int) -> None:
            for i in self._articulations_of[env]:
                if i in written:
                    for set_target, value in zip(self._setters[i], values[i], strict=False):
                        set_target(value)

        return bool(changed.any()), write


def refuse_nan(values: NDArray[np.float32], name: str) -> None:
    # PhysX does not check: a NaN pose spreads to everything it touches and may crash the process.
    if not np.isfinite(values).all():
        raise ValueError(f"{name}: the state to be set holds NaN or infinity: {values}")
