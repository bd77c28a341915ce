"""The rules of GPU simulation, each with an id and a degree, and how an author silences one. Imports no simulator."""

from __future__ import annotations

import ast
import linecache
import re
import tokenize
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, get_args

from workbench.machine.parse_python import parse_python

Degree = Literal["stop", "warn", "off"]
"""*stop* raises at the line that broke the rule; *warn* reports the line, and the operation continues as without rules, to the
last bit. By default a rule stops where the state of other envs is overwritten, since every number after that is wrong."""
DEGREES: tuple[Degree, ...] = get_args(Degree)
FailOn = Literal["stop", "warn", "never"]
"""The lowest degree of a finding that makes a command's exit code 1."""


def fails(degree: Degree, fail_on: FailOn) -> bool:
    """Whether a finding of this degree makes the exit code 1."""
    return fail_on != "never" and DEGREES.index(degree) <= DEGREES.index(fail_on)


@dataclass(frozen=True)
class Rule:
    """What a task must do to run on the GPU as it runs here."""

    id: str
    degree: Degree
    """Default degree."""
    asks: str
    """What the task must do, in a sentence."""
    otherwise: str
    """What happens on the GPU if the task does not."""
    hook: str = "_initialize_episode"
    """The hook that it guards."""


_TABLE = (
    # --- the state of other envs is overwritten -----------------------------------------------------
    Rule(
        "other-env-written",
        "stop",
        "_initialize_episode(env_idx) writes the state of the envs in env_idx only.",
        "The episodes of other envs change.",
    ),
    Rule(
        "rows-lost",
        "stop",
        "What a task keeps on itself has a row for each env after a partial reset too.",
        "What was kept of other envs is lost; the next use of it fails, or takes the wrong row.",
    ),
    # --- the rest -------------------------------------------------------------------------------------
    Rule(
        "stepped-in-reset",
        "warn",
        "_initialize_episode does not call scene.step() while other envs are in the middle of an episode.",
        "The episodes of other envs advance.",
    ),
    Rule(
        "apply-before-fetch",
        "warn",
        "After a step, state is fetched before it is written and applied.",
        "Every body of every env is put back to before the step.",
        "step",
    ),
    Rule(
        "state-while-built",
        "warn",
        "State (poses, velocities, qpos, drive targets) is read and set once the scene is complete: in _after_reconfigure or "
        "_initialize_episode.",
        "The build fails: there are no tensors of state yet.",
        "_load_scene",
    ),
    Rule(
        "refused-by-gpu",
        "warn",
        "Mass, limits, damping and drives of joints are set and bodies removed while the scene is built; static actors are not "
        "moved; values have a row for each env that is written.",
        "The call raises.",
    ),
    Rule(
        "one-env-only",
        "warn",
        "Nothing is used that exists for one env only, such as scene.get_contacts() or scene.px.raycast().",
        "It does not exist in GPU simulation; here one env is opened.",
        "evaluate",
    ),
    Rule(
        "rows-rewritten",
        "warn",
        "_initialize_episode(env_idx) changes the rows of env_idx only in what a task keeps on itself.",
        "Other envs continue with another target, counter or best value than they began with.",
    ),
    Rule(
        "applied-by-reset",
        "warn",
        "State that is set outside _initialize_episode is applied before other envs are reset.",
        "The reset of other envs applies it, at a moment that the task did not choose.",
        "step",
    ),
    Rule(
        "not-applied",
        "warn",
        "State that is set outside _initialize_episode is applied (scene._gpu_apply_all(), then "
        "scene._gpu_fetch_all()) before the next fetch.",
        "Physics never sees it; pictures do.",
        "step",
    ),
    Rule(
        "link-pose-set",
        "warn",
        "Links are moved by the qpos and the root pose of their articulation.",
        "Physics never sees the pose of a link; pictures do.",
        "step",
    ),
    Rule(
        "read-before-fetch",
        "warn",
        "After a step, state is fetched before it is read.",
        "A read gives the state before the step.",
        "step",
    ),
    Rule(
        "link-before-update",
        "warn",
        "After qpos or a root pose was set, links are read after gpu_update_articulation_kinematics().",
        "The links are still where they were.",
        "step",
    ),
    Rule(
        "behind-the-tensors",
        "warn",
        "State is set through ManiSkill's objects, not through SAPIEN's.",
        "Nothing happens: the GPU's simulation does not look there.",
        "step",
    ),
    Rule(
        "controller-targets",
        "warn",
        "A controller says in sets_target_qpos and sets_target_qvel which drive targets it sets.",
        "Each step raises AttributeError.",
        "step",
    ),
    Rule(
        "evaluate-rows",
        "stop",
        "evaluate() returns a row for each env.",
        "It is broadcast over the envs, or an error comes up somewhere else.",
        "evaluate",
    ),
    Rule(
        "evaluate-flags",
        "warn",
        "The entries success and fail of evaluate() are bool tensors.",
        "ManiSkill's wrappers fail on them, as ManiSkillVectorEnv with record_metrics does.",
        "evaluate",
    ),
    Rule(
        "reward-rows",
        "warn",
        "The reward is a floating tensor with a number for each env.",
        "It is broadcast over the envs, into (N, N) in a trainer.",
        "compute_dense_reward",
    ),
    Rule(
        "observation-rows",
        "warn",
        "Observations have a row for each env.",
        "They are broadcast over the envs, or an error comes up somewhere else.",
        "_get_obs_extra",
    ),
)
RULES: Mapping[str, Rule] = {rule.id: rule for rule in _TABLE}


def degrees_of(choice: Degree | None) -> dict[str, Degree]:
    """The degree of each rule: `choice` for all, or each rule's own if it is None.

    Raises:
        ValueError: `choice` is no degree.
    """
    if choice is not None and choice not in DEGREES:
        raise ValueError(f"rules must be 'stop', 'warn' or 'off', not {choice!r}")
    return {rule.id: rule.degree if choice is None else choice for rule in _TABLE}


@dataclass(frozen=True)
class Finding:
    """Breaches of one rule at one place."""

    rule: str
    """Its id."""
    degree: Degree
    message: str
    """Message of the first breach: what was done, its effect, and what to write instead."""
    file: str | None
    """File of the line; None if unknown."""
    line: int | None
    """1-based line in `file`."""
    code: str
    """The text of that line, stripped."""
    function: str
    """Function or hook of the line."""
    count: int
    """Number of breaches."""
    first_step: int
    """Control steps of the batch before the first breach; 0 in a reset before the first step, and in the reset and step
    with which a page tries a version."""

    @property
    def key(self) -> tuple[str, str | None, str, str]:
        """Stays the same when lines around it move."""
        return self.rule, self.file, self.function, self.code


# --- silenced in the source ------------------------------------------------------------------------------
# ``# workbench: off[reward-rows] one env only, see the paper`` stands in the line of the finding, alone in the line above, or
# in the ``def`` or ``class`` line around it. Without a reason it silences nothing.

_COMMENT = re.compile(r"#\s*workbench:\s*off\[([\w\s,-]*)\]\s*(.*)")


@dataclass(frozen=True)
class Silence:
    """One comment."""

    line: int
    """1-based."""
    rules: frozenset[str]
    reason: str
    alone: bool
    """Whether nothing else is in its line."""


def silences(text: str) -> tuple[Silence, ...]:
    """The comments of a file's text; none of a text that Python cannot read."""
    return _read(text)[0]


def silence_of(file: str | None, line: int | None, rule: str) -> Silence | None:
    """The comment that silences a finding at this line; None if there is none."""
    if file is None or line is None or file.startswith("<"):
        return None
    found, scopes = _read("".join(linecache.getlines(file)))
    if not found:
        return None
    # A decorator belongs to its function: a finding may be placed at either.
    heads = {head for first, head, last in scopes if first <= line <= last}
    for one in found:
        here = one.line == line or one.line in heads or (one.alone and one.line == line - 1)
        if here and rule in one.rules and one.reason:
            return one
    return None


@lru_cache(maxsize=64)
def _read(text: str) -> tuple[tuple[Silence, ...], tuple[tuple[int, int, int], ...]]:
    """The comments, and (first, head, last) line of each function and class."""
    if "workbench:" not in text:
        return (), ()
    try:
        found = tuple(_comments(text))
        scopes = tuple(_scopes(parse_python(text)))
    except (SyntaxError, tokenize.TokenError, ValueError, RecursionError):
        return (), ()
    return found, scopes


def _comments(text: str) -> Iterator[Silence]:
    lines = iter(text.splitlines(keepends=True))
    for token in tokenize.generate_tokens(lambda: next(lines, "")):
        if token.type != tokenize.COMMENT or (match := _COMMENT.match(token.string)) is None:
            continue
        rules = frozenset(re.split(r"[\s,]+", match[1].strip())) - {""}
        alone = not token.line[: token.start[1]].strip()
        yield Silence(token.start[0], rules, match[2].strip(" -–:"), alone)


def _scopes(tree: ast.Module) -> Iterator[tuple[int, int, int]]:
    for node in ast.walk(tree):
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)):
            first = min([node.lineno, *(each.lineno for each in node.decorator_list)])
            yield first, node.lineno, node.end_lineno or node.lineno
