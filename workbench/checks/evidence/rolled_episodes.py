"""Episodes of a task that are rolled out in batches, and the actors in them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from workbench.envs.outliers import OutlierKind, OutlierWatch
from workbench.envs.step_result import StepResult
from workbench.envs.task_env import TaskEnv


class Actor(Protocol):
    """Acts in K episodes of a task."""

    @property
    def kind(self) -> str:
        """Word for a sentence: ``random``, ``given``."""
        ...

    @property
    def seeds(self) -> Sequence[int]:
        """(K,) seed of each episode."""
        ...

    @property
    def lengths(self) -> Sequence[int]:
        """(K,) maximum number of control steps of each episode."""
        ...

    def begin(self, task: TaskEnv, episodes: Sequence[int]) -> StepResult:
        """Reset each env to the start of its episode.

        Args:
            episodes: (N,) index of the episode of each env; the last episode may occur several times.

        Raises:
            TaskError: the task raised.
        """
        ...

    def next_action(self, task: TaskEnv, step: int) -> NDArray[np.float32]:
        """(N, A) actions for the episodes that were begun last; the actions of an episode that is over are ignored.

        Raises:
            TaskError: the actor raised; the problem's stage is ``policy``.
        """
        ...


@dataclass(frozen=True)
class SeenOutlier:
    """An outlier of an episode."""

    kind: OutlierKind
    step: int
    """1-based control step."""
    seed: int
    reason: str
    """Text as in `Outlier.reason`."""
    body: str
    """Name of the body, as in `SceneIndex.names`; empty if the outlier is not of a body."""


@dataclass
class Episodes:
    """K episodes over T control steps; episode k has the seed ``seeds[k]``. The leading dimension is T + 1 for states, T for
    rewards. An episode that has ended gets further steps, as in stock ManiSkill; `length` says where it
    ended. Once an episode has no more actions, its last state and reward are repeated."""

    kind: str = "random"
    """Kind of the actor, as `Actor.kind`."""
    seeds: list[int] = field(default_factory=list)
    poses: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 0, 0, 7), np.float32))
    """(T + 1, K, B, 7) position in metres, quaternion wxyz; bodies as `Checkup.bodies`."""
    qpos: NDArray[np.float32] | None = None
    """(T + 1, K, J); None without joints."""
    evaluate: dict[str, NDArray] = field(default_factory=dict)
    """Entries of ``evaluate()``, each (T + 1, K, ...)."""
    reward: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 0), np.float32))
    """(T, K)"""
    obs: dict[str, NDArray[np.float64]] = field(default_factory=dict)
    """Observations, (T + 1, K, D) by leaf, without pictures."""
    length: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    """(K,) number of control steps until the episode ended; T if it did not."""
    outliers: tuple[SeenOutlier, ...] = ()
    """The first outlier of each kind in each episode, before the end of the episode; in random rollouts only."""


class SeenOutliers:
    """Notes the outliers of one batch of episodes."""

    def __init__(self, watch: OutlierWatch, seeds: list[int]) -> None:
        self._watch, self._seeds = watch, seeds
        self._seen: dict[tuple[OutlierKind, int], SeenOutlier] = {}

    def take(self, step: int, now: StepResult, over: NDArray[np.bool_]) -> None:
        """Look at a control step.

        Args:
            over: (N,) whether each env's episode has ended; outliers of an ended episode do not count.
        """
        for sight in self._watch.check(now):
            for env in np.flatnonzero(sight.envs & ~over).tolist():
                if (sight.kind, env) not in self._seen:
                    body = "" if sight.body is None else sight.body(env)
                    seen = SeenOutlier(sight.kind, step, self._seeds[env], sight.reason(env), body)
                    self._seen[sight.kind, env] = seen

    def all(self) -> list[SeenOutlier]:
        return list(self._seen.values())


def stacked(
    kind: str,
    seeds: list[int],
    lengths: Sequence[int],
    steps: int,
    states: list[StepResult],
    rewards: list[NDArray[np.float32]],
    obs: list[dict[str, NDArray[np.float64]]],
    ended: NDArray[np.int64],
    outliers: Iterable[SeenOutlier],
) -> Episodes:
    """The episodes of one batch, which ran in the first ``len(seeds)`` envs.

    Args:
        lengths: number of control steps for which each episode had actions.
        steps: T.
        ended: (N,) as `Episodes.length`.
    """
    count = len(seeds)
    names = [name for name in states[0].evaluate if all(name in state.evaluate for state in states)]
    # Entries that the reward adds exist from the first step on, not after the reset.
    late = [name for name in states[-1].evaluate if name not in names]
    leaves = [name for name in obs[0] if all(name in one for one in obs)]
    envs = np.arange(count)
    row = np.minimum(np.arange(steps + 1)[:, None], np.array(lengths)[None])

    def of_states(rows: list[NDArray]) -> NDArray:
        return np.stack(rows)[row, envs]

    return Episodes(
        kind=kind,
        seeds=list(seeds),
        poses=of_states([state.poses for state in states]),
        qpos=None if states[0].qpos is None else of_states([s.qpos for s in states if s.qpos is not None]),
        evaluate={
            **{name: of_states([state.evaluate[name] for state in states]) for name in names},
            **{
                name: of_states([state.evaluate[name] for state in [states[1], *states[1:]]])
                for name in late
                if all(name in state.evaluate for state in states[1:])
            },
        },
        reward=np.stack(rewards)[row[1:] - 1, envs] if rewards else np.zeros((0, count), np.float32),
        obs={name: of_states([one[name] for one in obs]) for name in leaves},
        length=np.minimum(ended[:count], np.array(lengths)),
        outliers=tuple(outliers),
    )


def joined(parts: list[Episodes]) -> Episodes:
    """The episodes of all batches."""
    names = [name for name in parts[0].evaluate if all(name in part.evaluate for part in parts)]
    leaves = [name for name in parts[0].obs if all(name in part.obs for part in parts)]
    qpos = [part.qpos for part in parts if part.qpos is not None]
    return replace(
        parts[0],
        seeds=[seed for part in parts for seed in part.seeds],
        poses=np.concatenate([part.poses for part in parts], axis=1),
        qpos=np.concatenate(qpos, axis=1) if len(qpos) == len(parts) else None,
        evaluate={name: np.concatenate([part.evaluate[name] for part in parts], axis=1) for name in names},
        reward=np.concatenate([part.reward for part in parts], axis=1),
        obs={name: np.concatenate([part.obs[name] for part in parts], axis=1) for name in leaves},
        length=np.concatenate([part.length for part in parts]),
        outliers=tuple(seen for part in parts for seen in part.outliers),
    )
