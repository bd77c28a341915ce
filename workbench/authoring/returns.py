"""Whether what a task's hooks return is what ManiSkill takes it for.

ManiSkill 3.0.1 checks none of it. Some mistakes raise far from their cause (``success`` as a
Python bool: "'bool' object has no attribute 'clone'", inside `BaseEnv.step`). The others are
silent: ``success`` of shape ``()`` gives a ``terminated`` of shape ``()``; a reward of shape
``(N, 1)``, of shape ``()``, or a Python float is handed on, and then broadcasts against ``(N,)``
into an ``(N, N)`` in somebody's trainer; a NaN is handed on too. With one env all of them look
right. So they are checked here, and told at the ``def`` of the hook that returned them.

The rules are those of ManiSkill's guide to custom tasks ("ensure the data returned ... is all
batched"), and the checks are pure: nothing is stepped, changed or moved from its device.
"""

from __future__ import annotations

import linecache
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path

import torch

from workbench.authoring.problem import Problem, hook_definition, shorten

_REWARD_HOOKS = ("compute_dense_reward", "compute_normalized_dense_reward", "compute_sparse_reward")
_ENVS_NAMED = 8


def check_step_returns(
    cls: type,
    num_envs: int,
    evaluate: object,
    reward: object | None,
    source_files: Collection[Path],
) -> Problem | None:
    """The first thing wrong with what one step of `num_envs` envs of `cls` gave, or None.

    `evaluate` is what ``evaluate()`` returned: a dict of tensors with leading dimension N, in which
    ``success`` and ``fail`` are bool of shape (N,); dicts in it are looked into, and strings left
    alone. `reward` is (N,), floating and finite; None where no reward was computed. Tensors may be
    on any device. A problem's stage is ``returns``; its place is in `source_files`, or None where
    the hook is inherited.
    """
    message = _wrong_evaluate(evaluate, num_envs)
    if message is not None:
        return _problem(cls, ("evaluate",), message, source_files)
    assert isinstance(evaluate, Mapping)
    message = None if reward is None else _wrong_reward(reward, num_envs, evaluate)
    if message is not None:
        hooks = (
            tuple(name for name in _REWARD_HOOKS if hook_definition(cls, name, source_files)) or _REWARD_HOOKS
        )
        return _problem(cls, hooks, message, source_files)
    return None


def _wrong_evaluate(evaluate: object, num_envs: int) -> str | None:
    if not isinstance(evaluate, Mapping):
        return f"returned {_describe(evaluate)}; it must return a dict ({{}} where there is nothing to say)"
    for name, value in _entries(evaluate):
        if not isinstance(name, str):
            return f"returned the key {name!r}; names of entries must be strings"
        if name in ("success", "fail"):
            if not isinstance(value, torch.Tensor) or value.dtype != torch.bool or value.shape != (num_envs,):
                return (
                    f"returned {name!r} as {_describe(value)}; expected a bool tensor of shape ({num_envs},)"
                )
        elif isinstance(value, str):
            continue
        elif not isinstance(value, torch.Tensor):
            return (
                f"returned {name!r} as {_describe(value)}; expected a tensor with a row for each env, "
                f"of shape ({num_envs}, ...)"
            )
        elif value.ndim == 0 or value.shape[0] != num_envs:
            return (
                f"returned {name!r} as {_describe(value)}; "
                f"expected shape ({num_envs}, ...), a row for each env"
            )
    return None


def _wrong_reward(reward: object, num_envs: int, evaluate: Mapping[str, object]) -> str | None:
    expected = f"expected a floating tensor of shape ({num_envs},)"
    if not isinstance(reward, torch.Tensor) or reward.shape != (num_envs,):
        return f"returned {_describe(reward)}; {expected}"
    if not reward.dtype.is_floating_point:
        # ManiSkill's own sparse reward is `success` itself where a task has no `fail`.
        success = evaluate.get("success")
        if isinstance(success, torch.Tensor) and reward.dtype == torch.bool and torch.equal(reward, success):
            return None
        return f"returned {_describe(reward)}; {expected}"
    wrong = ~torch.isfinite(reward)
    if bool(wrong.any()):
        envs = wrong.nonzero().flatten().tolist()
        named = ", ".join(str(env) for env in envs[:_ENVS_NAMED]) + (
            " ..." if len(envs) > _ENVS_NAMED else ""
        )
        kind = "NaN" if bool(torch.isnan(reward).any()) else "infinity"
        return f"returned {kind} in {len(envs)} of {num_envs} envs ({named}); a reward must be finite"
    return None


def _entries(evaluate: Mapping[str, object], prefix: str = "") -> Iterator[tuple[object, object]]:
    for name, value in evaluate.items():
        if isinstance(value, Mapping) and isinstance(name, str):
            yield from _entries(value, f"{prefix}{name}/")
        else:
            yield (f"{prefix}{name}" if isinstance(name, str) else name), value


def _describe(value: object) -> str:
    if isinstance(value, torch.Tensor):
        return f"a {str(value.dtype).removeprefix('torch.')} tensor of shape {tuple(value.shape)}"
    shape, dtype = getattr(value, "shape", None), getattr(value, "dtype", None)
    if isinstance(shape, tuple) and dtype is not None:
        return f"a {type(value).__module__.partition('.')[0]} {dtype} array of shape {shape}"
    if value is None:
        return "None"
    return f"{type(value).__qualname__} ({shorten(repr(value), 60)})"


def _problem(cls: type, hooks: tuple[str, ...], message: str, source_files: Collection[Path]) -> Problem:
    for hook in hooks:
        place = hook_definition(cls, hook, source_files)
        if place is not None:
            file, line = place
            code = linecache.getline(file, line).strip() or None
            return Problem("returns", f"{hook}() {message}", file, line, code, "")
    return Problem("returns", f"{hooks[0]}() {message}", None, None, None, "")
