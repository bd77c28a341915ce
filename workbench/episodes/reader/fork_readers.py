"""The fork server of the readers, and the readers' request loop."""

from __future__ import annotations

import gc
import os
import signal
import socket
import sys
from collections import OrderedDict
from typing import Literal, get_args

import msgspec

from workbench.episodes.episode import CameraTrack, EpisodeInfo
from workbench.episodes.reader.episode_wire import SentShapes, pack_episode
from workbench.episodes.reader.read_rows import read_found
from workbench.episodes.reader.requests import (
    Answer,
    CloseEpisodes,
    EpisodeRead,
    GetExitCode,
    NewReader,
    OpenEpisode,
    PictureRead,
    ReadFailed,
    ReadPicture,
    ReadRows,
    ReadStoreId,
    ReadSweep,
    Recover,
    Recovered,
    Request,
    RowsRead,
    StoreId,
    SweepRead,
)
from workbench.episodes.reader.scan import RecordingFiles
from workbench.episodes.row import UnreadableRecording, clean_text
from workbench.machine.processes.confinement import confine
from workbench.machine.processes.family import end_with_parent
from workbench.machine.processes.wire import MessageSocket, Unpacker, pack, pack_message

MAX_MEMORY_BYTES = 3 << 30
"""Memory limit of a reader; the numbers of an episode take at most a third of it."""
MAX_REQUEST_BYTES = 1 << 20
MAX_RECOVERY_MEMORY_BYTES = 4 << 30
"""Memory limit of a reader that recovers recordings."""
MAX_SHARED_GROUPS = 4
"""Maximum number of groups of episodes (`OpenEpisode.sharing`) whose shapes are cached."""
MAX_MESSAGE_CHARACTERS = 600


def main() -> None:
    """Run the fork server: ``python -m workbench.episodes.reader.fork_readers SOCKET``.

    Forking takes milliseconds, while starting Python takes half a second. The fork server imports what
    readers need and reads no recording itself. It has only one thread, because a fork copies only one;
    environment variables turn numpy's threads off. When its socket closes, the fork server and its readers
    end.
    """
    control = socket.socket(fileno=int(sys.argv[1]))
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    gc.freeze()
    while True:
        message, fds, _, _ = socket.recv_fds(control, MAX_REQUEST_BYTES, 1)
        if not message:
            return
        request = Unpacker().unpack(message, NewReader | GetExitCode)
        if isinstance(request, GetExitCode):
            _, status = os.waitpid(request.pid, 0)
            control.send(pack(os.waitstatus_to_exitcode(status)))
            continue
        fork_server = os.getpid()
        pid = os.fork()
        if pid == 0:
            control.close()
            _run_reader(socket.socket(fileno=fds[0]), request, fork_server)
        os.close(fds[0])
        try:
            os.setpgid(pid, pid)  # set here too: the group may be killed before the reader has created it
        except OSError:
            pass  # the reader has created it, or has ended
        control.send(pack(pid))


def _run_reader(end: socket.socket, request: NewReader, fork_server: int) -> None:
    try:
        end_with_parent(fork_server)
        os.setpgid(0, 0)
        if request.writes is None:
            confine(request.paths, MAX_MEMORY_BYTES)
        else:
            confine(request.paths, MAX_RECOVERY_MEMORY_BYTES, [request.writes])
        serve(MessageSocket(end, get_args(Request)))
    finally:
        os._exit(0)


# --- a reader --------------------------------------------------------------------------------------


def serve(line: MessageSocket) -> None:
    """Answer requests until the socket closes."""
    reader = _Reader()
    while True:
        try:
            request = line.receive(None)
            if isinstance(request, CloseEpisodes):
                reader.close_episodes(request.opened)
                continue
            line.send_bytes(reader.answer(request))
        except (EOFError, OSError):
            return


class _Reader:
    def __init__(self) -> None:
        self._opened: dict[int, list[CameraTrack]] = {}
        self._number = 0
        self._shapes: OrderedDict[int, SentShapes] = OrderedDict()

    def close_episodes(self, opened: list[int]) -> None:
        for number in opened:
            self._opened.pop(number, None)

    def answer(self, request: Request) -> bytes:
        """The packed answer. Packing is inside the `try`, because it may run out of memory too."""
        try:
            return pack_message(self._answer(request))
        except UnreadableRecording as error:
            failed = _failed("unreadable", str(error))
        except MemoryError:
            failed = _failed("unreadable", "Reading it needs more memory than the limit for recordings.")
        except OSError as error:
            failed = _failed("system", str(error))
        except Exception as error:
            # Untrusted files can raise anything, and the reader must serve the next request.
            failed = _failed("unreadable", f"It cannot be read ({type(error).__name__}: {error}).")
        except BaseException as error:
            if type(error).__name__ != "PanicException":  # raised by rerun's Rust code
                raise
            failed = _failed("unreadable", f"It cannot be read (rerun's reader panicked: {error}).")
        return pack_message(failed)

    def _answer(self, request: Request) -> Answer:
        if isinstance(request, ReadRows):
            found = RecordingFiles(os.fsdecode(request.key), request.sizes, request.times)
            return RowsRead(read_found(request.folder, found, request.only_names))
        if isinstance(request, OpenEpisode):
            return self._open(request)
        if isinstance(request, ReadPicture):
            return self._picture(request)
        if isinstance(request, ReadStoreId):
            from workbench.episodes.rerun.read import store_id

            return StoreId(store_id(request.path))
        if isinstance(request, ReadSweep):
            return _sweep(request)
        assert isinstance(request, Recover)
        from workbench.episodes.writing.finish_or_recover import recover

        return Recovered([files.rrd.name for files in recover(request.folder)])

    def _open(self, request: OpenEpisode) -> EpisodeRead:
        from workbench.episodes.lerobot.read import read_lerobot
        from workbench.episodes.reader.read_episode import read_maniskill, read_without_task

        shapes = self._shapes.setdefault(request.sharing, SentShapes())
        self._shapes.move_to_end(request.sharing)
        while len(self._shapes) > MAX_SHARED_GROUPS:
            self._shapes.popitem(last=False)
        source_path = None
        if request.kind == "lerobot":
            episode = read_lerobot(request.path, int(request.part))
        elif request.kind == "maniskill":
            episode = read_maniskill(request.path, request.part)
        else:
            episode, source_path = read_without_task(request.path, shapes.shapes)
        try:
            msgspec.convert(msgspec.to_builtins(episode.info), EpisodeInfo)
        except msgspec.ValidationError as error:
            raise UnreadableRecording(
                f"{request.path.name} is a recording, but a broken one: {error}."
            ) from error
        self._number += 1
        self._opened[self._number] = episode.cameras
        return pack_episode(episode, source_path, self._number, shapes)

    def _picture(self, request: ReadPicture) -> PictureRead | ReadFailed:
        cameras = self._opened.get(request.opened, [])
        if not 0 <= request.camera < len(cameras):
            return _failed("gone", "That recording is not open.")
        pictures = cameras[request.camera].pictures.get(request.modality)
        if pictures is None or not 0 <= request.index < len(pictures):
            return _failed("unreadable", "There is no such picture.")
        if request.encoded:
            return PictureRead(blob=pictures.blob(request.index))
        return PictureRead(pictures[request.index])


def _sweep(request: ReadSweep) -> SweepRead:
    from workbench.episodes.sweep_results import NoSweep, read_results

    try:
        return SweepRead(read_results(request.path))
    except NoSweep as error:
        raise UnreadableRecording(f"{request.path.name} {error}.") from error


def _failed(why: Literal["unreadable", "system", "gone"], message: str) -> ReadFailed:
    return ReadFailed(why, clean_text(message, MAX_MESSAGE_CHARACTERS))


if __name__ == "__main__":
    main()
