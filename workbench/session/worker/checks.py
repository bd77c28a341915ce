"""Checks rules and times a step in the worker, on envs of their own."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from workbench.checks.results import StepProfile
from workbench.jobs.open_task import OpenedTask
from workbench.jobs.task import TaskOptions
from workbench.machine.processes.watched_thread import on_free_cores
from workbench.session.protocol.messages import CannotAnswer
from workbench.session.protocol.questions import CheckedGroup, CheckGroup, ProfileStep

if TYPE_CHECKING:
    from workbench.authoring.loading.load import LoadedTask
    from workbench.checks.evidence.checkup import Checkup
    from workbench.checks.results import RuleResult

OnResult = Callable[[int, int, "RuleResult"], None]
"""Gets the number of results so far in this group, the number of rules in all, and a result."""
NUM_ENVS, SEEDS = 8, 32


class _Ended(Exception):
    """A request waits: nobody needs the answer, or a job of higher priority needs the process."""


class WorkerChecks:
    """Keeps what was seen of the loaded version from one group of rules to the next."""

    def __init__(self, waits: Callable[[], bool]) -> None:
        """
        Args:
            waits: whether a request waits, which ends the check.
        """
        self._waits = waits
        self._checkup: Checkup | None = None
        self._of: LoadedTask | None = None

    def answer(
        self,
        opened: OpenedTask,
        options: TaskOptions,
        question: CheckGroup | ProfileStep,
        on_result: OnResult,
    ) -> CheckedGroup | StepProfile:
        """
        Args:
            options: with which the task was loaded.

        Raises:
            CannotAnswer: a request came, or a step of this task cannot be timed.
            TaskError: it raised while a step was timed.
        """
        checkup = self._checkup_of(opened.loaded, options)
        try:
            if isinstance(question, CheckGroup):
                with on_free_cores(self._waits):
                    return self._check(checkup, question, on_result)
            from workbench.checks.evidence.step_profile import profile_step

            return profile_step(checkup)
        except _Ended:
            raise CannotAnswer("another request came") from None

    def close(self) -> None:
        """Close its envs, and forget what was seen."""
        if self._checkup is not None:
            self._checkup.close()
        self._checkup = self._of = None

    def _check(self, checkup: Checkup, question: CheckGroup, on_result: OnResult) -> CheckedGroup:
        from workbench.checks.by_hook.run import CORE_GROUP, GROUPS, core_results, run_group

        degrees = question.degrees
        checked = {rule for group in GROUPS for rule in group.checks} | _core_rules()
        total = sum(degrees[rule] != "off" for rule in checked)
        names = [*(group.name for group in GROUPS), CORE_GROUP]
        if question.group < len(GROUPS):
            # A rule that other checks report too may be known and not have been checked itself.
            left = {
                rule: "off" if rule in question.known and rule != "runs" else of
                for rule, of in degrees.items()
            }
            results = run_group(GROUPS[question.group], checkup, left)  # type: ignore[arg-type]
        else:
            results = core_results(checkup.findings, checkup.silenced, degrees)
        for done, result in enumerate(results, 1):
            on_result(done, total, result)
        if question.group >= len(GROUPS):
            self.close()  # the memory is wanted elsewhere
        following = question.group + 1
        return CheckedGroup(len(names), total, names[following] if following < len(names) else "")

    def _checkup_of(self, loaded: LoadedTask, options: TaskOptions) -> Checkup:
        from workbench.checks.evidence.checkup import Checkup  # late: the worker that plays checks nothing

        if self._checkup is None or self._of is not loaded:
            self.close()
            self._checkup, self._of = (
                Checkup(
                    loaded, options.env_kwargs, num_envs=NUM_ENVS, seeds=SEEDS, keep_going=self._keep_going
                ),
                loaded,
            )
        return self._checkup

    def _keep_going(self) -> None:
        if self._waits():
            raise _Ended


def _core_rules() -> set[str]:
    from workbench.core.rules import RULES

    return set(RULES)
