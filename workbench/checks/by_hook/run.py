"""Runs the checks, a group at a time, and gives what each rule came to."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence, Sized
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
from workbench.checks.evidence.checkup import (
    CannotCheck,
    Check,
    Checkup,
    Found,
    Note,
    code_of,
    finding_of,
    raised,
)
from workbench.checks.evidence.over_seeds import OverSeeds
from workbench.checks.results import RuleResult, Seen, Silenced, State
from workbench.checks.rules import CHECK_RULES, RULES
from workbench.core.env import actions
from workbench.core.rules import Degree, Finding, silence_of


@dataclass(frozen=True)
class RuleGroup:
    """Rules that look at the same evidence, checked by one process."""

    name: str
    """What is being looked at, for a status line."""
    checks: Mapping[str, Check]


GROUPS: tuple[RuleGroup, ...] = (
    RuleGroup("source", {**source.CHECKS, **files.CHECKS}),
    RuleGroup("resets", placement.CHECKS),
    RuleGroup("success", {**evaluate.CHECKS, **placement.RUN_CHECKS}),
    RuleGroup("rewards", reward.CHECKS),
    RuleGroup("tensors", devices.CHECKS),
    RuleGroup("the same again", reproduce.CHECKS),
    RuleGroup("observations", observation.CHECKS),
    RuleGroup("the scene", scene.CHECKS),
    RuleGroup("pictures", {**observation.PICTURE_CHECKS, **cameras.CHECKS}),
    RuleGroup("planned episodes", solved.CHECKS),
)
"""In the order in which they run: what people meet most first."""
RULES_OVER_SEEDS: Mapping[str, OverSeeds] = {
    rule: check for group in GROUPS for rule, check in group.checks.items() if isinstance(check, OverSeeds)
}
"""The rules whose results depend on which seeds are looked at, and on how many. All others look at the source, at what is
built, or at the first batch."""
CORE_GROUP = "GPU simulation"
_OF_RETURNS = ("evaluate-rows", "reward-rows")
CORE_RESETS = 6
"""Resets of random envs, with steps between them."""


def run_group(group: RuleGroup, checkup: Checkup, degrees: Mapping[str, Degree]) -> Iterator[RuleResult]:
    """The result of each rule of the group that is not off, as soon as it is known. Raises what `keep_going` raises."""
    told: set[object] = set()
    for rule, check in group.checks.items():
        if degrees[rule] == "off":
            continue
        began = time.perf_counter()
        seen: list[Found | Note] = []
        rows: list[Seen] = []
        try:
            if isinstance(check, OverSeeds):
                for row in check.see(checkup):
                    rows.append(_with_code(rule, row))
                seen.extend(check.judge(rows))
            else:
                for found in check(checkup):
                    seen.append(found)  # one by one: the next may raise
        except CannotCheck as reason:
            seconds = time.perf_counter() - began
            yield RuleResult(rule, "skipped", why=str(reason), seconds=seconds, seen=tuple(rows))
            continue
        except TaskError as error:
            seconds = time.perf_counter() - began
            known = _is_known(error, checkup, degrees)
            if rule == "runs" and not known:
                yield replace(result_of(rule, degrees[rule], [*seen, raised(error)]), seconds=seconds)
                continue
            # What it had found before that is true all the same.
            if isinstance(check, OverSeeds):
                seen.extend(check.so_far(rows))
            yield replace(
                result_of(rule, degrees[rule], seen),
                state="failed",
                why=str(error),
                seconds=seconds,
                seen=tuple(rows),
            )
            # What a policy raised is no fault of the task.
            of_task = error.problem.stage != "policy" and not known
            if of_task and degrees["runs"] != "off" and (cause := raised(error)) not in told:
                told.add(cause)
                yield result_of("runs", degrees["runs"], [cause])
            continue
        seconds = time.perf_counter() - began
        yield replace(result_of(rule, degrees[rule], seen), seconds=seconds, seen=tuple(rows))


def over_seeds(results: Sequence[RuleResult], degree: Degree) -> RuleResult:
    """The result of a rule of `RULES_OVER_SEEDS` over all seeds.

    Args:
        results: what it came to for each part of them, in their order.
    """
    rule, rows = results[0].rule, [row for result in results for row in result.seen]
    check, failed = RULES_OVER_SEEDS[rule], [result for result in results if result.state == "failed"]
    seconds = sum(result.seconds for result in results)
    if not rows and not failed:
        return replace(results[0], seconds=seconds)
    try:
        whole = result_of(rule, degree, [*(check.so_far if failed else check.judge)(rows)], rows)
    except CannotCheck as reason:
        return RuleResult(rule, "skipped", why=str(reason), seconds=seconds)
    if failed and (whole.state == "kept" or len(failed) == len(results)):
        whole = replace(whole, state="failed", why=failed[0].why)
    return replace(whole, seconds=seconds)


def _with_code(rule: str, row: Seen) -> Seen:
    """The row with what is known of its line here: it may be judged where the file is another one."""
    if row.place is None:
        return row
    file, line, _ = row.place
    silence = silence_of(file, line, rule)
    return replace(
        row,
        code=code_of(row.place),
        silence=None if silence is None else (silence.reason, silence.line),
    )


def _is_known(error: TaskError, checkup: Checkup, degrees: Mapping[str, Degree]) -> bool:
    """Whether a rule tells it, with its line: the type or shape of what a hook returned."""
    returned = (each.rule for each in checkup.findings if each.rule in _OF_RETURNS)
    return error.problem.stage == "returns" and any(degrees[rule] != "off" for rule in returned)


def run_core(group: RuleGroup, checkup: Checkup, degrees: Mapping[str, Degree]) -> Iterator[RuleResult]:
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


def result_of(
    rule: str, degree: Degree, seen: Sequence[Found | Note], rows: Sequence[Seen] = ()
) -> RuleResult:
    """The result of a rule whose check gave this.

    Args:
        rows: with what is known of their lines, where the files may be others here.
    """
    known = {row.place: row for row in rows if row.place is not None}
    findings: list[Finding] = []
    silenced: list[Silenced] = []
    for found in seen:
        if isinstance(found, Note):
            continue
        finding = finding_of(rule, degree, found)
        if found.place in known:
            row = known[found.place]
            finding, silence = replace(finding, code=row.code), row.silence
        else:
            comment = silence_of(finding.file, finding.line, rule)
            silence = None if comment is None else (comment.reason, comment.line)
        if silence is None:
            findings.append(finding)
        else:
            silenced.append(Silenced(finding, *silence))
    notes = tuple(each.message for each in seen if isinstance(each, Note))
    return RuleResult(rule, _state(findings, silenced), tuple(findings), tuple(silenced), notes)
