"""Pauses when a number of an env meets a condition, like a breakpoint."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from workbench.envs.step_result import StepResult
from workbench.live.history.curves import columns_by_label, number_of

Test = Literal["becomes true", "becomes false", "rises above", "falls below"]


@dataclass(frozen=True)
class PauseWhen:
    """A condition on one number of the selected env. It holds at a step at which it was not met before."""

    entry: str = ""
    """Label of the number, as on the curves; empty for no condition."""
    test: Test = "becomes true"
    level: float = 0.0
    """Threshold of ``rises above`` and ``falls below``."""

    def is_met(self, step: StepResult, env: int, joints: Sequence[str] = ()) -> bool:
        """Whether the number of this env meets the condition; False for NaN, and if there is no such number."""
        column = columns_by_label(step, joints).get(self.entry)
        value = np.nan if column is None else number_of(step, column, env, joints)
        if np.isnan(value):
            return False
        match self.test:
            case "becomes true":
                return bool(value)
            case "becomes false":
                return not value
            case "rises above":
                return value > self.level
            case "falls below":
                return value < self.level

    def holds(
        self, before: StepResult | None, step: StepResult, env: int, joints: Sequence[str] = ()
    ) -> bool:
        """Whether `step` meets the condition and `before`, the step before it in the same episode, does not."""
        if not self.entry or not self.is_met(step, env, joints):
            return False
        return before is None or not self.is_met(before, env, joints)

    @property
    def text(self) -> str:
        """``success becomes true``, ``reward rises above 0.9``; empty without a condition."""
        if not self.entry:
            return ""
        level = f" {self.level:g}" if self.test in ("rises above", "falls below") else ""
        return f"{self.entry} {self.test}{level}"
