"""How the state columns of a batch are named (`state_columns` makes them), for whoever takes them apart without torch."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np
from numpy.typing import NDArray

STATE, OBS = "state/", "obs/"
"""What the names of columns begin with: ``state/actors/cube``, ``obs/agent/qpos``."""


def observation_of(columns: Mapping[str, NDArray], env: int) -> dict[str, NDArray]:
    """One env's observation, by the names that it has in the task."""
    return _under(OBS, columns, env)


def states_of(columns: Mapping[str, NDArray], env: int) -> dict[str, NDArray]:
    """One env's states. Those of what it does not have, which is NaN in the columns, are left out."""
    return {name: value for name, value in _under(STATE, columns, env).items() if not np.isnan(value).all()}


def named_states_of(columns: Mapping[str, NDArray], env: int, names: Collection[str]) -> dict[str, NDArray]:
    """One env's states of these names, whatever they are: a body that was lost to NaN is still there."""
    return {name: value for name, value in _under(STATE, columns, env).items() if name in names}


def _under(prefix: str, columns: Mapping[str, NDArray], env: int) -> dict[str, NDArray]:
    return {name[len(prefix) :]: column[env] for name, column in columns.items() if name.startswith(prefix)}
