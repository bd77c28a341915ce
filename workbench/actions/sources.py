"""Sources of actions of the live env. Imports no torch."""

from __future__ import annotations

from typing import Literal

ActionSource = Literal["hold", "zero", "random", "sliders", "policy", "solve"]
"""The actions of ``solve`` are planned by rollouts of the task; `ActionChooser` does not choose them."""
SOURCES: dict[str, ActionSource] = {
    "hold still": "hold",
    "zero": "zero",
    "random": "random",
    "sliders": "sliders",
    "policy": "policy",
    "solve": "solve",
}
"""Each source by its label on the page."""
