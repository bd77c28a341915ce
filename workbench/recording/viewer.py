"""Open recordings in rerun's own viewer in a window, where there is a screen.

What rerun serves besides binds to every address by default; here it is told loopback. Where there is no screen the
same viewer runs in a page: see `workbench.ui.rerun_view`.
"""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from workbench.machine.terminal_text import only_colours
from workbench.recording.rerun_process import (
    LOOPBACK,
    await_port,
    end,
    free_port,
    quiet_environment,
    rerun_command,
)


@dataclass
class Viewer:
    """A window that is open; `wait` until its person is done with it, or `close` it."""

    _process: subprocess.Popen[bytes]
    _says: threading.Thread

    def wait(self) -> None:
        """Return when the window is closed.

        Raises:
            RuntimeError: the viewer ended by itself with an error.
        """
        # Not for ever in one go: a signal that the kernel hands to another thread does not wake this one.
        while (status := self._process.poll()) is None:
            time.sleep(0.1)
        if status:
            self._says.join(timeout=5.0)
            raise RuntimeError(f"rerun's viewer ended with {status}; what it said is above.")

    def close(self) -> None:
        end(self._process)


def recordings_among(paths: Sequence[Path]) -> list[Path]:
    """These recordings, in full.

    Raises:
        ValueError: `paths` is empty, or one is no .rrd file by its name.
        FileNotFoundError: one of them is no file.
    """
    files = [Path(path).resolve() for path in paths]
    if not files:
        raise ValueError("No recording was named: give the path of one or more .rrd files.")
    for file in files:
        if not file.is_file():
            raise FileNotFoundError(f"{file} is not a file: give the path of an .rrd file.")
        if file.suffix != ".rrd":
            # A page would show nothing of it, and say nothing.
            raise ValueError(f"{file} is no .rrd file.")
    return files


def open_window(paths: Sequence[Path]) -> Viewer:
    """Show the recordings at `paths` together, in a window of rerun's viewer.

    Raises:
        ValueError, FileNotFoundError: see `recordings_among`.
        RuntimeError: there is no screen here, or rerun did not start.
    """
    files = recordings_among(paths)
    if not has_screen(os.environ):
        # Rerun would listen, load and only then find out.
        raise RuntimeError(
            "There is no screen here (DISPLAY and WAYLAND_DISPLAY are empty); open the page instead."
        )
    port = free_port()
    command = [*rerun_command(), "--bind", LOOPBACK, "--port", str(port), "--hide-welcome-screen"]
    process = subprocess.Popen(
        [*command, *map(os.fspath, files)],
        env=quiet_environment(),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
    )
    says = threading.Thread(target=_print_all, args=(process.stdout,), name="rerun-says", daemon=True)
    says.start()
    await_port(process, port)
    return Viewer(process, says)


def _print_all(said: IO[bytes]) -> None:
    """What rerun says of a file has names from the file in it."""
    with said:
        for line in said:
            print(only_colours(line.decode(errors="replace")), end="", file=sys.stderr, flush=True)


def has_screen(environment: Mapping[str, str]) -> bool:
    """Whether a window can be opened: where a display is named."""
    return bool(environment.get("DISPLAY") or environment.get("WAYLAND_DISPLAY"))
