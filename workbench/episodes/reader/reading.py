"""Reads and recovers recordings in confined processes."""

from __future__ import annotations

import os
import threading
import weakref
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

from workbench.envs.scene.shapes import SharedShapes
from workbench.episodes import thumbnail
from workbench.episodes.document import task_file
from workbench.episodes.encoded_pictures import Modality
from workbench.episodes.episode import Episode
from workbench.episodes.reader.episode_wire import InvalidEpisode, KnownShapes, unpack_episode
from workbench.episodes.reader.reader_process import Answered, Reader, ReaderEnded, WrongProcess, fork_server
from workbench.episodes.reader.requests import (
    EpisodeRead,
    OpenEpisode,
    PictureRead,
    ReadFailed,
    ReadPicture,
    ReadRows,
    ReadStoreId,
    ReadSweep,
    Recover,
    Recovered,
    RowsRead,
    StoreId,
    SweepRead,
)
from workbench.episodes.reader.scan import NOTES, SUFFIXES, RecordingFiles, broken, files_named, scan_folder
from workbench.episodes.row import Facts, LibraryEntry, Source, UnreadableRecording, clean_facts
from workbench.episodes.sweep_results import NoSweep, SweepResults, clean_results
from workbench.episodes.writing.publish import RecordingError

ROW_SECONDS = 30.0
OPEN_SECONDS = 60.0
PICTURE_SECONDS = 70.0
"""Timeout of a picture. It is long, because reading the first frame of a film decodes all frames of the
episode."""
RECOVERY_SECONDS = 1800.0
"""Timeout of a recovery: a recording of an hour with four cameras takes some minutes."""
PICTURE_WAIT_SECONDS = 0.2
"""Timeout of a picture request that waits while another recording is being opened."""
MAX_READERS = 4
_BATCH_ROWS = 8
"""Number of requests that are sent at once: the reader works on the next one while an answer is unpacked."""
T = TypeVar("T")

_lock = threading.Lock()
_readers: OrderedDict[tuple[Path, bool], Reader] = OrderedDict()
_shapes = KnownShapes()


def start_reading() -> None:
    """Start the fork server in advance, without waiting. Raises OSError."""
    fork_server.start()


def stop_reading() -> None:
    """End all reader processes; they restart on use."""
    with _lock:
        readers = list(_readers.values())
        _readers.clear()
    for reader in readers:
        reader.close()
    fork_server.end()


def read_rows(
    folder: Path, found_files: Iterable[RecordingFiles], only_names: bool = False
) -> Iterator[tuple[RecordingFiles, list[LibraryEntry]]]:
    """The recordings in these files of a library's folder, each with its thumbnail. A broken file gives a row
    that states the problem.

    Args:
        only_names: as in `read_rows.read_found`.

    Raises:
        OSError: no reader can be started.
    """
    found_files = list(found_files)
    reader = _reader(folder, episodes=False)
    reader.allow(_link_targets(path for found in found_files for path in found.paths(folder)))
    for begin in range(0, len(found_files), _BATCH_ROWS):
        some = found_files[begin : begin + _BATCH_ROWS]
        requests = [
            ReadRows(Path(folder), os.fsencode(found.key), found.sizes, found.times, only_names)
            for found in some
        ]
        answers = reader.ask_all(requests, ROW_SECONDS)
        for found, answer in zip(some, answers, strict=True):
            yield found, _entries(found, answer)


def read_recording(
    source: Source,
    shapes: SharedShapes | None = None,
    folder: Path | None = None,
    stopped: Callable[[], bool] = lambda: False,
) -> Episode:
    """Read an episode; its pictures are read on access.

    Recordings are untrusted, and HDF5, Arrow, rerun, ffmpeg and Pillow parse them in millions of lines of C, C++ and Rust.
    So the server never opens them; a confined process with limits on memory and time reads them. If that
    process ends or hangs, only this recording fails.

    Args:
        shapes: shapes to share with other recordings.
        folder: folder that the process may read; by default the file's folder.
        stopped: polled a few times a second; once it returns True, reading is cancelled.

    Raises:
        UnreadableRecording: it cannot be read; the message gives the reason.
        OSError: the system refuses access to its files.
    """
    if source.problem is not None:
        raise UnreadableRecording(source.problem)
    path, kind = source.path.absolute(), source.kind
    folder = folder or (path if kind == "lerobot" else path.parent)
    files = (path,) if kind == "lerobot" else tuple(path.with_suffix(s) for s in (".json", ".h5", ".rrd"))
    reader = _reader(folder, episodes=True)
    reader.allow(_link_targets(files))
    shapes = SharedShapes() if shapes is None else shapes
    sharing, known = _shapes.of(shapes)
    request = OpenEpisode(kind, path, source.part or "", sharing)
    read, process = _request(reader, request, EpisodeRead, path.name, stopped)
    opened = _OpenEpisode(reader, request, process, read.opened, path.name)
    try:
        episode = unpack_episode(read, opened.picture, process, shapes, known)
    except InvalidEpisode as error:
        raise UnreadableRecording(f"{path.name} is a recording, but a broken one: {error}.") from error
    if kind == "workbench":
        found = task_file(read.source_path, episode.info.task, path.parent)
        if found is not None:
            episode.info = replace(episode.info, source_file=found)
    return episode


def read_store_id(path: Path) -> str:
    """Rerun's id of the recording in an ``.rrd``. Raises as `read_recording` does."""
    path = Path(path).absolute()
    reader = _reader(path.parent, episodes=True)
    reader.allow(_link_targets([path]))
    store, _ = _request(reader, ReadStoreId(path), StoreId, path.name)
    return store.id


def read_sweep(path: Path) -> SweepResults:
    """The results of a sweep in a ``results.parquet``. A link that leads out of its folder is not followed. Raises as
    `read_recording` does."""
    path = Path(path).absolute()
    read, _ = _request(_reader(path.parent, episodes=True), ReadSweep(path), SweepRead, path.name)
    try:
        return clean_results(read.results)
    except NoSweep as error:
        raise UnreadableRecording(f"{path.name} {error}.") from error


def recover_confined(folder: Path) -> tuple[Path, ...]:
    """Recover recordings from the journals that dead writers left in `folder`; returns the path of each
    recovered .rrd.

    A foreign folder may contain journals, so a confined process reads them. It may write only below `folder`,
    has limits on memory and time, and starts only if there are journals.

    Raises:
        RecordingError: files cannot be written, the folder cannot be read, or the process failed; the journals stay.
    """
    from workbench.episodes.writing.journal import FOLDER  # imports Arrow, for which a server should not wait

    failed = f"Cannot recover the recordings in {folder}: "
    try:
        if not any(os.scandir(folder / FOLDER)):
            return ()
    except FileNotFoundError:
        return ()
    except OSError as error:
        raise RecordingError(f"{failed}{error.strerror}") from error
    reader = Reader(folder.absolute(), writes=folder.absolute())
    try:
        answer = reader.ask(Recover(folder.absolute()), RECOVERY_SECONDS).answer
    except OSError as error:
        raise RecordingError(f"{failed}{error}") from error
    finally:
        reader.close()
    if isinstance(answer, Recovered):
        # Uses only the names: the process that returned the paths has read untrusted files.
        return tuple(folder / Path(name).name for name in answer.made)
    why = (
        answer
        if isinstance(answer, ReadFailed)
        else ReadFailed("unreadable", f"it returned {type(answer).__name__}.")
    )
    raise RecordingError(why.message if why.why == "system" else f"{failed}{why.message}")


def recovered_text(paths: Sequence[str]) -> str:
    """A message on recovered episodes; empty if there are none."""
    if not paths:
        return ""
    one = len(paths) == 1
    named = ", ".join(paths[:3]) + (f" and {len(paths) - 3} more" if len(paths) > 3 else "")
    return (
        f"{len(paths)} episode{'' if one else 's'} that an earlier session left unfinished "
        f"{'was' if one else 'were'} recovered: {named}"
    )


def _reader(folder: Path, episodes: bool) -> Reader:
    key = (Path(folder).absolute(), episodes)
    gone = None
    with _lock:
        if key not in _readers:
            _readers[key] = Reader(key[0])
        _readers.move_to_end(key)
        if len(_readers) > MAX_READERS:
            _, gone = _readers.popitem(last=False)
        reader = _readers[key]
    if gone is not None:
        gone.close()  # restarts when a picture of its episodes is read
    return reader


def _link_targets(paths: Iterable[Path]) -> list[Path]:
    """Targets of the paths that are links; they may be outside the folder."""
    return [Path(os.path.realpath(path)) for path in paths if os.path.islink(path)]


def _entries(found: RecordingFiles, answered: Answered | ReaderEnded) -> list[LibraryEntry]:
    answer = answered.answer if isinstance(answered, Answered) else answered
    if isinstance(answer, RowsRead):
        return [(clean_facts(facts), thumbnail.checked(jpeg)) for facts, jpeg in answer.entries]
    why = "returned an invalid row"
    if isinstance(answer, ReadFailed):
        why = answer.message
    elif isinstance(answer, ReaderEnded):
        why = f"{answer}; it is read again when it is opened or changes"
    # Any of the files may be the cause.
    suffixes = ", ".join(suffix for suffix in found.sizes if suffix != NOTES)
    return [broken(found, f"{Path(found.key).name} ({suffixes}) {why}.")]


def _request(
    reader: Reader,
    request: OpenEpisode | ReadStoreId | ReadSweep,
    kind: type[T],
    name: str,
    stopped: Callable[[], bool] = lambda: False,
) -> tuple[T, int]:
    """The answer, and the number of the process that answered."""
    try:
        answered = reader.ask(request, OPEN_SECONDS, stopped=stopped)
    except ReaderEnded as error:
        raise UnreadableRecording(f"{name} {error}.") from error
    answer = answered.answer
    if isinstance(answer, ReadFailed):
        if answer.why == "system":
            raise OSError(answer.message)
        raise UnreadableRecording(
            answer.message if Path(name).stem in answer.message else f"{name}: {answer.message}"
        )
    if not isinstance(answer, kind):
        raise UnreadableRecording(f"{name} cannot be read: the reader returned {type(answer).__name__}.")
    return answer, answered.process


class _OpenEpisode:
    """An episode that is open in a reader while its pictures may be read."""

    def __init__(self, reader: Reader, request: OpenEpisode, process: int, opened: int, name: str) -> None:
        self._reader, self._request, self._name = reader, request, name
        self._lock = threading.Lock()
        self._failed: OSError | None = None
        self._set_opened(process, opened)

    def picture(self, camera: int, modality: Modality, index: int, encoded: bool) -> PictureRead:
        """Read a picture. Raises OSError; ReaderBusy while another recording is being opened."""
        with self._lock:
            if self._failed is not None:
                raise self._failed
            try:
                answer = self._ask(camera, modality, index, encoded).answer
            except ReaderEnded as error:
                # No retry: the picture would end each new reader too, thirty times a second.
                self._failed = OSError(f"{self._name} {error}")
                raise self._failed from error
        if isinstance(answer, PictureRead):
            return answer
        raise OSError(answer.message if isinstance(answer, ReadFailed) else "the reader returned no picture")

    def _ask(self, camera: int, modality: Modality, index: int, encoded: bool) -> Answered:
        for _ in range(2):
            request = ReadPicture(self._number, camera, modality, index, encoded)
            try:
                return self._reader.ask(request, PICTURE_SECONDS, PICTURE_WAIT_SECONDS, self._process)
            except WrongProcess:
                # Another request has ended the process.
                read, process = _request(self._reader, self._request, EpisodeRead, self._name)
                self._set_opened(process, read.opened)
        raise ReaderEnded("ended the process that reads recordings")

    def _set_opened(self, process: int, opened: int) -> None:
        self._process, self._number = process, opened
        weakref.finalize(self, self._reader.close_episode, process, opened).atexit = False


# --- recordings by path ------------------------------------------------------------------------------


def find_sources(path: Path) -> list[Source]:
    """The recordings in a file, or in a folder and the folders below it, ordered by name. As in the library,
    damaged recordings are included.

    Raises:
        UnreadableRecording: a folder cannot be listed.
        OSError: no reader can be started.
    """
    path = Path(path).absolute()
    if path.is_dir():
        folder, scan = path, scan_folder(path)
        if scan.problem is not None:
            raise UnreadableRecording(scan.problem)
        found = [files for _, files in sorted((scan.found | scan.unsettled).items())]
    else:
        folder = path.parent
        files = files_named(path) if path.suffix in SUFFIXES else None
        found = [] if files is None else [files]
    return [
        _source(folder, files, facts, number)
        for files, entries in read_rows(folder, found, only_names=True)
        for number, (facts, _) in enumerate(entries)
    ]


def _source(folder: Path, files: RecordingFiles, facts: Facts, number: int) -> Source:
    """The source of a row's recording.

    Args:
        number: index of the row among the rows of these files.
    """
    path = files.paths(folder)[0]
    part, problem = facts.trajectory, facts.problem
    if facts.kind == "lerobot":
        path, part = path.parents[1], part or "0"
    elif part is not None:
        path = path.with_suffix(".h5")
    elif facts.kind == "workbench" or ".rrd" in files.sizes:
        problem = None  # reading it reports the damage and returns the rest
    name = path.name if facts.kind == "lerobot" else path.stem
    name = name if part is None else f"{name}#{part}"
    # A damaged copy and a complete one get different ids, so that neither hides the other.
    id = facts.uid if facts.uid and facts.problem is None else f"{os.path.realpath(path)}#{part or number}"
    return Source(path, part, id, name, problem)


def find_all_sources(paths: Sequence[Path]) -> tuple[Source, ...]:
    """The recordings in these files, in these folders and in all folders below them; each recording once.

    Raises:
        FileNotFoundError: a path does not exist.
        UnreadableRecording: a file is not a recording, the folders have no recording, or a folder cannot be
            listed; the message gives the reason.
    """
    found: dict[str, Source] = {}
    for path in paths:
        path = Path(path)
        if not path.exists():
            raise FileNotFoundError(f"{path} does not exist: give recordings, or folders of them.")
        some = find_sources(path)
        if not some and not path.is_dir():
            raise _none_in([path])
        for source in some:
            found.setdefault(source.id, source)
    if not paths:
        raise UnreadableRecording("No recording given: give recordings, or folders of them.")
    if not found:
        raise _none_in(paths)
    return tuple(found.values())


def _none_in(paths: Sequence[Path]) -> UnreadableRecording:
    return UnreadableRecording(
        f"There is no recording in {', '.join(map(str, paths))}. Recordings are .rrd, .h5 and .json of the workbench, "
        ".h5 with .json of ManiSkill, and LeRobot datasets."
    )
