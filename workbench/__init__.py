"""Workbench: an interactive authoring workbench for ManiSkill tasks."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from workbench.gym_env import make as make
    from workbench.recorder import Recorder as Recorder

__version__ = "0.1.0"


def __getattr__(name: str) -> Any:
    # Not imported above: the process that serves the page imports this package, and must start without
    # the seconds and the graphics driver that ManiSkill takes.
    if name == "make":
        from workbench.gym_env import make

        return make
    if name == "Recorder":
        from workbench.recorder import Recorder

        return Recorder
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
