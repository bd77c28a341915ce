"""One row an env: how its episode stands, what came of the one before, and what was odd about it.

The page shows one env's numbers and the batch's mean; neither says which of sixty-four envs to look at. This
does: it follows every reset and control step of the batch and keeps, for each env, the return so far, the
rewards for a small curve, the first step at which each bool of ``evaluate`` turned true, whether and how the
episode ended, and the outliers seen (`outliers`). A step costs array operations over the batch; sentences and
rows are made when somebody asks, and only for what is out of the ordinary.

An episode *ends* with the first step that is terminated or truncated. What happens after it (the player may let
it run on) does not change its outcome. With the usual rule the env is reset at once, and nobody would ever read
"failed" in its row; so a row also has the outcome of the episode before.

An env that is put back to a moment of the past has its row put back too: to what was said then (`Standing`), of the
env whose moment it is. Only the counts of episodes that ended go on, since those did end.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from workbench.core.step import StepResult
from workbench.session.history import History
from workbench.session.messages import Restored, Stepped, TaskDescription
from workbench.session.outliers import Kind, Outlier, OutlierWatch
from workbench.session.standing import LastEpisode, Standing

KEPT_REWARDS = 100
"""Steps of an episode whose rewards a row has; the newest where there are more."""


class Outcome(IntEnum):
    RUNNING = 0
    SUCCESS = 1
    FAIL = 2
    TRUNCATED = 3


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
    """(N,) undiscounted return so far; NaN after a reward that is."""
    followed: NDArray[np.bool_]
    """(N,) whether the episode was followed from its start; of another there is no return."""
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
        self._followed = np.ones(count, bool)
        self._first_true: dict[str, NDArray[np.int32]] = {}
        self._rewards = np.full((count, KEPT_REWARDS), np.nan, np.float32)
        self._outliers: dict[int, tuple[Outlier, ...]] = {}
        self._shown: dict[Kind, NDArray[np.bool_]] = {kind: np.zeros(count, bool) for kind in Kind}
        self._last = LastEpisode(np.zeros(count, np.int8), np.full(count, -1, np.int32), np.zeros(count), {})
        self._ended = np.zeros(count, np.int64)
        self._succeeded = np.zeros(count, np.int64)
        self._begin(np.ones(count, bool), first)

    def add(self, stepped: Stepped, history: History | None = None) -> None:
        """Take one event: a reset of some envs, a going back, or a control step of all.

        Args:
            history: that has this event as its newest moment, which is given the rows' standing; without it the
                rows of envs that go back begin anew, from where nobody can say what came before.
        """
        self._take(stepped, history)
        moment = None if history is None else history.at(history.last)
        if moment is not None:
            moment.standing = Standing(
                self._outcome,
                self._end,
                self._total,
                self._followed,
                self._first_true,
                self._outliers,
                self._last,
            )

    def _take(self, stepped: Stepped, history: History | None) -> None:
        step, reset = stepped.step, stepped.reset_mask
        self._serial += 1
        if reset.any():
            # A worker that came back with the very moment at which the one before it died resets nothing.
            resumed = (step.elapsed_steps == self._steps) & (self._steps > 0) & (stepped.restored is None)
            anew = (reset & ~resumed) | (step.elapsed_steps != self._steps)
            self._begin(anew, step)
            if stepped.restored is not None and history is not None:
                self._put_back(stepped.restored, history)
            return
        moved = step.elapsed_steps != self._steps + 1
        if moved.any():
            self._begin(moved, step)
        self._tick += 1
        self._steps = step.elapsed_steps.copy()
        self._total = self._total + np.where(self._end < 0, step.reward, 0.0)
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
            outcome=self._outcome,
            steps=self._steps.copy(),
            end=self._end,
            total=self._total,
            followed=self._followed,
            first_true=dict(self._first_true),
            rewards=self._rewards[:, oldest_first],
            outliers=dict(self._outliers),
            last=self._last,
            ended=self._ended.copy(),
            succeeded=self._succeeded.copy(),
        )

    def _begin(self, envs: NDArray[np.bool_], step: StepResult) -> None:
        """A new episode in these envs (N,): what was known of the one before becomes "last"."""
        worth_keeping = envs & ((self._end >= 0) | np.isin(np.arange(len(envs)), list(self._outliers)))
        if worth_keeping.any():
            kept = set(np.flatnonzero(worth_keeping).tolist())
            before = {env: seen for env, seen in self._last.outliers.items() if env not in kept}
            now = {env: seen for env, seen in self._outliers.items() if env in kept}
            self._last = LastEpisode(
                np.where(worth_keeping, self._outcome, self._last.outcome),
                np.where(worth_keeping, np.where(self._end < 0, self._steps, self._end), self._last.steps),
                np.where(worth_keeping, self._total, self._last.total),
                {**before, **now},
            )
            self._outliers = {env: seen for env, seen in self._outliers.items() if env not in kept}
        self._steps = np.where(envs, step.elapsed_steps, self._steps)
        self._outcome = np.where(envs, np.int8(Outcome.RUNNING), self._outcome)
        self._end = np.where(envs, np.int32(-1), self._end)
        self._total = np.where(envs, np.where(step.elapsed_steps == 0, 0.0, np.nan), self._total)
        self._followed = np.where(envs, step.elapsed_steps == 0, self._followed)
        self._rewards[envs] = np.nan
        for shown in self._shown.values():
            shown[envs] = False
        self._first_true = {
            name: np.where(envs, np.int32(-1), steps) for name, steps in self._first_true.items()
        }
        self._note_first_true(step, envs)
        self._watch.begin(envs, step)

    def _put_back(self, restored: Restored, history: History) -> None:
        """The rows of these envs as they stood at the moment that they went back to."""
        origin = history.at(restored.origin)
        then = None if origin is None else origin.standing
        if then is None:
            return  # it had to go from memory while the worker was at it
        envs, source = np.array(restored.env_idx), np.array(restored.source)
        self._outcome = _with(self._outcome, envs, then.outcome[source])
        self._end = _with(self._end, envs, then.end[source])
        self._total = _with(self._total, envs, then.total[source])
        self._followed = _with(self._followed, envs, then.followed[source])
        self._first_true = {
            name: _with(steps, envs, then.first_true[name][source]) if name in then.first_true else steps
            for name, steps in self._first_true.items()
        }
        gone = set(restored.env_idx)
        self._outliers = {env: seen for env, seen in self._outliers.items() if env not in gone}
        for env, of in zip(restored.env_idx, restored.source, strict=True):
            if of in then.outliers:
                self._outliers[env] = then.outliers[of]
            for kind, shown in self._shown.items():
                shown[env] = any(outlier.kind == kind for outlier in then.outliers.get(of, ()))
            rewards = history.rewards_until(of, restored.origin, KEPT_REWARDS)
            columns = np.arange(self._tick - len(rewards), self._tick) % KEPT_REWARDS
            self._rewards[env, columns] = rewards
        # The episode before is an env's own, whoever's moment it goes on from.
        own = envs[envs == source]
        mine, last = set(own.tolist()), self._last
        self._last = LastEpisode(
            _with(last.outcome, own, then.last.outcome[own]),
            _with(last.steps, own, then.last.steps[own]),
            _with(last.total, own, then.last.total[own]),
            {
                **{env: seen for env, seen in last.outliers.items() if env not in mine},
                **{env: seen for env, seen in then.last.outliers.items() if env in mine},
            },
        )

    def _note_first_true(self, step: StepResult, envs: NDArray[np.bool_]) -> None:
        for name, values in step.evaluate.items():
            if values.dtype != np.bool_ or values.ndim != 1:
                continue
            steps = self._first_true.get(name)
            if steps is None:
                steps = np.full(len(values), -1, np.int32)
                self._first_true = {**self._first_true, name: steps}
            now = values & (steps < 0) & envs
            if now.any():
                self._first_true = {**self._first_true, name: np.where(now, step.elapsed_steps, steps)}

    def _note_outliers(self, step: StepResult) -> None:
        for sight in self._watch.look(step):
            shown = self._shown[sight.kind]
            for env in np.flatnonzero(sight.envs & ~shown).tolist():
                outlier = Outlier(sight.kind, int(step.elapsed_steps[env]), sight.reason(env))
                self._outliers = {**self._outliers, env: (*self._outliers.get(env, ()), outlier)}
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
        self._outcome = np.where(ends, outcome, self._outcome).astype(np.int8)
        self._end = np.where(ends, step.elapsed_steps, self._end)
        self._ended += ends
        self._succeeded += ends & success


def _with(values: NDArray, envs: NDArray[np.int64], new: NDArray) -> NDArray:
    """A copy with other values for these envs."""
    changed = values.copy()
    changed[envs] = new
    return changed


def _flag(step: StepResult, name: str) -> NDArray[np.bool_]:
    values = step.evaluate.get(name)
    count = len(step.reward)
    return np.zeros(count, bool) if values is None else values.reshape(count, -1)[:, 0].astype(bool)
