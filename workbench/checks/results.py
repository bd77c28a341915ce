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
    finding: Finding
    reason: str


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
    """Time of one hook in a control step."""

    hook: str
    """Its name; ``physics`` and ``other`` for what is ManiSkill's own."""
    milliseconds: float
    """Of one control step of the batch, on average."""
    share: float
    """Of the step, 0 to 1."""


@dataclass(frozen=True)
class LineTime:
    """Time of one line of the author in a control step, with all that it calls."""

    file: str
    line: int
    code: str
    milliseconds: float
    """As `HookTime.milliseconds`."""
    share: float
    hook: str = ""
    """The hook that it is in."""


@dataclass(frozen=True)
class StepProfile:
    """Where a control step goes."""

    num_envs: int
    steps: int
    """Control steps that were timed."""
    milliseconds: float
    """Of one control step of the batch, on average."""
    hooks: tuple[HookTime, ...]
    """Longest first."""
    lines: tuple[LineTime, ...]
    """Longest first; those that matter."""
