"""How the state columns of a batch are named (`state_columns` makes them), for whoever takes them apart without torch."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

STATE, OBS = "state/", "obs/"
"""What the names of columns begin with: ``state/actors/cube``, ``obs/agent/qpos``."""


def states_of(columns: Mapping[str, NDArray], env: int) -> dict[str, NDArray]:
    """One env's states. Those of what it does not have, which is NaN in the columns, are left out."""
    rows = {name[len(STATE) :]: column[env] for name, column in columns.items() if name.startswith(STATE)}
    return {name: row for name, row in rows.items() if not np.isnan(row).all()}
