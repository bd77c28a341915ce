"""A subprocess that makes the files of episodes in the background."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import sys
import threading
from dataclasses import dataclass
from pathlib import Path

from workbench.envs.scene.shapes import Visual
from workbench.episodes.writing.finish_or_recover import EpisodeFiles, make_files
from workbench.episodes.writing.from_journal import Header, read_header
from workbench.episodes.writing.journal import SCENE_SUFFIX, Journal, JournalReader, read_visuals
from workbench.machine.processes.child_environment import child_environment, start_with_socket
from workbench.machine.processes.wire import Unpacker, Unreadable, has_come, pack, pack_message

_MAX_MESSAGE_BYTES = 1 << 16
"""Maximum size of a message."""


@dataclass(frozen=True)
class _Make:
    journal: Path
    states: int
    visuals: int
    """Number of meshes of the scene; a scene file with fewer is broken."""


@dataclass(frozen=True)
class _Ready:
    """The subprocess has finished its imports."""


@dataclass(frozen=True)
class _Made:
    rrd: str
    h5: str
    json: str
    """File names of the recording."""
    solved_at: int | None
    means: dict[str, float]


@dataclass(frozen=True)
class _NotMade:
    """The files could not be made in the subprocess. The caller tries again in its own process, to get the
    real error."""


class FilesProcess:
    """Makes files from journals in a subprocess. Only one thread may call `make`; any thread may read
    `is_ready`.

    A thread would compete for the GIL with the env, whose calls of PhysX hold it. Starting the process takes
    a second of a core and 110 MB. The process has normal priority: with the lowest priority nothing was
    faster, and journals would pile up while all cores are busy.
    """

    def __init__(self) -> None:
        """Start the subprocess without waiting for it. Raises OSError."""
        self._is_ready = False
        self._asking = threading.Lock()
        self._unpacker = Unpacker((_Ready, _Made, _NotMade))
        self._process, self._end = start_with_socket(__name__, child_environment())

    @property
    def is_ready(self) -> bool:
        """False until the subprocess has finished its imports, and after it has ended."""
        with self._asking:
            if not self._is_ready and has_come(self._end):
                self._is_ready = isinstance(self._receive(), _Ready)
            return self._is_ready

    def make(self, journal: Journal, header: Header, states: int) -> EpisodeFiles | None:
        """Run `make_files` in the subprocess, into the folder of the recordings. Returns None if this failed;
        some files may have been made nevertheless."""
        path = journal.path.absolute()
        try:
            # The descriptor passes on the lock: no process recovers the journal meanwhile, even if this process is killed.
            asked = _Make(path, states, len(header.geometry.visuals))
            socket.send_fds(self._end, [pack(asked)], [journal.descriptor])
            made = self._receive()
        except OSError:
            made = None
        if isinstance(made, _Made):
            folder = journal.path.parent.parent
            return EpisodeFiles(
                folder / made.rrd, folder / made.h5, folder / made.json, made.solved_at, made.means
            )
        if made is None:
            self.close()
        return None

    def close(self) -> None:
        """Kill the subprocess."""
        self._is_ready = False
        self._end.close()
        self._process.kill()
        self._process.wait()

    def _receive(self) -> _Ready | _Made | _NotMade | None:
        """The next message; None if the subprocess has ended."""
        try:
            received = self._end.recv(_MAX_MESSAGE_BYTES)
            return self._unpacker.message(received) if received else None
        except (OSError, Unreadable):
            return None


# --- in the process ----------------------------------------------------------------------------


def main() -> None:
    """Run the subprocess: ``python -m workbench.episodes.writing.files_process SOCKET``.

    It ends when its socket closes.
    """
    end = socket.socket(fileno=int(sys.argv[1]))
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    scenes: dict[tuple[int, ...], tuple[Visual, ...]] = {}
    unpacker = Unpacker()
    with contextlib.suppress(ConnectionError):
        end.send(pack_message(_Ready()))
        while True:
            message, fds, _, _ = socket.recv_fds(end, _MAX_MESSAGE_BYTES, 1)
            if not message:
                return
            try:
                made = _make(unpacker.unpack(message, _Make), scenes)
            finally:
                for fd in fds:
                    os.close(fd)
            end.send(pack_message(made))


def _make(what: _Make, scenes: dict[tuple[int, ...], tuple[Visual, ...]]) -> _Made | _NotMade:
    try:
        # Episodes of a scene share one scene file by hard links. It is read once, because `write_rrd` caches
        # mesh chunks by visual object.
        path = what.journal.with_suffix(SCENE_SUFFIX)
        file = os.stat(path)
        key = (file.st_dev, file.st_ino, file.st_mtime_ns, file.st_size)
        if key not in scenes:
            scenes.clear()
            scenes[key] = read_visuals(path)
        with contextlib.closing(JournalReader(what.journal)) as reader:
            header = read_header(reader, scenes[key])
        if header is None or len(header.geometry.visuals) != what.visuals:
            return _NotMade()
        files = make_files(what.journal, header, what.journal.parent.parent, what.states)
    except Exception:
        return _NotMade()
    return _Made(files.rrd.name, files.h5.name, files.json.name, files.solved_at, dict(files.means))


if __name__ == "__main__":
    main()
