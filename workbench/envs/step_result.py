"""Result of one control step of the whole batch, as plain arrays."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from workbench.envs.task_drawings import Drawing

BodyPair = tuple[str, str]
"""Names of two bodies, as in `envs.scene.scene_index.SceneIndex.names`."""
TERM_PREFIX = "reward_terms/"
"""Prefix of the entries of a `StepResult` that are terms of a dense reward.

``compute_dense_reward`` puts them into ``info["reward_terms"]``, a dict of tensors (N,). The key is the
workbench's own, since ManiSkill has none for reward terms. ManiSkill passes ``info`` on unchanged, nested
dicts included, so the task's file also runs in stock ManiSkill. A term that is not one number per env is
listed in the table of numbers, without a curve.
"""


@dataclass(frozen=True)
class OtherEntry:
    """An entry of ``evaluate()`` that is not real numbers with a row for each env: None, a string, a mean."""

    what: str
    """Type as text: ``None``, ``str``, ``float32 tensor of shape ()``."""
    texts: tuple[str, ...] = ()
    """Value as text, one for the batch or, with `per_env`, one for each env; empty if there are `numbers`."""
    numbers: NDArray | None = None
    """(...) booleans or real numbers of the whole batch; None if the value is not numeric, or is too
    large."""
    per_env: bool = False
    whole: bool = True
    """False if `texts` is shortened."""

    def of_env(self, env: int) -> OtherEntry:
        """The entry with only the text of one env; unchanged if it is not `per_env`."""
        return replace(self, texts=(self.texts[env],)) if self.per_env else self

    @property
    def nbytes(self) -> int:
        """Approximate memory in bytes."""
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
    """(N, B, 7) pose of every body: position in metres, quaternion wxyz, env's own frame."""
    action: NDArray[np.float32] | None = None
    """(N, A) action that led to this state; None right after a reset."""
    sound_obs: NDArray[np.bool_] | None = None
    """(N,) whether the env's observation, without pictures, is finite; None if unknown."""
    qpos: NDArray[np.float32] | None = None
    """(N, J) positions of the joints of `envs.scene.scene_index.joint_names`, in rad or m; None if there are none."""
    others: dict[str, OtherEntry] = field(default_factory=dict)
    """All other entries of ``evaluate()``; no name is also in `evaluate`."""
    forces: dict[BodyPair, NDArray[np.float32]] = field(default_factory=dict)
    """(N,) newtons between the bodies of each watched pair, see `envs.contact_forces`."""
    drawn: dict[str, Drawing] = field(default_factory=dict)
    """What the task drew with `workbench.draw`, by name."""

    @property
    def nbytes(self) -> int:
        """Approximate memory in bytes."""
        return sum(map(_nbytes, vars(self).values()))


def _nbytes(
    value: Mapping[str, NDArray | OtherEntry | Drawing] | NDArray | OtherEntry | Drawing | None,
) -> int:
    if isinstance(value, Mapping):
        return sum(map(_nbytes, value.values()))
    return 0 if value is None else value.nbytes
