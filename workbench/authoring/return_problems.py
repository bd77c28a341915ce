"""Whether what a task's hooks return is what ManiSkill takes it for.

ManiSkill 3.0.1 checks none of it. Some mistakes raise far from their cause (``success`` as a
Python bool: "'bool' object has no attribute 'clone'", inside `BaseEnv.step`). The others are
silent: with several envs ``success`` of shape ``()`` gives a ``terminated`` of shape ``()``; a reward of shape
``(N, 1)``, of shape ``()``, or a Python float is handed on, and then broadcasts against ``(N,)``
into an ``(N, N)`` in somebody's trainer. With one env all of them look right. So they are checked
here, and told at the ``def`` of the hook that returned them. (A NaN has the right shape: it is a value,
and flagged in the env that has it, see `workbench.session.history.env_table`.)

Entries of ``evaluate()`` besides ``success`` and ``fail`` may be anything: ManiSkill passes them on. The checks are
pure: nothing is stepped, changed or moved from its device. Their words are those of `workbench.core.env.evaluate_entries`, which the core's strict mode raises with.
"""

from __future__ import annotations

import linecache
from collections.abc import Collection
from pathlib import Path

from workbench.authoring.problem import Problem, hook_definition, hooks_of
from workbench.core.env.evaluate_entries import no_reward, wrong_evaluate

_REWARD_HOOKS = hooks_of("reward")


def check_step_returns(
    cls: type,
    num_envs: int,
    evaluate: object,
    reward: object | None,
    source_files: Collection[Path],
) -> Problem | None:
    """The first thing wrong with what one step of `num_envs` envs of `cls` gave, or None.

    `evaluate` is what ``evaluate()`` returned: a dict in which ``success`` and ``fail`` are bool tensors of shape
    (N,), and the other entries whatever the author likes. `reward` is (N,): real numbers, or truths, which the rule
    `reward-rows` tells of and ManiSkill hands on; None where no reward was computed. With one env both may be of shape () too. Tensors may be on any device. A problem's stage is ``returns``; its
    place is in `source_files`, or None where the hook is inherited.
    """
    message = wrong_evaluate(evaluate, num_envs)
    if message is not None:
        return problem_from_return(cls, "evaluate", message, source_files)
    message = None if reward is None else no_reward(reward, num_envs)
    if message is not None:
        return problem_from_return(cls, _REWARD_HOOKS[0], message, source_files)
    return None


def problem_from_return(cls: type, hook: str, message: str, source_files: Collection[Path]) -> Problem:
    """The problem that `hook` of `cls` returned something wrong, as `message` says.

    A reward is told at the hook that the author defined: ManiSkill asks for a normalized one, and the
    author's dense one may be behind it.
    """
    hooks = _REWARD_HOOKS if hook in _REWARD_HOOKS else (hook,)
    found = hook_definition(cls, hooks, source_files)
    if found is None:
        return Problem("returns", f"{hooks[0]}() {message}", None, None, None, "")
    name, (file, line) = found
    code = linecache.getline(file, line).strip() or None
    return Problem("returns", f"{name}() {message}", file, line, code, "")
