"""What the nursery of readers is asked for."""

from __future__ import annotations

import msgspec


class NewReader(msgspec.Struct, tag=True):
    """Fork one that reads below these paths; its socket comes along. Answered by its process id."""

    paths: list[bytes]
    episodes: bool
    """It will read whole episodes: import what that needs at once."""


class Ended(msgspec.Struct, tag=True):
    """That reader was ended, or has ended. Answered by its exit status as `os.waitstatus_to_exitcode` gives it."""

    pid: int
