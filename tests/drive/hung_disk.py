"""A hung disk for the server process of a real command: once switched on, calls on a folder never return."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from tests.drive.waiting import until

# Only the server hangs: the processes that it starts have another command line.
_HANGS = """
import os, sys, time

def hang_below(folder, switch, calls):
    exists, make = os.access, os.mkdir

    def look(call, place):
        if call not in calls or not exists(switch, os.F_OK):
            return
        if isinstance(place, int):
            place = os.readlink(f"/proc/self/fd/{place}")
        if isinstance(place, (str, bytes, os.PathLike)) and os.fsdecode(place).startswith(folder):
            if not exists(switch + ".hangs", os.F_OK):
                make(switch + ".hangs")
            while True:
                time.sleep(3600)

    def hook(event, args):
        if event in ("open", "os.scandir", "os.listdir", "os.rename", "os.link"):
            writes = event == "open" and isinstance(args[2], int) and args[2] & (os.O_WRONLY | os.O_RDWR)
            look("write" if writes else event.removeprefix("os."), args[0])

    def of(name):
        call = getattr(os, name)

        def called(place, *more, **named):
            look(name, place)
            return call(place, *more, **named)

        return called

    for name in ("stat", "lstat", "pwrite", "fsync", "fdatasync"):
        setattr(os, name, of(name))
    sys.addaudithook(hook)

if "workbench.cli.main" in sys.orig_argv:
    hang_below(os.environ["HANG_BELOW"], os.environ["HANG_SWITCH"], os.environ["HANG_CALLS"].split())
"""


@dataclass(frozen=True)
class HungDisk:
    """Which calls hang, below which folder."""

    folder: Path
    aside: Path
    """A folder on another path, for the switch and the hook."""
    calls: Sequence[str]
    """Some of: open (to read), write (open to write), stat, lstat, pwrite, fsync, fdatasync, scandir, listdir, rename, link."""

    def environment(self) -> dict[str, str]:
        """Environment variables for the command."""
        (self.aside / "sitecustomize.py").write_text(_HANGS)
        return {
            "PYTHONPATH": os.pathsep.join([str(self.aside), *filter(None, [os.environ.get("PYTHONPATH")])]),
            "HANG_BELOW": str(self.folder),
            "HANG_SWITCH": str(self.aside / "switch"),
            "HANG_CALLS": " ".join(self.calls),
        }

    def hang(self) -> None:
        """Let the calls hang from now on."""
        (self.aside / "switch").touch()

    def until_it_hangs(self, meanwhile: Callable[[], object] = lambda: None) -> None:
        """Wait until a call hangs.

        Args:
            meanwhile: called repeatedly, for example a key press.
        """

        def hangs() -> bool:
            meanwhile()
            return (self.aside / "switch.hangs").exists()

        until(hangs, "a call that hangs")
