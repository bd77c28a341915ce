"""Result of one control step of the whole batch, as plain arrays."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class OtherEntry:
    """An entry of ``evaluate()`` that is no array of real numbers with a row for each env: None, a string, a mean."""

    what: str
    """Its type, for a person: ``None``, ``str``, ``float32 tensor of shape ()``."""
    texts: tuple[str, ...] = ()
    """Its value, one for the whole batch or, `per_env`, one for each env; empty where `numbers` says it."""
    numbers: NDArray | None = None
    """(...) booleans or real numbers of the whole batch; None where it is no number."""
    per_env: bool = False
    whole: bool = True
    """False where `texts` is only a part of the value, since the rest is too long."""

    def of_env(self, env: int) -> OtherEntry:
        """What one env has of it; of an entry that is not per env all of it."""
        return replace(self, texts=(self.texts[env],)) if self.per_env else self

    @property
    def nbytes(self) -> int:
        """Roughly what it takes in memory."""
        return 200 + sum(map(len, self.texts)) + (0 if self.numbers is None else self.numbers.nbytes)


@dataclass(frozen=True)
class StepResult:
    """The state of all N envs after a reset or a control step. Leading dimension is always N."""

    elapsed_steps: NDArray[np.int32]
    """(N,) control steps since each env's reset."""
    reward: NDArray[np.float32]
    """(N,); zero right after a reset."""
    terminated: NDArray[np.bool_]
    """(N,) success or fail, as ManiSkill defines it."""
    truncated: NDArray[np.bool_]
    """(N,) the time limit of ``@register_env(max_episode_steps=...)`` was reached."""
    evaluate: dict[str, NDArray]
    """The entries that ``evaluate()`` returned with a row for each env: booleans or real numbers, each (N, ...)."""
    poses: NDArray[np.float32]
    """(N, B, 7) of every body: position in metres, quaternion wxyz, env's own frame."""
    action: NDArray[np.float32] | None = None
    """(N, A) that led here; None right after a reset."""
    sound_obs: NDArray[np.bool_] | None = None
    """(N,) whether all numbers of the env's observation are finite, pictures left out; None where nothing is known
    of it."""
    others: dict[str, OtherEntry] = field(default_factory=dict)
    """The entries that it returned otherwise; no name is in `evaluate` too."""

    @property
    def nbytes(self) -> int:
        """Roughly what it takes in memory."""
        arrays = [self.elapsed_steps, self.reward, self.terminated, self.truncated, self.poses]
        arrays += [*self.evaluate.values()] + ([] if self.action is None else [self.action])
        return sum(value.nbytes for value in (*arrays, *self.others.values()))
