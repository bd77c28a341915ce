"""What is wrong with what a task's hooks return, in words; None where nothing is.

ManiSkill takes every return for batched, a row for each env, and looks at none. The checks here are
pure: they name a failing and leave it to the caller what that means (`strict` tells it, the page shows it
at the ``def`` of the hook).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import torch


def wrong_evaluate(evaluate: object, num_envs: int) -> str | None:
    """Said of ``evaluate()``: it must return a dict of tensors (N, ...), ``success`` and ``fail`` bool (N,)."""
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


def wrong_reward(reward: object, num_envs: int, evaluate: Mapping[str, Any]) -> str | None:
    """Said of the reward's hook: it must return a floating tensor (N,).

    What is in it is the task's own affair: a NaN in one env is a value, to be seen in that env's row and on its
    timeline while the others go on, and no wrong shape.
    """
    expected = f"expected a floating tensor of shape ({num_envs},)"
    if not isinstance(reward, torch.Tensor) or reward.shape != (num_envs,):
        return f"returned {_describe(reward)}; {expected}"
    if not reward.dtype.is_floating_point:
        # ManiSkill's own sparse reward is `success` itself where a task has no `fail`.
        success = evaluate.get("success")
        if isinstance(success, torch.Tensor) and reward.dtype == torch.bool and torch.equal(reward, success):
            return None
        return f"returned {_describe(reward)}; {expected}"
    return None


def wrong_reward_terms(terms: object, num_envs: int) -> str | None:
    """Said of ``info["reward_terms"]``, which a reward's hook may leave: a dict of numbers (N,), one a part."""
    expected = f"expected a dict of tensors of shape ({num_envs},), one for each part of the reward"
    if not isinstance(terms, Mapping):
        return f"put into info 'reward_terms' as {_describe(terms)}; {expected}"
    for name, value in terms.items():
        if not isinstance(name, str):
            return f"put the key {name!r} into info['reward_terms']; names of terms must be strings"
        if not isinstance(value, torch.Tensor) or value.is_complex() or value.shape != (num_envs,):
            return f"put into info 'reward_terms/{name}' as {_describe(value)}; {expected}"
    return None


def wrong_observation(obs: object, num_envs: int) -> str | None:
    """Said of an observation hook: every entry of the dict that it returns is an array (N, ...)."""
    if not isinstance(obs, Mapping):
        return f"returned {_describe(obs)}; it must return a dict ({{}} where there is nothing to observe)"
    for name, value in _entries(obs):
        shape = getattr(value, "shape", None)
        if shape is None or len(shape) == 0 or shape[0] != num_envs:
            return (
                f"returned {name!r} as {_describe(value)}; "
                f"expected shape ({num_envs}, ...), a row for each env"
            )
    return None


def _entries(returned: Mapping[Any, Any], prefix: str = "") -> Iterator[tuple[object, object]]:
    for name, value in returned.items():
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
    text = " ".join(repr(value)[:480].split())
    return f"{type(value).__qualname__} ({text if len(text) <= 60 else text[:59] + '…'})"
