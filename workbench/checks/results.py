"""What checks and the profile of a step come to, as data. Imports no simulator."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Literal, get_args

from workbench.envs.gpu_rules import Finding
from workbench.task.problem import Problem

State = Literal["broken", "failed", "silenced", "not_known", "kept", "not_applicable"]
"""What a rule came to; where it came to several in one check, the first of these counts.

- ``broken``: it has findings. ``silenced``: comments in the source silence all of them.
- ``kept``: what it speaks of was tried, and it held.
- ``not_known``: what it speaks of was not tried, or not to the end: no episode succeeded, the task raised, and so on.
- ``not_applicable``: it says nothing about this task.
- ``failed``: the check of the rule itself raised, or its process died.
"""
STATES: tuple[State, ...] = get_args(State)


def state_text(state: State) -> str:
    """``not known``."""
    return state.replace("_", " ")


@dataclass(frozen=True)
class Silenced:
    """A finding that a comment in its file silences."""

    finding: Finding
    reason: str
    line: int
    """Of the comment, 1-based."""


@dataclass(frozen=True)
class Seen:
    """What one rule saw of one thing in some episodes. What several parts of the seeds give is put together by
    `evidence.over_seeds`."""

    names: tuple[str, ...] = ()
    """Of the thing, such as a body; empty for the episodes as a whole."""
    place: tuple[str, int, str] | None = None
    """File, line and function that a breach is told at."""
    tried: int = 0
    """Episodes, or what else the rule counts, that were looked at."""
    seeds: tuple[int, ...] = ()
    """Of the episodes in which it is broken."""
    count: int = 0
    """Breaches, where they are not counted by episodes."""
    size: float = 0.0
    """The worst breach."""
    numbers: tuple[float, ...] = ()
    """What else the rule decides by."""
    texts: tuple[str, ...] = ()
    """For its sentence."""
    code: str = ""
    """The text of the line of `place`."""
    silence: tuple[str, int] | None = None
    """Reason and line of the comment that silences the rule there."""


@dataclass(frozen=True)
class RuleResult:
    """What the check of one rule came to."""

    rule: str
    state: State
    findings: tuple[Finding, ...] = ()
    silenced: tuple[Silenced, ...] = ()
    notes: tuple[str, ...] = ()
    """Worth knowing, and no breach."""
    why: str = ""
    """The reason why it is not known, not applicable or failed; for a broken rule, why not all was looked at."""
    seconds: float = 0.0
    seen: tuple[Seen, ...] = ()
    """Of a rule that looks at all seeds: by this the results of further seeds are put together with it."""
    problem: Problem | None = None
    """What was raised: by the author's code, or by the check where it failed."""

    @property
    def is_crash(self) -> bool:
        """Whether the check raised. Of a process that ended nobody knows the cause."""
        return self.state == "failed" and self.problem is not None and bool(self.problem.traceback)


def failed(rule: str, problem: Problem, seconds: float = 0.0) -> RuleResult:
    """The result of a rule whose check raised, or whose process died."""
    at = "" if problem.file is None else f", at {problem.file}:{problem.line}"
    return RuleResult(rule, "failed", why=f"{problem.message}{at}", seconds=seconds, problem=problem)


def by_rule(results: Iterable[RuleResult]) -> dict[str, RuleResult]:
    """One result a rule."""
    found: dict[str, list[RuleResult]] = {}
    for one in results:
        found.setdefault(one.rule, []).append(one)
    return {rule: merged(each) for rule, each in found.items()}


def merged(results: Iterable[RuleResult], other_seeds: bool = False) -> RuleResult:
    """One result of those that one rule has.

    Args:
        other_seeds: each is of other seeds: the breaches of all are counted. Else they are of several rules' checks, which
            look at the same seeds, and the same breach counts once.
    """
    results = sorted(results, key=lambda result: STATES.index(result.state))
    findings: dict[object, Finding] = {}
    for finding in (finding for result in results for finding in result.findings):
        # Two things may be wrong at one line; of other seeds the same thing has other numbers in its message.
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
    """How many rules came to each state."""
    return Counter(result.state for result in results)


# --- where a step goes ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class HookTime:
    """What a hook, or a part of ManiSkill's own, takes of a control step; without the hooks that it calls."""

    name: str
    """As ``evaluate``, or ``physics``."""
    milliseconds: float
    share: float
    """Of the step, 0 to 1."""
    place: tuple[str, int, str] | None = None
    """File, line and name where the author defines it; None for ManiSkill's own."""


@dataclass(frozen=True)
class LineTime:
    """What a line of the author's takes of a control step, with what it calls outside the author's files."""

    hook: str
    """The hook that ran it."""
    file: str
    line: int
    """1-based."""
    code: str
    """Its text, stripped."""
    milliseconds: float
    share: float
    """Of the step, 0 to 1."""


@dataclass(frozen=True)
class StepProfile:
    """The mean of some control steps."""

    num_envs: int
    steps: int
    milliseconds: float
    """Of one step of all envs."""
    hooks: tuple[HookTime, ...]
    """Longest first; their shares add up to 1."""
    lines: tuple[LineTime, ...]
    """Longest first."""
