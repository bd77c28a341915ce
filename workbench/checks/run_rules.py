"""Runs the checks, one rule at a time, and gives the result of each."""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Sized
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import workbench
from workbench.checks.evidence.collect import (
    Check,
    CheckEnded,
    Checkup,
    Found,
    NotApplicable,
    Note,
    NotKnown,
    code_of,
    finding_of,
)
from workbench.checks.evidence.over_seeds import OverSeeds
from workbench.checks.register_rule import RuleCheck, checks_in
from workbench.checks.results import RuleResult, Seen, Silenced, State, failed, merged
from workbench.checks.rule_table import gpu_rules_of
from workbench.checks.rules import (
    cameras,
    devices,
    evaluate,
    files,
    observation,
    placement,
    planned_reward,
    reproduce,
    reward,
    scene,
    source,
    step,
    visual_modes,
)
from workbench.envs import action_vector as actions
from workbench.envs.broken_rule import NeedsOneEnv
from workbench.envs.gpu_rules import Degree, Finding, silence_of
from workbench.envs.kept_rows import KeptRows
from workbench.envs.task_env import TaskEnv
from workbench.machine.processes.wire import Unpacker, pack
from workbench.task.problem import Problem, TaskError, problem_from_exception, shorten

_PACKAGE = Path(workbench.__file__).parent


@dataclass(frozen=True)
class RuleGroup:
    """Rules with the same evidence, checked by one process."""

    name: str
    """Name for a status line."""
    checks: Mapping[str, Check]


DECLARED: Mapping[str, tuple[RuleCheck, ...]] = {
    "source": checks_in(source, files),
    "resets": checks_in(placement),
    "success": checks_in(evaluate, step),
    "rewards": checks_in(reward),
    "tensors": checks_in(devices),
    "the same again": checks_in(reproduce),
    "observations": checks_in(observation),
    "the scene": checks_in(scene),
    "pictures": checks_in(visual_modes, cameras),
    "planned episodes": checks_in(planned_reward),
}
"""The checks of `checks.rules` by the name of their group, in the order in which they run: common mistakes first."""
GROUPS = tuple(
    RuleGroup(name, {each.rule.id: each.check for each in checks}) for name, checks in DECLARED.items()
)
RULES_OVER_SEEDS: Mapping[str, OverSeeds] = {
    rule: check for group in GROUPS for rule, check in group.checks.items() if isinstance(check, OverSeeds)
}
"""The rules whose results depend on the seeds. All others look at the source, at what is built, or at the first batch."""
GPU_SIMULATION = RuleGroup("GPU simulation", {})
"""The group of all rules of GPU simulation. It has no checks: the envs report breaches while any check
runs."""
_OF_RETURNS = ("evaluate-rows", "reward-rows")
"""Rules of GPU simulation about the values that hooks return."""
_OF_SEVERAL = frozenset(
    (
        *(*_OF_RETURNS, "observation-rows"),
        *("other-env-written", "stepped-in-reset", "rows-lost", "rows-rewritten", "applied-by-reset"),
    )
)
"""Rules of GPU simulation about several envs: that a task with one env keeps them says nothing about several."""
GPU_RESETS = 6
"""Number of resets of random envs, with steps between them."""
ONE_ENV = "The task runs with one env: --num-envs 1."


def check_rule(rule: str, check: Check, checkup: Checkup, degrees: Mapping[str, Degree]) -> list[RuleResult]:
    """The result of a rule, then a result of the rule `runs` if the task raised an error that no rule reports
    yet. Raises CheckEnded."""
    began = time.perf_counter()
    rows: list[Seen] = []
    further: list[RuleResult] = []
    try:
        result = _checked(rule, check, checkup, degrees[rule], rows)
        error = result.problem
        if error is not None and error.stage != "policy" and degrees["runs"] != "off":
            # An error of a policy is not a fault of the task.
            if not _is_known(error, checkup, degrees):
                cause = result_of("runs", degrees["runs"], [raised(error, checkup)])
                result, further = (cause, []) if rule == "runs" else (result, [cause])
        result = as_sent(replace(result, seconds=time.perf_counter() - began, seen=tuple(rows)))
    except CheckEnded:
        raise
    except Exception as error:
        result = failed(rule, problem_of_crash(error), time.perf_counter() - began)
    return [result, *further]


def _checked(rule: str, check: Check, checkup: Checkup, degree: Degree, rows: list[Seen]) -> RuleResult:
    """The result of a rule; what the check saw is added to `rows`."""
    seen: list[Found | Note] = []

    def look() -> None:
        seen.clear()
        rows.clear()
        if isinstance(check, OverSeeds):
            for row in check.see(checkup):
                rows.append(_with_code(rule, row))
        for found in check.judge(rows) if isinstance(check, OverSeeds) else check(checkup):
            seen.append(found)  # one by one: breaches before an error are kept

    ended = ended_as(lambda: _of_task(look, checkup))
    if ended.problem is not None and isinstance(check, OverSeeds):
        # Breaches that were found before the error still count.
        seen.extend(check.so_far(rows))
    return _ended(result_of(rule, degree, seen), ended)


@dataclass(frozen=True)
class LookEnd:
    """How a check ended, apart from its findings."""

    state: State = "kept"
    why: str = ""
    problem: Problem | None = None


def ended_as(look: Callable[[], None]) -> LookEnd:
    """Run a check and return how it ended. Exceptions other than NotApplicable, NotKnown and TaskError are
    not caught."""
    try:
        look()
    except NotApplicable as reason:
        return LookEnd("not_applicable", str(reason))
    except NotKnown as reason:
        return LookEnd("not_known", str(reason))
    except TaskError as error:
        return LookEnd("not_known", str(error), error.problem)
    return LookEnd()


def _of_task(look: Callable[[], None], checkup: Checkup) -> None:
    """Run a check. If the task uses something that exists for one env only, run the check again with one env;
    opening a task does the same. An exception in the author's code, for example in a property of a robot,
    becomes a TaskError."""
    try:
        look()
    except TaskError as error:
        if checkup.num_envs == 1 or not isinstance(error.__cause__, NeedsOneEnv):
            raise
        checkup.go_on_with_one_env()
        _of_task(look, checkup)
    except (NotApplicable, NotKnown, CheckEnded):
        raise
    except Exception as error:
        if not _is_of_task(error, checkup):
            raise
        loaded = checkup.loaded
        raise TaskError(problem_from_exception(error, "step", loaded.source_files, loaded.cls)) from error


def _is_of_task(error: Exception, checkup: Checkup) -> bool:
    """Whether the innermost traceback line outside libraries is the author's, not the workbench's."""
    for frame in reversed(traceback.extract_tb(error.__traceback__)):
        if frame.filename in checkup.files:
            return True
        if Path(frame.filename).is_relative_to(_PACKAGE):
            return False
    return False


def _ended(result: RuleResult, ended: LookEnd) -> RuleResult:
    """The result, with how its check ended; a result with findings keeps its state."""
    if result.state != "kept":
        # The error is reported too: the check did not see everything.
        return replace(result, why=ended.why, problem=ended.problem) if ended.problem is not None else result
    return replace(result, state=ended.state, why=ended.why, problem=ended.problem)


def problem_of_crash(error: Exception) -> Problem:
    """A problem for the exception that a check raised: its innermost line in the workbench, and the whole
    traceback."""
    frames = traceback.extract_tb(error.__traceback__)
    at = next((frame for frame in reversed(frames) if Path(frame.filename).is_relative_to(_PACKAGE)), None)
    file = None if at is None else str(Path(at.filename).relative_to(_PACKAGE.parent))
    line, code = (None, None) if at is None else (at.lineno, at.line)
    text = shorten(f"{type(error).__qualname__}: {error}")
    return Problem("worker", text, file, line, code, "".join(traceback.format_exception(error)))


def as_sent(result: RuleResult) -> RuleResult:
    """The result, packed and unpacked. A value of a wrong type raises TypeError or Unreadable here, so that
    only this rule fails; in the process that reads the result, the error would end the whole check."""
    return Unpacker().unpack(pack(result), RuleResult)


def over_seeds(results: Sequence[RuleResult], degree: Degree) -> RuleResult:
    """The result of a rule of `RULES_OVER_SEEDS` over all seeds.

    Args:
        results: the results for each part of the seeds, in order.
    """
    rule, rows = results[0].rule, [row for result in results for row in result.seen]
    check, seconds = RULES_OVER_SEEDS[rule], sum(result.seconds for result in results)
    short = [result for result in results if result.problem is not None]
    if not rows:
        return replace(merged(results), seconds=seconds)
    seen: list[Found | Note] = []

    def judge() -> None:
        for found in (check.so_far if short else check.judge)(rows):
            seen.append(found)

    ended = ended_as(judge)
    whole = _ended(result_of(rule, degree, seen, rows), ended)
    if short:
        worst = merged(short)
        whole = _ended(whole, LookEnd(worst.state, worst.why, worst.problem))
    return replace(whole, seconds=seconds)


def _with_code(rule: str, row: Seen) -> Seen:
    """The row with code and silencing comment of its line: the process that judges the row may have another
    version of the file."""
    if row.place is None:
        return row
    file, line, _ = row.place
    silence = silence_of(file, line, rule)
    return replace(
        row,
        code=code_of(row.place),
        silence=None if silence is None else (silence.reason, silence.line),
    )


def _is_known(error: Problem, checkup: Checkup, degrees: Mapping[str, Degree]) -> bool:
    """Whether a rule about returned values (`_OF_RETURNS`) reports this error already."""
    returned = (each.rule for each in checkup.findings if each.rule in _OF_RETURNS)
    return error.stage == "returns" and any(degrees[rule] != "off" for rule in returned)


def raised(error: Problem, checkup: Checkup) -> Found:
    """An error of the task as a breach of the rule `runs`."""
    file, line = error.file, error.line
    place = None if file is None or line is None else (file, line, error.stage)
    early = checkup.fails_with_several
    alike = early is not None and (early.stage, early.file, early.line) == (
        error.stage,
        error.file,
        error.line,
    )
    advice = f". {ONE_ENV}" if alike else ""
    return Found(
        f"{error.stage}: {error.message.removesuffix('.') if alike else error.message}{advice}", place
    )


def check_gpu_rules(checkup: Checkup, degrees: Mapping[str, Degree]) -> list[RuleResult]:
    """Step all envs and reset random ones under the rules of GPU simulation. Returns a result without
    breaches for each rule: `gpu_results` makes the results with breaches from `Checkup.findings`, to which
    all checks add. Raises CheckEnded."""
    further: list[RuleResult] = []
    not_applicable: dict[str, str] = {}
    try:
        ended = ended_as(lambda: _of_task(lambda: _run_gpu_rules(checkup), checkup))
        error = ended.problem
        if error is None:
            not_applicable = _nothing_there(checkup.task)
        if error is not None and degrees["runs"] != "off" and not _is_known(error, checkup, degrees):
            further.append(result_of("runs", degrees["runs"], [raised(error, checkup)]))
    except CheckEnded:
        raise
    except Exception as error:
        problem = problem_of_crash(error)
        return [failed(rule, problem) for rule in gpu_rules_of(degrees)]
    results: list[RuleResult] = []
    for rule in gpu_rules_of(degrees):
        of_rule = ended
        if rule in not_applicable:
            of_rule = LookEnd("not_applicable", not_applicable[rule])
        elif error is None and rule in _OF_SEVERAL:
            of_rule = ended_as(checkup.require_several)
        results.append(_ended(RuleResult(rule, "kept"), of_rule))
    return [*results, *further]


def _run_gpu_rules(checkup: Checkup) -> None:
    rng, task = np.random.default_rng(0), checkup.task
    checkup.reset(task, checkup.seeds[0])
    for _ in range(GPU_RESETS):
        for _ in range(2):
            checkup.step(task, actions.random_action(task.parts, task.num_envs, rng))
        count = int(rng.integers(1, max(2, task.num_envs)))
        checkup.reset(task, None, sorted(rng.choice(task.num_envs, count, replace=False).tolist()))


def _nothing_there(task: TaskEnv) -> dict[str, str]:
    """The rules of GPU simulation that do not apply to this task, with the reason."""
    found: dict[str, str] = {}
    if task.env.reward_mode == "none":
        found["reward-rows"] = "the task has no reward"
    if not KeptRows(task.env, [0]).before:
        found |= dict.fromkeys(
            ("rows-lost", "rows-rewritten"), "the task keeps nothing with a row for each env"
        )
    return found


def gpu_results(
    findings: Iterable[Finding], silenced: Iterable[Silenced], degrees: Mapping[str, Degree]
) -> Iterator[RuleResult]:
    """The results of the rules of GPU simulation that have breaches or silenced breaches."""
    findings, silenced = list(findings), list(silenced)
    for rule in gpu_rules_of(degrees):
        of_rule = [replace(each, degree=degrees[rule]) for each in findings if each.rule == rule]
        once = {each.key: each for each in of_rule}
        off = {
            (each.finding.key, each.line): replace(each, finding=replace(each.finding, degree=degrees[rule]))
            for each in silenced
            if each.finding.rule == rule
        }
        if once or off:
            yield RuleResult(rule, _state(once, off), tuple(once.values()), tuple(off.values()))


def findings_of(checkup: Checkup, first: int = 0) -> tuple[Finding, ...]:
    """Breaches of the rules of GPU simulation so far, from index `first` on. If the task runs with one env
    only, messages about returned values end with `ONE_ENV`."""
    return tuple(
        replace(each, message=f"{each.message} {ONE_ENV}")
        if each.rule in _OF_RETURNS and checkup.fails_with_several is not None
        else each
        for each in checkup.findings[first:]
    )


def _state(findings: Sized, silenced: Sized) -> State:
    return "broken" if findings else "silenced" if silenced else "kept"


def result_of(
    rule: str, degree: Degree, seen: Sequence[Found | Note], rows: Sequence[Seen] = ()
) -> RuleResult:
    """The result of a rule, from what its check gave.

    Args:
        rows: rows that hold the code and the silencing comment of their places; needed if this process may
            have other versions of the files.
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
