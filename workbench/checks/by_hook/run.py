"""Runs the checks, a group at a time, and gives what each rule came to."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sized
from dataclasses import dataclass, replace

import numpy as np

from workbench.authoring.problem import TaskError
from workbench.checks.by_hook import (
    cameras,
    devices,
    evaluate,
    files,
    observation,
    placement,
    reproduce,
    reward,
    scene,
    solved,
    source,
)
from workbench.checks.evidence.checkup import CannotCheck, Check, Checkup, Found, Note, finding_of, raised
from workbench.checks.results import RuleResult, Silenced, State
from workbench.checks.rules import CHECK_RULES, RULES
from workbench.core.env import actions
from workbench.core.rules import Degree, Finding, silence_of


@dataclass(frozen=True)
class Group:
    """Rules that look at the same evidence, checked by one process."""

    name: str
    """What is being looked at, for a status line."""
    checks: Mapping[str, Check]


GROUPS: tuple[Group, ...] = (
    Group("source", {**source.CHECKS, **files.CHECKS}),
    Group("resets", placement.CHECKS),
    Group("success", {**evaluate.CHECKS, **placement.RUN_CHECKS}),
    Group("rewards", reward.CHECKS),
    Group("tensors", devices.CHECKS),
    Group("the same again", reproduce.CHECKS),
    Group("observations", observation.CHECKS),
    Group("the scene", scene.CHECKS),
    Group("pictures", {**observation.PICTURE_CHECKS, **cameras.CHECKS}),
    Group("planned episodes", solved.CHECKS),
)
"""In the order in which they run: what people meet most first."""
CORE_GROUP = "GPU simulation"
_OF_RETURNS = ("evaluate-rows", "reward-rows")
CORE_RESETS = 6
"""Resets of random envs, with steps between them."""


def run_group(group: Group, checkup: Checkup, degrees: Mapping[str, Degree]) -> Iterator[RuleResult]:
    """The result of each rule of the group that is not off, as soon as it is known. Raises what `keep_going` raises."""
    told: set[object] = set()
    for rule, check in group.checks.items():
        if degrees[rule] == "off":
            continue
        began = time.perf_counter()
        seen: list[Found | Note] = []
        try:
            for found in check(checkup):
                seen.append(found)  # one by one: the next may raise
        except CannotCheck as reason:
            yield RuleResult(rule, "skipped", why=str(reason), seconds=time.perf_counter() - began)
            continue
        except TaskError as error:
            seconds = time.perf_counter() - began
            known = _is_known(error, checkup, degrees)
            if rule == "runs" and not known:
                yield replace(result_of(rule, degrees[rule], [*seen, raised(error)]), seconds=seconds)
                continue
            # What it had found before that is true all the same.
            yield replace(
                result_of(rule, degrees[rule], seen), state="failed", why=str(error), seconds=seconds
            )
            # What a policy raised is no fault of the task.
            of_task = error.problem.stage != "policy" and not known
            if of_task and degrees["runs"] != "off" and (cause := raised(error)) not in told:
                told.add(cause)
                yield result_of("runs", degrees["runs"], [cause])
            continue
        yield replace(result_of(rule, degrees[rule], seen), seconds=time.perf_counter() - began)


def _is_known(error: TaskError, checkup: Checkup, degrees: Mapping[str, Degree]) -> bool:
    """Whether a rule tells it, with its line: the type or shape of what a hook returned."""
    returned = (each.rule for each in checkup.findings if each.rule in _OF_RETURNS)
    return error.problem.stage == "returns" and any(degrees[rule] != "off" for rule in returned)


def run_core(group: Group, checkup: Checkup, degrees: Mapping[str, Degree]) -> Iterator[RuleResult]:
    """Steps, and resets of random envs among them, while the rules of GPU simulation look. Gives results only where the task
    raises; what was found is in `Checkup.findings`, see `core_results`."""
    rng = np.random.default_rng(0)
    try:
        task = checkup.task
        checkup.reset(task, checkup.seeds[0])
        for _ in range(CORE_RESETS):
            for _ in range(2):
                checkup.step(task, actions.random_action(task.parts, task.num_envs, rng))
            count = int(rng.integers(1, max(2, task.num_envs)))
            checkup.reset(task, None, sorted(rng.choice(task.num_envs, count, replace=False).tolist()))
    except TaskError as error:
        for rule in _core_rules(degrees):
            yield RuleResult(rule, "failed", why=str(error))
        if degrees["runs"] != "off" and not _is_known(error, checkup, degrees):
            yield result_of("runs", degrees["runs"], [raised(error)])


def core_results(
    findings: list[Finding], silenced: list[Silenced], degrees: Mapping[str, Degree]
) -> Iterator[RuleResult]:
    """The results of the rules of GPU simulation, of what was seen while the others were checked."""
    for rule in _core_rules(degrees):
        of_rule = [replace(each, degree=degrees[rule]) for each in findings if each.rule == rule]
        once = {each.key: each for each in of_rule}
        off = {
            (each.finding.key, each.line): replace(each, finding=replace(each.finding, degree=degrees[rule]))
            for each in silenced
            if each.finding.rule == rule
        }
        yield RuleResult(rule, _state(once, off), tuple(once.values()), tuple(off.values()))


def _state(findings: Sized, silenced: Sized) -> State:
    return "broken" if findings else "silenced" if silenced else "kept"


def _core_rules(degrees: Mapping[str, Degree]) -> list[str]:
    return [rule for rule in RULES if rule not in CHECK_RULES and degrees[rule] != "off"]


def result_of(rule: str, degree: Degree, seen: list[Found | Note]) -> RuleResult:
    """The result of a rule whose check gave this."""
    findings: list[Finding] = []
    silenced: list[Silenced] = []
    for found in seen:
        if isinstance(found, Note):
            continue
        finding = finding_of(rule, degree, found)
        silence = silence_of(finding.file, finding.line, rule)
        if silence is None:
            findings.append(finding)
        else:
            silenced.append(Silenced(finding, silence.reason, silence.line))
    notes = tuple(each.message for each in seen if isinstance(each, Note))
    return RuleResult(rule, _state(findings, silenced), tuple(findings), tuple(silenced), notes)
