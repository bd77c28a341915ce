"""One row an env: how its episode stands, what came of the one before, and what was odd about it.

The page shows one env's numbers and the batch's mean; neither says which of sixty-four envs to look at. This
does: it follows every reset and control step of the batch and keeps, for each env, the return so far, the
rewards for a small curve, the first step at which each bool of ``evaluate`` turned true, whether and how the
episode ended, and the outliers seen (`outliers`). A step costs array operations over the batch; sentences and
rows are made when somebody asks, and only for what is out of the ordinary.

An episode *ends* with the first step that is terminated or truncated. What happens after it (the player may let
it run on) does not change its outcome. With the usual rule the env is reset at once, and nobody would ever read
"failed" in its row; so a row also has the outcome of the episode before.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from workbench.core.step import StepResult
from workbench.session.messages import Stepped, TaskDescription
from workbench.session.outliers import Kind, Outlier, OutlierWatch

KEPT_REWARDS = 100
"""Steps of an episode whose rewards a row has; the newest where there are more."""


class Outcome(IntEnum):
    RUNNING = 0
    SUCCESS = 1
    FAIL = 2
    TRUNCATED = 3


@dataclass(frozen=True)
class LastEpisode:
    """The episode before the present one, of each env; only of those that ended or had outliers."""

    outcome: NDArray[np.int8]
    """(N,) `Outcome`; RUNNING where it was cut short, or there was none (then `steps` is -1)."""
    steps: NDArray[np.int32]
    """(N,) control steps until its end."""
    total: NDArray[np.float64]
    """(N,) its return until its end."""
    outliers: dict[int, tuple[Outlier, ...]]
    """By env; envs without any are not in it."""


@dataclass(frozen=True)
class EnvRows:
    """The whole table at one moment: copies, which later steps do not change."""

    serial: int
    """Grows with every reset and step."""
    tick: int
    """Control steps of the batch since the task was loaded."""
    outcome: NDArray[np.int8]
    """(N,) `Outcome` of the present episode, RUNNING until it ends."""
    steps: NDArray[np.int32]
    """(N,) control steps of the present episode."""
    end: NDArray[np.int32]
    """(N,) the step at which it ended; -1 while it runs."""
    total: NDArray[np.float64]
    """(N,) undiscounted return so far; NaN for an episode that was not followed from its start."""
    first_true: dict[str, NDArray[np.int32]]
    """By bool entry of ``evaluate``: (N,) the first step at which it was true (0: after the reset); -1: never."""
    rewards: NDArray[np.float32]
    """(N, `KEPT_REWARDS`) oldest first; NaN before the episode's start."""
    outliers: dict[int, tuple[Outlier, ...]]
    """By env, oldest first; envs without any are not in it."""
    last: LastEpisode
    ended: NDArray[np.int64]
    """(N,) episodes that ended since the task was loaded."""
    succeeded: NDArray[np.int64]
    """(N,) those of them that ended in success."""

    @property
    def num_envs(self) -> int:
        return len(self.steps)

    def tick_of(self, env: int, step: int) -> int:
        """The control step of the batch at which this env was at this step of its present episode."""
        return self.tick - (int(self.steps[env]) - step)


class EnvTable:
    """Follows the batch; `add` every event in order, ask for `rows` when they are to be shown."""

    def __init__(self, task: TaskDescription, first: StepResult) -> None:
        """
        Args:
            first: the state that the task was loaded with (a reset of all envs).
        """
        count = task.num_envs
        self._watch = OutlierWatch(task.geometry, first, task.control_dt, task.reward_mode)
        self._serial = 0
        self._tick = 0
        self._steps = first.elapsed_steps.copy()
        self._outcome = np.zeros(count, np.int8)
        self._end = np.full(count, -1, np.int32)
        self._total = np.zeros(count)
        self._first_true: dict[str, NDArray[np.int32]] = {}
        self._rewards = np.full((count, KEPT_REWARDS), np.nan, np.float32)
        self._outliers: dict[int, tuple[Outlier, ...]] = {}
        self._shown: dict[Kind, NDArray[np.bool_]] = {kind: np.zeros(count, bool) for kind in Kind}
        self._last_outcome = np.zeros(count, np.int8)
        self._last_steps = np.full(count, -1, np.int32)
        self._last_total = np.zeros(count)
        self._last_outliers: dict[int, tuple[Outlier, ...]] = {}
        self._ended = np.zeros(count, np.int64)
        self._succeeded = np.zeros(count, np.int64)
        self._begin(np.ones(count, bool), first)

    def add(self, stepped: Stepped) -> None:
        """Take one event: a reset of some envs, or a control step of all."""
        step, reset = stepped.step, stepped.reset_mask
        self._serial += 1
        if reset.any():
            # Envs that were put back to an earlier moment continue from where nobody can say what came before.
            self._begin(reset | (step.elapsed_steps != self._steps), step)
            return
        moved = step.elapsed_steps != self._steps + 1
        if moved.any():
            self._begin(moved, step)
        self._tick += 1
        self._steps = step.elapsed_steps.copy()
        self._total += np.where(self._end < 0, step.reward, 0.0)
        column = (self._tick - 1) % KEPT_REWARDS
        self._rewards[:, column] = step.reward
        self._note_first_true(step, np.ones(len(moved), bool))
        self._note_outliers(step)
        self._note_ends(step)

    def rows(self) -> EnvRows:
        """The table as it is now."""
        oldest_first = np.arange(self._tick, self._tick + KEPT_REWARDS) % KEPT_REWARDS
        return EnvRows(
            serial=self._serial,
            tick=self._tick,
            outcome=self._outcome.copy(),
            steps=self._steps.copy(),
            end=self._end.copy(),
            total=self._total.copy(),
            first_true={name: steps.copy() for name, steps in self._first_true.items()},
            rewards=self._rewards[:, oldest_first],
            outliers=dict(self._outliers),
            last=LastEpisode(
                self._last_outcome.copy(),
                self._last_steps.copy(),
                self._last_total.copy(),
                dict(self._last_outliers),
            ),
            ended=self._ended.copy(),
            succeeded=self._succeeded.copy(),
        )

    def _begin(self, envs: NDArray[np.bool_], step: StepResult) -> None:
        """A new episode in these envs (N,): what was known of the one before becomes "last"."""
        worth_keeping = envs & ((self._end >= 0) | np.isin(np.arange(len(envs)), list(self._outliers)))
        self._last_outcome[worth_keeping] = self._outcome[worth_keeping]
        self._last_steps[worth_keeping] = np.where(self._end < 0, self._steps, self._end)[worth_keeping]
        self._last_total[worth_keeping] = self._total[worth_keeping]
        for env in np.flatnonzero(worth_keeping).tolist():
            before = self._outliers.pop(env, ())
            self._last_outliers.pop(env, None)
            if before:
                self._last_outliers[env] = before
        self._steps = np.where(envs, step.elapsed_steps, self._steps)
        self._outcome[envs], self._end[envs] = Outcome.RUNNING, -1
        self._total[envs] = np.where(step.elapsed_steps[envs] == 0, 0.0, np.nan)
        self._rewards[envs] = np.nan
        for shown in self._shown.values():
            shown[envs] = False
        for steps in self._first_true.values():
            steps[envs] = -1
        self._note_first_true(step, envs)
        self._watch.begin(envs, step)

    def _note_first_true(self, step: StepResult, envs: NDArray[np.bool_]) -> None:
        for name, values in step.evaluate.items():
            if values.dtype != np.bool_ or values.ndim != 1:
                continue
            steps = self._first_true.get(name)
            if steps is None:
                steps = self._first_true[name] = np.full(len(values), -1, np.int32)
            now = values & (steps < 0) & envs
            steps[now] = step.elapsed_steps[now]

    def _note_outliers(self, step: StepResult) -> None:
        for sight in self._watch.look(step):
            shown = self._shown[sight.kind]
            for env in np.flatnonzero(sight.envs & ~shown).tolist():
                outlier = Outlier(sight.kind, int(step.elapsed_steps[env]), sight.reason(env))
                self._outliers[env] = (*self._outliers.get(env, ()), outlier)
            shown |= sight.envs

    def _note_ends(self, step: StepResult) -> None:
        ends = (step.terminated | step.truncated) & (self._end < 0)
        if not ends.any():
            return
        success = _flag(step, "success")
        # An env may be terminated by neither (a task with its own rule): that is no success.
        outcome = np.where(
            success, Outcome.SUCCESS, np.where(step.terminated, Outcome.FAIL, Outcome.TRUNCATED)
        )
        self._outcome[ends] = outcome[ends]
        self._end[ends] = step.elapsed_steps[ends]
        self._ended += ends
        self._succeeded += ends & success


def _flag(step: StepResult, name: str) -> NDArray[np.bool_]:
    values = step.evaluate.get(name)
    count = len(step.reward)
    return np.zeros(count, bool) if values is None else values.reshape(count, -1)[:, 0].astype(bool)
