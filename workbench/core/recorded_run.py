"""What of a recorded episode it takes to live through it again, as plain arrays that can cross a pipe.

Whoever reads a recording need not know an env, and the env need not know files: between them goes this. State 0 is
the reset; action t leads to state t + 1.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class RecordedRun:
    """T actions of one env, and its T + 1 states as far as they were recorded."""

    name: str
    """What a person calls it."""
    seed: int
    """Episode seed; below 0 where it is not known."""
    reset_options: dict[str, Any]
    """``options`` of the reset that began it."""
    action: NDArray[np.float32]
    """(T, A)"""
    env_states: dict[str, NDArray]
    """``actors/cube``, ``articulations/panda`` ..., (T + 1, D) each, as ManiSkill's ``get_state_dict`` lays them out;
    empty where none were recorded."""
    evaluate: dict[str, NDArray] = field(default_factory=dict)
    """(T + 1, ...) every entry that ``evaluate`` returned."""
    reward: NDArray[np.float32] = field(default_factory=lambda: np.zeros(0, np.float32))
    """(T,)"""

    @property
    def length(self) -> int:
        """T, the number of control steps."""
        return len(self.action)

    def state(self, at: int) -> dict[str, NDArray]:
        """(D,) of every actor and articulation in state `at`; empty where it was not recorded."""
        return {name: rows[at] for name, rows in self.env_states.items() if at < len(rows)}

    def until(self, state: int) -> RecordedRun:
        """Its beginning, up to that state."""
        return replace(
            self,
            action=self.action[:state],
            env_states={name: rows[: state + 1] for name, rows in self.env_states.items()},
            evaluate={name: rows[: state + 1] for name, rows in self.evaluate.items()},
            reward=self.reward[:state],
        )
