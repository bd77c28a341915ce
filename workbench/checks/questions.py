"""Questions about rules and the time of a step. Only a worker that does not play answers them, on separate
envs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from workbench.checks.results import RuleResult, StepProfile
from workbench.envs.gpu_rules import Degree
from workbench.machine.processes.wire import Question


@dataclass(frozen=True)
class CheckedGroup:
    """A group was checked; its results were sent before."""

    groups: int
    """Number of groups."""
    rules: int
    """Number of rules in all groups, without the rules that are off."""
    next: str
    """What the next group looks at; empty after the last group."""


@dataclass(frozen=True)
class RuleProgress:
    """Progress of the rules of a group."""

    rule: str
    """The rule that is being checked; empty for the rules of GPU simulation, which are checked together."""
    result: RuleResult | None = None
    """Result of the rule; None when its check begins."""


@dataclass(frozen=True)
class CheckGroup(Question[CheckedGroup]):
    """Check the rules of one group on the loaded version. A later request ends the check."""

    part: ClassVar[Any] = RuleProgress
    group: int
    """Index of the group, from 0; groups with common mistakes come first."""
    degrees: Mapping[str, Degree]
    """Degree of each rule."""
    known: tuple[str, ...] = ()
    """Rules to skip because they already have a result. A group is requested again after a job of higher
    priority interrupted it."""


@dataclass(frozen=True)
class ProfileStep(Question[StepProfile]):
    """Time the hooks and lines of a control step, on separate envs. A later request ends the timing."""
