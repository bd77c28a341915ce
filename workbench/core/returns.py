"""What is wrong with what a task's hooks return, in words; None where nothing is.

ManiSkill takes success, fail, rewards and observations for batched, a row for each env, and looks at none. The checks here are
pure: they name a failing and leave it to the caller what that means (`strict` tells it, the page shows it
at the ``def`` of the hook).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import torch

from workbench.core.entries import FLAGS, safe_repr, type_text


def wrong_evaluate(evaluate: object, num_envs: int) -> str | None:
    """Said of ``evaluate()``: it must return a dict, in which ``success`` and ``fail`` are bool tensors (N,).

    The other entries may be anything, as in ManiSkill: what has no row for each env is shown as it is (`entries`).
    """
    if not isinstance(evaluate, Mapping):
        return f"returned {_describe(evaluate)}; it must return a dict ({{}} where there is nothing to say)"
    for name in FLAGS:
        value = evaluate.get(name)
        if name in evaluate and not (
            isinstance(value, torch.Tensor) and value.dtype == torch.bool and _a_row_each(value, num_envs)
        ):
            return f"returned {name!r} as {_describe(value)}; expected a bool tensor of shape ({num_envs},)"
    return None


def wrong_reward(reward: object, num_envs: int, evaluate: Mapping[str, Any]) -> str | None:
    """Said of the reward's hook: it must return a floating tensor (N,).

    What is in it is the task's own affair: a NaN in one env is a value, to be seen in that env's row and on its
    timeline while the others go on, and no wrong shape.
    """
    said = no_reward(reward, num_envs)
    if said is not None or not isinstance(reward, torch.Tensor) or reward.dtype.is_floating_point:
        return said
    # ManiSkill's own sparse reward is `success` itself where a task has no `fail`.
    success = evaluate.get("success")
    if isinstance(success, torch.Tensor) and reward.dtype == torch.bool and torch.equal(reward, success):
        return None
    return f"returned {_describe(reward)}; {_floating(num_envs)}: write .float() behind it"


def no_reward(reward: object, num_envs: int) -> str | None:
    """Said of what is no real number for each env, and can be neither drawn nor recorded; truths are 0 and 1."""
    if not isinstance(reward, torch.Tensor) or not _a_row_each(reward, num_envs) or reward.dtype.is_complex:
        return f"returned {_describe(reward)}; {_floating(num_envs)}"
    return None


def _floating(num_envs: int) -> str:
    return f"expected a floating tensor of shape ({num_envs},)"


def _a_row_each(value: torch.Tensor, num_envs: int) -> bool:
    # A single truth is the row of a single env: ManiSkill and its wrappers take it, and tasks written for one env give it.
    return value.shape == (num_envs,) or (num_envs == 1 and value.ndim == 0)


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
    if hasattr(value, "shape") and hasattr(value, "dtype"):
        return f"a {type_text(value)}"
    if value is None:
        return "None"
    text = " ".join(safe_repr(value)[:480].split())
    return f"{type(value).__qualname__} ({text if len(text) <= 60 else text[:59] + '…'})"
