"""Checks rules and times a step in the worker, on separate envs."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING

from workbench.checks.questions import CheckedGroup, CheckGroup, ProfileStep, RuleProgress
from workbench.checks.results import StepProfile
from workbench.live.messages import CannotAnswer
from workbench.machine.processes.watched_thread import on_free_cores
from workbench.task.description import TaskOptions
from workbench.task.open import OpenedTask

if TYPE_CHECKING:
    from workbench.checks.evidence.collect import Checkup
    from workbench.checks.results import RuleResult
    from workbench.task.load import LoadedTask

OnProgress = Callable[[int, int, RuleProgress], None]
"""Progress callback (done, total, progress): number of results of this group so far; number of rules in all
groups, without the rules that are off; the rule that began or has its result."""
NUM_ENVS, SEEDS = 8, 32
"""Number of envs of a check (1 if the opened task has one env), and number of seeds."""


class WorkerChecks:
    """Checks groups of rules. Evidence about the loaded version is kept from one group to the next."""

    def __init__(self, waits: Callable[[], bool]) -> None:
        """
        Args:
            waits: returns whether a request is waiting; if so, the check ends.
        """
        self._waits = waits
        self._checkup: Checkup | None = None
        self._of: LoadedTask | None = None

    def answer(
        self,
        opened: OpenedTask,
        options: TaskOptions,
        question: CheckGroup | ProfileStep,
        on_progress: OnProgress,
    ) -> CheckedGroup | StepProfile:
        """
        Args:
            options: the options with which the task was loaded.

        Raises:
            CannotAnswer: another request came.
            TaskError: the task raised while a step was timed.
        """
        from workbench.checks.evidence.collect import CheckEnded
        from workbench.checks.evidence.time_step import profile_step

        checkup = self._checkup_of(opened, options)
        try:
            if isinstance(question, CheckGroup):
                with on_free_cores(self._waits):
                    return self._check(checkup, question, on_progress)
            return profile_step(checkup)
        except CheckEnded:
            raise CannotAnswer("another request came") from None

    def close(self) -> None:
        """Close the envs, and forget what was seen."""
        if self._checkup is not None:
            self._checkup.close()
        self._checkup = self._of = None

    def _check(self, checkup: Checkup, question: CheckGroup, on_progress: OnProgress) -> CheckedGroup:
        from workbench.checks.run_rules import (
            GPU_SIMULATION,
            GROUPS,
            check_gpu_rules,
            check_rule,
            findings_of,
            gpu_results,
        )

        degrees, groups = question.degrees, (*GROUPS, GPU_SIMULATION)
        total = sum(degree != "off" for degree in degrees.values())
        done = 0

        def begin(rule: str) -> None:
            on_progress(done, total, RuleProgress(rule))

        def report(rule: str, results: Iterable[RuleResult]) -> None:
            nonlocal done
            for result in results:
                done += 1
                on_progress(done, total, RuleProgress(rule, result))

        group = groups[question.group]
        for rule, check in group.checks.items():
            if degrees[rule] != "off" and rule not in question.known:
                begin(rule)
                report(rule, check_rule(rule, check, checkup, degrees))
        if group is GPU_SIMULATION:
            begin("")
            report("", check_gpu_rules(checkup, degrees))
            report("", gpu_results(findings_of(checkup), checkup.silenced, degrees))
            self.close()  # the last group: free the envs' memory
        following = question.group + 1
        return CheckedGroup(len(groups), total, groups[following].name if following < len(groups) else "")

    def _checkup_of(self, opened: OpenedTask, options: TaskOptions) -> Checkup:
        from workbench.checks.evidence.collect import Checkup  # late: the worker that plays never needs it

        loaded = opened.loaded
        if self._checkup is None or self._of is not loaded:
            self.close()
            self._checkup, self._of = (
                Checkup(
                    loaded,
                    options.env_kwargs,
                    num_envs=1 if opened.env.num_envs == 1 else NUM_ENVS,
                    seeds=SEEDS,
                    keep_going=self._keep_going,
                ),
                loaded,
            )
        return self._checkup

    def _keep_going(self) -> None:
        from workbench.checks.evidence.collect import CheckEnded

        if self._waits():
            raise CheckEnded
