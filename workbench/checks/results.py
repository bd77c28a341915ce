"""What checks and the profile of a step come to, as data. Imports no simulator."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Literal

from workbench.core.rules import Finding

State = Literal["kept", "broken", "silenced", "skipped", "failed"]
_WORST: tuple[State, ...] = ("broken", "failed", "silenced", "kept", "skipped")


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
    """``skipped`` where it says nothing about this task, ``failed`` where the task raised; `why` says more."""
    findings: tuple[Finding, ...] = ()
    silenced: tuple[Silenced, ...] = ()
    notes: tuple[str, ...] = ()
    """Worth knowing, and no breach."""
    why: str = ""
    seconds: float = 0.0
    seen: tuple[Seen, ...] = ()
    """Of a rule that looks at all seeds: by this the results of further seeds are put together with it."""


def by_rule(results: Iterable[RuleResult]) -> dict[str, RuleResult]:
    """One result a rule: of several (``runs`` is broken at many places) all findings, each once, and the worst state."""
    found: dict[str, RuleResult] = {}
    for one in results:
        before = found.get(one.rule)
        if before is None:
            found[one.rule] = one
            continue
        findings = {each.key: each for each in (*before.findings, *one.findings)}
        found[one.rule] = replace(
            before,
            state=min(before.state, one.state, key=_WORST.index),
            findings=tuple(findings.values()),
            silenced=tuple(dict.fromkeys((*before.silenced, *one.silenced))),
            notes=tuple(dict.fromkeys((*before.notes, *one.notes))),
            why=before.why or one.why,
            seconds=before.seconds + one.seconds,
        )
    return found


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
