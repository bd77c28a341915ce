"""Runs the checks, a group at a time, and gives what each rule came to."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

from workbench.authoring.problem import TaskError
from workbench.checks import devices, evaluate, files, reward, source
from workbench.checks.checkup import CannotCheck, Check, Checkup, Found, Note, finding_of
from workbench.checks.results import RuleResult, Silenced, State
from workbench.checks.rules import CHECK_RULES, RULES
from workbench.core.rules import Degree, Finding, reason_of_silence


@dataclass(frozen=True)
class Group:
    """Rules that look at the same evidence, checked by one process."""

    name: str
    """What is being looked at, for a status line."""
    checks: Mapping[str, Check]


GROUPS: tuple[Group, ...] = (
    Group("source", {**source.CHECKS, **files.CHECKS}),
    Group("success", evaluate.CHECKS),
    Group("rewards", reward.CHECKS),
    Group("tensors", devices.CHECKS),
)
"""In the order in which they run: what people meet most first."""
CORE_GROUP = "GPU simulation"


def run_group(group: Group, checkup: Checkup, degrees: Mapping[str, Degree]) -> Iterator[RuleResult]:
    """The result of each rule of the group that is not off, as soon as it is known. Raises what `keep_going` raises."""
    for rule, check in group.checks.items():
        if degrees[rule] == "off":
            continue
        began = time.perf_counter()
        try:
            seen = list(check(checkup))
        except CannotCheck as reason:
            yield RuleResult(rule, "skipped", why=str(reason), seconds=time.perf_counter() - began)
            continue
        except TaskError as error:
            seconds = time.perf_counter() - began
            yield RuleResult(rule, "failed", why=str(error), seconds=seconds)
            if degrees["runs"] != "off" and rule != "runs":
                yield result_of("runs", degrees["runs"], [raised(error)])
            continue
        yield replace(result_of(rule, degrees[rule], seen), seconds=time.perf_counter() - began)


def raised(error: TaskError) -> Found:
    """What the task raised, as a breach of the rule `runs`."""
    problem = error.problem
    place = None if problem.file is None else (problem.file, problem.line or 1, problem.stage)
    return Found(f"{problem.stage}: {problem.message}", place)


def core_results(findings: list[Finding], degrees: Mapping[str, Degree]) -> Iterator[RuleResult]:
    """The results of the rules of GPU simulation, of what was seen while the others were checked."""
    for rule in RULES:
        if rule in CHECK_RULES or degrees[rule] == "off":
            continue
        of_rule = [replace(each, degree=degrees[rule]) for each in findings if each.rule == rule]
        once = {each.key: each for each in of_rule}
        yield RuleResult(rule, "broken" if once else "kept", tuple(once.values()))


def result_of(rule: str, degree: Degree, seen: list[Found | Note]) -> RuleResult:
    """The result of a rule whose check gave this."""
    findings: list[Finding] = []
    silenced: list[Silenced] = []
    for found in seen:
        if isinstance(found, Note):
            continue
        finding = finding_of(rule, degree, found)
        reason = reason_of_silence(finding.file, finding.line, rule)
        if reason is None:
            findings.append(finding)
        else:
            silenced.append(Silenced(finding, reason))
    state: State = "broken" if findings else "silenced" if silenced else "kept"
    notes = tuple(each.message for each in seen if isinstance(each, Note))
    return RuleResult(rule, state, tuple(findings), tuple(silenced), notes)
