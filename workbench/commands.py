"""All commands that a page, a script or an agent can use: `COMMANDS`.

>>> from workbench.commands import COMMANDS
>>> for command in COMMANDS:
...     print(command.__name__, command.key, command.help())
"""

from __future__ import annotations

from workbench.cameras import commands as cameras
from workbench.checks import commands as checks
from workbench.hands import commands as hands
from workbench.library import commands as library
from workbench.live import commands as run
from workbench.live import env_commands as envs
from workbench.live import timeline_commands as timeline
from workbench.page import commands as page
from workbench.page.command import Command, CommandList, Refused
from workbench.record import commands as recording
from workbench.review import commands as review
from workbench.share import commands as share
from workbench.solve import commands as solve
from workbench.start import commands as tasks

_MODULES = {
    "Run": (run, solve),
    "Timeline": (timeline,),
    "Envs": (envs,),
    "Recording": (recording,),
    "Page": (checks, page, tasks),
    "Review": (review, share),
    "Library": (library,),
    "The chosen camera": (cameras,),
    "The selected body": (hands,),
}
"""Modules of commands by the heading under which the page lists their keys."""

COMMANDS = CommandList(
    {
        heading: [
            kind
            for module in modules
            for kind in vars(module).values()
            if isinstance(kind, type) and issubclass(kind, Command) and kind is not Command
        ]
        for heading, modules in _MODULES.items()
    }
)

__all__ = ["COMMANDS", "Command", "CommandList", "Refused"]
