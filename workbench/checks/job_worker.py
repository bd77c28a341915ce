"""One process of a check: runs the rules of its chunks on its own envs."""

from __future__ import annotations

import random
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from workbench.actions.choose import STEPS_WITHOUT_LIMIT, RecordActionChooser, find_actions, plain_chooser
from workbench.checks.evidence.collect import CheckEnded, Checkup
from workbench.checks.job_items import CheckedTask, CheckOptions, CheckUpdate, Item, ItemOutcome, plan_of
from workbench.checks.rule_table import degree_of_each
from workbench.checks.run_rules import GPU_SIMULATION, check_gpu_rules, check_rule, findings_of
from workbench.envs.assets import require_assets, robots_of
from workbench.envs.recorded_run import RecordedRun
from workbench.envs.step_result import StepResult
from workbench.envs.task_env import TaskEnv, given_arguments
from workbench.episodes.replay import begin_run
from workbench.jobs.scheduler import Chunk, ItemQueue
from workbench.machine.folders import CurrentFolder
from workbench.task.blame import blamed
from workbench.task.load import LoadedTask, undo_load
from workbench.task.open import Opening, import_task
from workbench.task.problem import Problem, TaskError


def check_items(what: CheckOptions, queue: ItemQueue) -> None:
    """Check the chunks that one process gets. Raises the errors of `checks.job.check`."""
    torch.set_num_threads(1)  # see workbench.app.worker.main_loop.work
    here = CurrentFolder()  # the task may change it
    with here.again(), ExitStack() as stack:
        runs, _ = find_actions(what.actions, what.task)
        opening = Opening(lambda activity: queue.send_update(CheckUpdate(activity=activity)))
        loaded = import_task(what.task, what.options, None, opening)
        stack.callback(undo_load, loaded)
        _require_assets(loaded, what)
        worker = _Worker(what, loaded, runs, here, queue)
        queue.send_update(CheckUpdate(task=worker.task))
        stack.callback(worker.close)
        with suppress(CheckEnded):
            while (chunk := queue.next()) is not None:
                worker.check(chunk)


class _Worker:
    """Checks rules, with one `Checkup` for each part of the seeds."""

    def __init__(
        self,
        what: CheckOptions,
        loaded: LoadedTask,
        runs: Sequence[RecordedRun],
        here: CurrentFolder,
        queue: ItemQueue,
    ) -> None:
        """
        Args:
            runs: recorded runs to replay, from `find_actions`.
            here: the working directory at the start, in which a policy is looked up.
        """
        self._what, self._loaded, self._runs, self._here, self._queue = what, loaded, runs, here, queue
        self._degrees = degree_of_each(what.select, what.ignore, solve=what.solve)
        self._plan = plan_of(what, self._degrees)
        self._number = -1
        self._part = -1
        self._checkup: Checkup | None = None
        self.task = _described(loaded)

    def close(self) -> None:
        if self._checkup is not None:
            self._checkup.close()

    def check(self, chunk: Chunk) -> None:
        first = min(chunk.wanted)
        for number in sorted(chunk.wanted):
            self._number = number
            self._keep_going()
            item = self._plan.items[number]
            checkup = self._checkup_of(item.part)
            name, count = item.group.name, self._plan.parts
            activity = name if count == 1 else f"seeds, part {item.part + 1} of {count}: {name}"
            self._queue.send_update(CheckUpdate(activity=activity))
            task = self.task if number == first else None
            self._queue.send_result(number, self._checked(item, checkup, task))

    def _keep_going(self) -> None:
        if self._queue.limit() <= self._number:
            raise CheckEnded

    def _checkup_of(self, part: int) -> Checkup:
        if self._checkup is not None and part == self._part:
            return self._checkup
        self.close()
        # The random numbers that the task draws outside of resets must not depend on what this process did
        # before.
        random.seed(0)
        np.random.seed(0)
        torch.manual_seed(0)
        what, episodes = self._what, self._plan.episodes(part, self._what.seeds)
        given = (
            _Given(what, self._loaded, self._runs, self._here, episodes) if what.actions != "random" else None
        )
        self._part = part
        self._checkup = Checkup(
            self._loaded,
            what.options.env_kwargs,
            num_envs=what.options.num_envs,
            seeds=len(episodes),
            first_seed=what.options.seed + episodes.start,
            actors=[given] if given is not None and given.seeds else [],
            keep_going=self._keep_going,
        )
        return self._checkup

    def _checked(self, item: Item, checkup: Checkup, task: CheckedTask | None) -> ItemOutcome:
        known, silenced = len(checkup.findings), len(checkup.silenced)
        if item.group is GPU_SIMULATION:
            results = check_gpu_rules(checkup, self._degrees)
        else:
            (rule,) = item.rules
            results = check_rule(rule, item.group.checks[rule], checkup, self._degrees)
        return ItemOutcome(
            tuple(results),
            findings_of(checkup, known),
            tuple(checkup.silenced[silenced:]),
            checkup.picture_seconds,
            task,
        )


def _require_assets(loaded: LoadedTask, what: CheckOptions) -> None:
    """Raise TaskError if a download is missing. This ends the whole check: no line of the task is at
    fault."""
    given = given_arguments(loaded.cls, what.options.env_kwargs, loaded.default_kwargs)
    with blamed("build", loaded):
        require_assets(loaded.cls.__name__, loaded.asset_ids, robots_of(loaded.cls, given))


def _described(loaded: LoadedTask) -> CheckedTask:
    file = None if loaded.file is None else str(loaded.file)
    others = loaded.others if loaded.followed else ()
    notices = loaded.notices if loaded.followed else ()
    return CheckedTask(loaded.env_id, loaded.chosen, file, others, notices, loaded.source)


class _Given:
    """Actor for ``--actions``: a policy runs an episode of each seed, or the episodes of a file are
    replayed."""

    kind = "given"

    def __init__(
        self,
        what: CheckOptions,
        loaded: LoadedTask,
        runs: Sequence[RecordedRun],
        here: CurrentFolder,
        episodes: range,
    ) -> None:
        """
        Args:
            runs: recorded runs to replay, from `find_actions`; empty for a policy.
            here: the working directory at the start, in which a policy is looked up.
            episodes: indices of the episodes, counted over the whole check.

        Raises:
            TaskError: the policy cannot be imported.
        """
        self._loaded = loaded
        first = what.options.seed
        if runs:
            # A single run without a seed and without states: its actions are tried from each seed.
            from_seeds = len(runs) == 1 and runs[0].seed < 0 and not runs[0].env_states
            count = what.seeds if from_seeds else min(len(runs), what.seeds)
            chosen = {k: runs[k % len(runs)] for k in episodes if k < count}
            self._runs = [run if run.seed >= 0 else replace(run, seed=first + k) for k, run in chosen.items()]
            self.seeds, self.lengths = [run.seed for run in self._runs], [run.length for run in self._runs]
            self._chooser = RecordActionChooser(None)
        else:
            self._runs: list[RecordedRun] = []
            self.seeds = [first + k for k in episodes]
            self.lengths = [loaded.max_episode_steps or STEPS_WITHOUT_LIMIT] * len(episodes)
            chooser = plain_chooser(what.actions, what.task, first + episodes.start, here)
            self._chooser = RecordActionChooser(chooser)
        self._begun: list[int] = []

    def begin(self, task: TaskEnv, episodes: Sequence[int]) -> StepResult:
        self._begun = list(episodes)
        runs = {env: self._runs[k] for env, k in enumerate(episodes) if self._runs}
        for env, k in enumerate(episodes):
            self._chooser.begin(env, self.seeds[k], runs.get(env))
        if not runs:
            with blamed("reset", self._loaded, task):
                return task.reset([self.seeds[k] for k in episodes])
        begin_run(self._loaded, task, runs)
        with blamed("restore", self._loaded, task):
            return task.rescore()

    def next_action(self, task: TaskEnv, step: int) -> NDArray[np.float32]:
        running = {env: step for env, k in enumerate(self._begun) if step < self.lengths[k]}
        try:
            return self._chooser.next_action(task, running)
        except ValueError as error:
            raise TaskError(Problem("policy", str(error), None, None, None, "")) from error
