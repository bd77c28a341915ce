"""Workbench: an interactive authoring workbench for ManiSkill tasks. `__all__` is the public API."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from workbench.envs.inspect_env import list_contacts as list_contacts
    from workbench.envs.snapshots.snapshot import begin_anew as begin_anew
    from workbench.envs.snapshots.snapshot import restore_snapshot as restore_snapshot
    from workbench.envs.snapshots.snapshot import take_snapshot as take_snapshot
    from workbench.episodes.reader.read_episode import read_episode as read_episode
    from workbench.planning.planner import Planner as Planner
    from workbench.record.gym_wrapper import Recorder as Recorder
    from workbench.task.gym_env import make as make

__version__ = "0.1.0"
__all__ = [
    "Planner",
    "Recorder",
    "begin_anew",
    "list_contacts",
    "make",
    "read_episode",
    "restore_snapshot",
    "take_snapshot",
]

_HOMES = {
    "Planner": "planning.planner",
    "Recorder": "record.gym_wrapper",
    "begin_anew": "envs.snapshots.snapshot",
    "list_contacts": "envs.inspect_env",
    "make": "task.gym_env",
    "read_episode": "episodes.reader.read_episode",
    "restore_snapshot": "envs.snapshots.snapshot",
    "take_snapshot": "envs.snapshots.snapshot",
}


def __getattr__(name: str) -> Any:
    # Import lazily: the process that serves the page imports this package, and must start without ManiSkill,
    # whose import takes seconds and needs a graphics driver.
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    try:
        return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
    except ModuleNotFoundError as error:
        from workbench.machine.maniskill_installed import lines_if_lacking

        lines = lines_if_lacking(f"{__name__}.{name}")
        if error.name != "mani_skill" or lines is None:
            raise
        raise ModuleNotFoundError("\n".join(lines), name=error.name) from None


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
