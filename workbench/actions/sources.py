"""Sources of actions of the live env. Imports no torch."""

from __future__ import annotations

from typing import Literal

ActionSource = Literal["hold", "zero", "random", "sliders", "policy", "solve"]
"""``solve``: planned by rollouts of the task, outside of `ActionChooser`."""
SOURCES: dict[str, ActionSource] = {
    "hold still": "hold",
    "zero": "zero",
    "random": "random",
    "sliders": "sliders",
    "policy": "policy",
    "solve": "solve",
}
"""Each source by its label on the page."""
