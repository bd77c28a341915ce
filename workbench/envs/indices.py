"""Checks the env numbers that a caller names."""

from __future__ import annotations

import operator
from typing import Any

import numpy as np
import torch


def env_numbers(env_idx: Any) -> list[int]:
    """The numbers in `env_idx`, one or several, in the order given.

    Raises:
        TypeError: `env_idx` does not consist of integers, or is a mask.
    """
    try:
        each = [env_idx] if np.ndim(env_idx) == 0 else list(env_idx)
        if any(isinstance(i, (bool, np.bool_)) or getattr(i, "dtype", None) == torch.bool for i in each):
            raise TypeError("a mask")
        return [operator.index(i) for i in each]
    except TypeError as error:
        raise TypeError(
            f"env_idx and source must be integers, one per env, not {env_idx!r}; convert a mask with mask.nonzero().flatten()"
        ) from error


def require_env(env: int, num_envs: int) -> None:
    """Raise IndexError if there is no such env."""
    if not 0 <= env < num_envs:
        raise IndexError(f"env {env} is out of range for {num_envs} envs")


def envs_of_batch(env_idx: Any, num_envs: int) -> list[int]:
    """Env indices from `env_numbers`, checked: each exists and is named once.

    Raises:
        IndexError, ValueError: `env_idx` names an unknown env, an env twice, or no env.
    """
    chosen = env_numbers(env_idx)
    if not chosen:
        raise ValueError("env_idx is empty: name the envs, or leave it out for all")
    for i in chosen:
        require_env(i, num_envs)
    if len(set(chosen)) < len(chosen):
        raise ValueError(f"env_idx {chosen} names an env twice")
    return chosen
