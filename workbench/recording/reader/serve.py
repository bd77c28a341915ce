"""The loop of a reader: it reads files of strangers and answers with data, in a process that may do little else."""

from __future__ import annotations

import os
import socket
from collections import OrderedDict

from workbench.recording.encoded_pictures import MODALITIES, EncodedPictures
from workbench.recording.episode import CameraTrack, Episode
from workbench.recording.library_read import read_found
from workbench.recording.library_row import text
from workbench.recording.library_scan import found_of
from workbench.recording.reader.episode_wire import SentShapes, packed
from workbench.recording.reader.requests import (
    REQUESTS,
    Answer,
    Failed,
    Forget,
    ForRerun,
    Open,
    PictureAt,
    PictureRead,
    Request,
    Rows,
    RowsRead,
    Sources,
    SourcesFound,
    ToldRerun,
)
from workbench.recording.reader.wire import ArrayPacker, Closed, bytes_of, path_of, receive, send
from workbench.recording.sources import UnreadableRecording

MOST_SHARED = 4
"""Groups of episodes whose shapes are remembered."""
LONGEST_WORDS = 600


def warm_up() -> None:
    """Import what reads an episode."""
    import workbench.recording.blueprint_in_file
    import workbench.recording.lerobot_read
    import workbench.recording.read_episode  # noqa: F401


def serve(connection: socket.socket) -> None:
    """Answer one request after the other, until nobody asks any more."""
    reader = _Reader()
    while True:
        try:
            wanted, _ = receive(connection, REQUESTS)
            if isinstance(wanted, Forget):
                reader.forget(wanted.opened)
                continue
            send(connection, *reader.answer(wanted))
        except Closed:
            return


class _Reader:
    def __init__(self) -> None:
        self._opened: dict[int, list[CameraTrack]] = {}
        self._number = 0
        self._shapes: OrderedDict[int, SentShapes] = OrderedDict()

    def forget(self, opened: list[int]) -> None:
        for number in opened:
            self._opened.pop(number, None)

    def answer(self, wanted: Request) -> tuple[Answer, ArrayPacker | None]:
        try:
            return self._answer(wanted)
        except UnreadableRecording as error:
            return _failed("unreadable", str(error)), None
        except MemoryError:
            return _failed("unreadable", "To read it takes more memory than a recording may take."), None
        except OSError as error:
            return _failed("system", str(error)), None
        except Exception as error:
            # Files of strangers: what they can be wrong in has no end, and the next one is to be read too.
            return _failed("unreadable", f"It cannot be read ({type(error).__name__}: {error})."), None
        except BaseException as error:
            if type(error).__name__ != "PanicException":  # of rerun's reader, which is Rust
                raise
            return _failed("unreadable", f"It cannot be read (rerun's reader gave up: {error})."), None

    def _answer(self, wanted: Request) -> tuple[Answer, ArrayPacker | None]:
        if isinstance(wanted, Rows):
            found = found_of(os.fsdecode(wanted.key), wanted.signature)
            entries = read_found(path_of(wanted.folder), found)
            return RowsRead([facts for facts, _ in entries], [thumbnail for _, thumbnail in entries]), None
        if isinstance(wanted, Open):
            return self._open(wanted)
        if isinstance(wanted, PictureAt):
            return self._picture(wanted)
        if isinstance(wanted, Sources):
            return _sources(wanted), None
        assert isinstance(wanted, ForRerun)
        return _told_rerun(wanted), None

    def _open(self, wanted: Open) -> tuple[Answer, ArrayPacker | None]:
        from workbench.recording.lerobot_read import read_lerobot
        from workbench.recording.read_episode import read_inert, read_maniskill

        shapes = self._shapes.setdefault(wanted.sharing, SentShapes())
        self._shapes.move_to_end(wanted.sharing)
        while len(self._shapes) > MOST_SHARED:
            self._shapes.popitem(last=False)
        path, source_path = path_of(wanted.path), None
        episode: Episode
        if wanted.kind == "lerobot":
            episode = read_lerobot(path, int(wanted.part))
        elif wanted.kind == "maniskill":
            episode = read_maniskill(path, wanted.part)
        else:
            episode, source_path = read_inert(path, shapes.shapes)
        self._number += 1
        answer = packed(episode, source_path, self._number, shapes)
        self._opened[self._number] = episode.cameras
        return answer

    def _picture(self, wanted: PictureAt) -> tuple[Answer, ArrayPacker | None]:
        cameras = self._opened.get(wanted.opened, [])
        if not 0 <= wanted.camera < len(cameras) or wanted.modality not in MODALITIES:
            return _failed("gone", "That recording is not open."), None
        pictures: EncodedPictures | None = getattr(cameras[wanted.camera], wanted.modality)
        if pictures is None or not 0 <= wanted.index < len(pictures):
            return _failed("unreadable", "There is no such picture."), None
        if wanted.encoded:
            return PictureRead(None, pictures.blob(wanted.index)), None
        arrays = ArrayPacker()
        return PictureRead(arrays.ref(pictures[wanted.index]), None), arrays


def _sources(wanted: Sources) -> SourcesFound:
    from workbench.recording.read_maniskill import trajectories
    from workbench.recording.source_files import sources_in
    from workbench.recording.sources import Source

    path = path_of(wanted.path)
    if wanted.trajectories:
        found = (Source(path, name) for name in trajectories(path))
    else:
        found = sources_in(path)
    return SourcesFound(
        [(bytes_of(one.path), one.part, text(one.id, 8192), text(one.name, 400)) for one in found]
    )


def _told_rerun(wanted: ForRerun) -> ToldRerun:
    from workbench.recording.blueprint_in_file import blueprint_stream
    from workbench.recording.rerun_seam import store_id

    path, found = path_of(wanted.path), []
    for ask in (store_id, blueprint_stream):
        try:
            found.append(ask(path))
        except (ValueError, OSError, RuntimeError, AssertionError):
            found.append(None)  # rerun then shows it in an arrangement of its own, from its first moment on
    return ToldRerun(found[0], found[1])


def _failed(why: str, words: str) -> Failed:
    return Failed(why, text(words, LONGEST_WORDS))  # type: ignore[arg-type]
