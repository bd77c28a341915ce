"""Results of checks, and the profile of a step, as data. Imports no simulator."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Literal, get_args

from workbench.envs.gpu_rules import Finding
from workbench.task.problem import Problem

State = Literal["broken", "failed", "silenced", "not_known", "kept", "not_applicable"]
"""Result of a rule. If a rule has several results in one check, the one whose state comes first in this type
counts.

- ``broken``: the rule has findings that no comment in the source silences.
- ``silenced``: the rule has findings, and comments silence all of them.
- ``kept``: the rule was tried and has no finding.
- ``not_known``: the rule was not tried, or not to the end: no episode succeeded, the task raised, and so on.
- ``not_applicable``: the rule says nothing about this task.
- ``failed``: the check of the rule itself raised, or its process died.
"""
STATES: tuple[State, ...] = get_args(State)


def state_text(state: State) -> str:
    """The state as text, such as ``not known``."""
    return state.replace("_", " ")


@dataclass(frozen=True)
class Silenced:
    """A finding that a comment in its file silences."""

    finding: Finding
    reason: str
    line: int
    """1-based line of the comment."""


@dataclass(frozen=True)
class Seen:
    """A row about one thing, such as a body: what a check saw of it in some episodes. `evidence.over_seeds`
    joins the rows that come from several parts of the seeds."""

    names: tuple[str, ...] = ()
    """Names of the thing, such as a body; empty for the episodes as a whole."""
    place: tuple[str, int, str] | None = None
    """File, line and function at which a breach is reported."""
    tried: int = 0
    """Number of episodes that the check looked at; some rules count steps or states instead."""
    seeds: tuple[int, ...] = ()
    """Seeds of the episodes that break the rule."""
    count: int = 0
    """Number of breaches, such as bad states; some rules count something else, such as successes."""
    size: float = 0.0
    """Size of the worst breach, in the unit of the rule."""
    numbers: tuple[float, ...] = ()
    """Further numbers that decide the result."""
    texts: tuple[str, ...] = ()
    """Texts for the message."""
    code: str = ""
    """The text of the line of `place`."""
    silence: tuple[str, int] | None = None
    """Reason and line of the comment that silences the rule at `place`."""


@dataclass(frozen=True)
class RuleResult:
    """The result of the check of one rule."""

    rule: str
    state: State
    findings: tuple[Finding, ...] = ()
    silenced: tuple[Silenced, ...] = ()
    notes: tuple[str, ...] = ()
    """Notes that are not breaches."""
    why: str = ""
    """The reason why the rule is not known, not applicable or failed; for a broken rule, why its check
    was not completed."""
    seconds: float = 0.0
    seen: tuple[Seen, ...] = ()
    """Rows of an `OverSeeds` check. The rows of all parts of the seeds are judged together."""
    problem: Problem | None = None
    """The error that the author's code raised; in a failed check, the error of the check."""

    @property
    def is_crash(self) -> bool:
        """Whether the check itself raised. False if its process died: then the cause is not known."""
        return self.state == "failed" and self.problem is not None and bool(self.problem.traceback)


def failed(rule: str, problem: Problem, seconds: float = 0.0) -> RuleResult:
    """A failed result: the check raised, or its process died."""
    at = "" if problem.file is None else f", at {problem.file}:{problem.line}"
    return RuleResult(rule, "failed", why=f"{problem.message}{at}", seconds=seconds, problem=problem)


def by_rule(results: Iterable[RuleResult]) -> dict[str, RuleResult]:
    """One result for each rule."""
    found: dict[str, list[RuleResult]] = {}
    for one in results:
        found.setdefault(one.rule, []).append(one)
    return {rule: merged(each) for rule, each in found.items()}


def merged(results: Iterable[RuleResult], other_seeds: bool = False) -> RuleResult:
    """One result from several results of one rule.

    Args:
        other_seeds: True if the results are of different seeds: their breaches are added up. False if they
            come from the checks of several rules on the same seeds: the same breach counts once.
    """
    results = sorted(results, key=lambda result: STATES.index(result.state))
    findings: dict[object, Finding] = {}
    for finding in (finding for result in results for finding in result.findings):
        # On the same seeds, two messages at one line are two mistakes. On different seeds they may be one
        # mistake with other numbers.
        key = finding.key if other_seeds else (finding.key, finding.message)
        known = findings.setdefault(key, finding)
        if known is not finding and other_seeds:
            findings[key] = replace(known, count=known.count + finding.count)
        elif finding.count > known.count:
            findings[key] = finding
    silenced = {(one.finding.key, one.line): one for result in results for one in result.silenced}
    return replace(
        results[0],
        findings=tuple(findings.values()),
        silenced=tuple(silenced.values()),
        notes=tuple(dict.fromkeys(note for result in results for note in result.notes)),
        seconds=sum(result.seconds for result in results),
        seen=tuple(row for result in results for row in result.seen),
    )


def counts(results: Iterable[RuleResult]) -> Counter[State]:
    """Number of rules by state."""
    return Counter(result.state for result in results)


# --- where a step goes ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class HookTime:
    """Time of a hook, or of a part of ManiSkill, in a control step, without the hooks that it calls."""

    name: str
    """Name such as ``evaluate`` or ``physics``."""
    milliseconds: float
    share: float
    """Share of the step, 0 to 1."""
    place: tuple[str, int, str] | None = None
    """File, line and name of the author's definition; None for ManiSkill's parts."""


@dataclass(frozen=True)
class LineTime:
    """Time of one of the author's lines in a control step, including the code that it calls outside the
    author's files."""

    hook: str
    """The hook that ran the line."""
    file: str
    line: int
    """1-based."""
    code: str
    """Text of the line, stripped."""
    milliseconds: float
    share: float
    """Share of the step, 0 to 1."""


@dataclass(frozen=True)
class StepProfile:
    """Mean times over some control steps."""

    num_envs: int
    steps: int
    milliseconds: float
    """Time of one step of all envs."""
    hooks: tuple[HookTime, ...]
    """Hooks, longest first; their shares add up to 1."""
    lines: tuple[LineTime, ...]
    """Lines, longest first."""
