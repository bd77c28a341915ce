"""The process that forks readers, and the readers' request loop."""

from __future__ import annotations

import gc
import os
import signal
import socket
import sys
from collections import OrderedDict
from typing import Literal, get_args

from workbench.machine.processes.confinement import confine
from workbench.machine.processes.family import end_with_parent
from workbench.machine.processes.wire import MessageSocket, Unpacker, pack, pack_message
from workbench.recording.episode.episode import CameraTrack
from workbench.recording.episode.row import Source, UnreadableRecording, clean_text
from workbench.recording.reader.episode_wire import SentShapes, pack_episode
from workbench.recording.reader.read_rows import read_found
from workbench.recording.reader.requests import (
    Answer,
    CloseEpisodes,
    Ended,
    EpisodeRead,
    FindSources,
    NewReader,
    OpenEpisode,
    PictureRead,
    ReadFailed,
    ReadPicture,
    ReadRerunInfo,
    ReadRows,
    Recover,
    Recovered,
    Request,
    RerunInfo,
    RowsRead,
    SourcesFound,
)
from workbench.recording.reader.scan import Found

MOST_MEMORY = 3 << 30
"""Bytes that a reader may allocate; an episode has at most a third of it as numbers."""
LONGEST = 1 << 20
MOST_RECOVERY_MEMORY = 4 << 30
"""The same for a reader that recovers recordings."""
MOST_SHARED = 4
"""Groups of episodes (`OpenEpisode.sharing`) whose shapes are kept."""
LONGEST_MESSAGE = 600


def main() -> None:
    """Run the fork server: ``python -m workbench.recording.reader.fork_server SOCKET``.

    Forking takes milliseconds where starting Python takes half a second. It has imported what readers need and reads no
    recording itself. It has one thread, since a fork copies no other (numpy's are turned off in its environment), and
    ends when its socket closes; its readers end with it.
    """
    control = socket.socket(fileno=int(sys.argv[1]))
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    gc.freeze()
    while True:
        message, fds, _, _ = socket.recv_fds(control, LONGEST, 1)
        if not message:
            return
        wanted = Unpacker().unpack(message, NewReader | Ended)
        if isinstance(wanted, Ended):
            _, status = os.waitpid(wanted.pid, 0)
            control.send(pack(os.waitstatus_to_exitcode(status)))
            continue
        fork_server = os.getpid()
        pid = os.fork()
        if pid == 0:
            control.close()
            _run_reader(socket.socket(fileno=fds[0]), wanted, fork_server)
        os.close(fds[0])
        try:
            os.setpgid(pid, pid)  # also here: its group may be killed before the reader has made it
        except OSError:
            pass  # the reader made it, or has ended
        control.send(pack(pid))


def _run_reader(end: socket.socket, wanted: NewReader, fork_server: int) -> None:
    try:
        end_with_parent(fork_server)
        os.setpgid(0, 0)
        if wanted.writes is None:
            confine(wanted.paths, MOST_MEMORY)
        else:
            confine(wanted.paths, MOST_RECOVERY_MEMORY, [wanted.writes])
        serve(MessageSocket(end, get_args(Request)))
    finally:
        os._exit(0)


# --- a reader --------------------------------------------------------------------------------------


def serve(line: MessageSocket) -> None:
    """Answer requests until the socket closes."""
    reader = _Reader()
    while True:
        try:
            wanted = line.receive(None)
            if isinstance(wanted, CloseEpisodes):
                reader.forget(wanted.opened)
                continue
            line.send_bytes(reader.answer(wanted))
        except (EOFError, OSError):
            return


class _Reader:
    def __init__(self) -> None:
        self._opened: dict[int, list[CameraTrack]] = {}
        self._number = 0
        self._shapes: OrderedDict[int, SentShapes] = OrderedDict()

    def forget(self, opened: list[int]) -> None:
        for number in opened:
            self._opened.pop(number, None)

    def answer(self, wanted: Request) -> bytes:
        """The packed answer; packing may run out of memory too."""
        try:
            return pack_message(self._answer(wanted))
        except UnreadableRecording as error:
            failed = _failed("unreadable", str(error))
        except MemoryError:
            failed = _failed("unreadable", "Reading it needs more memory than a recording may use.")
        except OSError as error:
            failed = _failed("system", str(error))
        except Exception as error:
            # Untrusted files can fail in any way, and the reader must serve the next request.
            failed = _failed("unreadable", f"It cannot be read ({type(error).__name__}: {error}).")
        except BaseException as error:
            if type(error).__name__ != "PanicException":  # raised by rerun's Rust code
                raise
            failed = _failed("unreadable", f"It cannot be read (rerun's reader gave up: {error}).")
        return pack_message(failed)

    def _answer(self, wanted: Request) -> Answer:
        if isinstance(wanted, ReadRows):
            found = Found(os.fsdecode(wanted.key), wanted.sizes, wanted.times)
            return RowsRead(read_found(wanted.folder, found))
        if isinstance(wanted, OpenEpisode):
            return self._open(wanted)
        if isinstance(wanted, ReadPicture):
            return self._picture(wanted)
        if isinstance(wanted, FindSources):
            return _sources(wanted)
        if isinstance(wanted, ReadRerunInfo):
            return _rerun_info(wanted)
        assert isinstance(wanted, Recover)
        from workbench.recording.writing.finish import recover

        return Recovered([files.rrd.name for files in recover(wanted.folder)])

    def _open(self, wanted: OpenEpisode) -> EpisodeRead:
        from workbench.recording.lerobot.read import read_lerobot
        from workbench.recording.reader.read_episode import read_maniskill, read_without_task

        shapes = self._shapes.setdefault(wanted.sharing, SentShapes())
        self._shapes.move_to_end(wanted.sharing)
        while len(self._shapes) > MOST_SHARED:
            self._shapes.popitem(last=False)
        source_path = None
        if wanted.kind == "lerobot":
            episode = read_lerobot(wanted.path, int(wanted.part))
        elif wanted.kind == "maniskill":
            episode = read_maniskill(wanted.path, wanted.part)
        else:
            episode, source_path = read_without_task(wanted.path, shapes.shapes)
        self._number += 1
        self._opened[self._number] = episode.cameras
        return pack_episode(episode, source_path, self._number, shapes)

    def _picture(self, wanted: ReadPicture) -> PictureRead | ReadFailed:
        cameras = self._opened.get(wanted.opened, [])
        if not 0 <= wanted.camera < len(cameras):
            return _failed("gone", "That recording is not open.")
        pictures = cameras[wanted.camera].pictures.get(wanted.modality)
        if pictures is None or not 0 <= wanted.index < len(pictures):
            return _failed("unreadable", "There is no such picture.")
        if wanted.encoded:
            return PictureRead(blob=pictures.blob(wanted.index))
        return PictureRead(pictures[wanted.index])


def _sources(wanted: FindSources) -> SourcesFound:
    from workbench.recording.maniskill.read import trajectories
    from workbench.recording.reader.read_episode import sources_in

    if wanted.trajectories:
        return SourcesFound([Source(wanted.path, name) for name in trajectories(wanted.path)])
    return SourcesFound(list(sources_in(wanted.path)))


def _rerun_info(wanted: ReadRerunInfo) -> RerunInfo:
    from workbench.recording.rerun.append_blueprint import blueprint_stream
    from workbench.recording.rerun.private_api import store_id

    found = []
    for ask in (store_id, blueprint_stream):
        try:
            found.append(ask(wanted.path))
        except (ValueError, OSError, RuntimeError, AssertionError):
            found.append(None)  # rerun then uses its own layout, at the first step
    return RerunInfo(found[0], found[1])


def _failed(why: Literal["unreadable", "system", "gone"], message: str) -> ReadFailed:
    return ReadFailed(why, clean_text(message, LONGEST_MESSAGE))


if __name__ == "__main__":
    main()
