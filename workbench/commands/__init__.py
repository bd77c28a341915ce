"""All that can be asked for on a page, by a script or by an agent: `COMMANDS`.

>>> from workbench.commands import COMMANDS
>>> for command in COMMANDS:
...     print(command.__name__, command.key, command.help())
"""

from __future__ import annotations

from workbench.commands import (
    cameras,
    checks,
    envs,
    library,
    page,
    recording,
    review,
    run,
    share,
    solve,
    tasks,
    timeline,
)
from workbench.commands.command import Command, CommandList, Refused

COMMANDS = CommandList(
    kind
    for module in (
        run,
        solve,
        timeline,
        envs,
        recording,
        checks,
        page,
        tasks,
        review,
        library,
        share,
        cameras,
    )
    for kind in vars(module).values()
    if isinstance(kind, type) and issubclass(kind, Command) and kind is not Command
)

__all__ = ["COMMANDS", "Command", "CommandList", "Refused"]
