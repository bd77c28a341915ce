"""What a dead writer left in a folder is made episodes (`recover`) in a process of its own.

A folder that came from elsewhere may bring journals along, which are Arrow's and numpy's files as recordings are HDF5's
and rerun's. So the process that reads them may write below that folder alone, and has a limit on memory and time. It
is started only where something was left.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

from workbench.machine.child_python import child_environment, python_command
from workbench.machine.confinement import confine
from workbench.recording.journal import FOLDER
from workbench.recording.landing import RecordingError
from workbench.recording.reader.processes import FOR_READING

MOST_MEMORY = 4 << 30
MOST_SECONDS = 1800.0
"""An hour with four cameras takes some minutes."""


def mend(folder: Path) -> tuple[Path, ...]:
    """The .rrd of each episode that was made of what lay there.

    Raises:
        RecordingError: files cannot be written, or the folder not read, or it was given up; the journals stay.
    """
    try:
        if not any(os.scandir(folder / FOLDER)):
            return ()
    except FileNotFoundError:
        return ()
    except OSError as error:
        raise RecordingError(f"Cannot recover what lies in {folder}: {error.strerror}") from error
    try:
        done = subprocess.run(
            python_command("-m", "workbench.recording.mend", os.fspath(folder.absolute())),
            env=child_environment(**FOR_READING),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            timeout=MOST_SECONDS,
            start_new_session=True,
        )
    except subprocess.TimeoutExpired as error:
        raise RecordingError(
            f"Cannot recover what lies in {folder / FOLDER}: it takes longer than {MOST_SECONDS:.0f} s"
        ) from error
    try:
        said = json.loads(done.stdout)
    except ValueError:
        said = {}
    if isinstance(made := said.get("made"), list):
        # Names alone: the process that says them has read what came from elsewhere.
        return tuple(folder / Path(str(name)).name for name in made)
    why = said.get("problem") or f"the process that reads it ended with {done.returncode}"
    raise RecordingError(str(why) if said else f"Cannot recover what lies in {folder / FOLDER}: {why}")


def main() -> None:
    """Entry of the process."""
    from workbench.recording.recover import recover

    folder = Path(sys.argv[1])
    confine([Path("/")], MOST_MEMORY, [folder])
    try:
        said: dict[str, object] = {"made": [files.rrd.name for files in recover(folder)]}
    except RecordingError as error:
        said = {"problem": str(error)}
    except MemoryError:
        said = {"problem": f"Cannot recover what lies in {folder}: it takes more memory than it may"}
    print(json.dumps(said))


if __name__ == "__main__":
    main()
