"""Opens recordings in the background and plays them along one time axis."""

from __future__ import annotations

import asyncio
import logging
import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from workbench.envs.scene.shapes import SharedShapes
from workbench.episodes.episode import Episode, EpisodeInfo
from workbench.episodes.reader.reading import read_recording
from workbench.episodes.recorded_source import changed_on_disk
from workbench.episodes.row import LibraryRow, UnreadableRecording
from workbench.library.folder import Library
from workbench.live.effects import Asked
from workbench.live.process.background_jobs import Job, JobFailed, Jobs
from workbench.live.process.memory_limit import format_size, total_memory
from workbench.machine.loop import BlockingPool, ChangeCounter, do, on_loop, post
from workbench.machine.processes.family import allocated_memory
from workbench.machine.processes.watched_thread import report_failure
from workbench.page.command import Command
from workbench.review.recorded_scene import SceneError, SceneProcess
from workbench.review.state import (
    BeginReading,
    CheckFiles,
    FilesChecked,
    FileStamp,
    First,
    Listed,
    Open,
    OpenFirst,
    ProblemFound,
    ReadingEnded,
    RecordingNotRead,
    RecordingRead,
    ReviewEvent,
    ReviewState,
    SceneUpdate,
    advanced,
    apply,
    next_position_in,
)
from workbench.review.view import Opened, ReviewView, find_events

log = logging.getLogger(__name__)

MEMORY_SHARE = 0.25
"""Share of the machine's memory for open recordings: without a limit the OOM killer may end the server."""
SPEEDS = (0.1, 0.25, 0.5, 1.0, 2.0, 4.0)
CHECK_SECONDS = 2.0
"""Interval of checks whether files changed since they were read."""


class _Stopped(Exception):
    """The scenes are no longer needed."""


class Review:
    """Open recordings that share one position. All methods are thread-safe; all but `wait` return at once.

    Recordings are in memory (pictures encoded), so seeking only changes a number. While playing, the position is computed
    from the clock on request; there is no timer. A new opening, or `close`, cancels an opening that is still
    in progress.
    """

    def __init__(
        self,
        library: Library,
        read: Callable[[LibraryRow, SharedShapes, Callable[[], bool]], Episode] | None = None,
        make_scene: SceneProcess | None = None,
        clock: Callable[[], float] = time.monotonic,
        most_bytes: int | None = None,
        memory: Callable[[], int] = lambda: allocated_memory(os.getpid()),
    ) -> None:
        """
        Args:
            library: finds recordings by their ids.
            read: reads the recording of a row, sharing shapes with other recordings; stops when its last
                argument returns True; raises OSError or UnreadableRecording with a sentence. None for
                `read_recording`.
            make_scene: makes the scenes of recordings that contain none; with None, these recordings stay
                without a scene.
            clock: returns seconds.
            most_bytes: memory limit for the recordings of one opening; None for `MEMORY_SHARE`.
            memory: returns the bytes that the process has allocated.
        """
        self._most_bytes = int(MEMORY_SHARE * total_memory()) if most_bytes is None else most_bytes
        self._library, self._make_scene, self._clock = library, make_scene, clock
        self._read = read or (
            lambda row, shapes, stopped: read_recording(row.source, shapes, library.folder, stopped)
        )
        self._memory = memory
        self._changes = ChangeCounter()
        self._state = ReviewState()
        self._reading = Jobs(lambda: None, self._failed)
        self._checks = Jobs(lambda: None, lambda failure: self._happened(ProblemFound(f"{failure}.")))
        self._file_checks = BlockingPool("review-files")

    @on_loop
    def view(self) -> ReviewView:
        """A snapshot; cheap enough for every frame."""
        self._set(advanced(self._state, self._clock()))
        return self._state.view

    def wait(self, seen: int, timeout: float) -> int:
        """Block until the number of changes differs from `seen`, at most `timeout` seconds; returns the
        number."""
        deadline = time.monotonic() + timeout
        while True:
            changes, next_position = do(self._now)
            left = deadline - time.monotonic()
            if changes != seen or left <= 0:
                return changes
            self._changes.wait(changes, min(left, next_position))

    def _now(self) -> tuple[int, float]:
        self.view()
        return self._changes.count, next_position_in(self._state, self._clock())

    @on_loop
    def do(self, command: Command, page: str = "") -> None:
        """Carry out a command of a page. Raises `Refused`."""
        self._wanted(Asked(command, page))

    @on_loop
    def open(self, ids: Sequence[str], state: int | None = None, library_stays: bool = False) -> None:
        """Open these recordings in place of the open ones, the oldest first.

        Args:
            ids: rows of the library; those beyond `MAX_OPEN` are left out, with a message.
            state: initial state of the first recording.
            library_stays: see `ReviewView.library_stays`.
        """
        self._wanted(Open(tuple(ids), state, library_stays))

    def open_first(self, what: First) -> None:
        """Open this recording automatically as soon as the library lists it, unless another one is opened first."""
        post(lambda: self._wanted(OpenFirst(what)))

    def library_changed(self) -> None:
        """Handle a change of the library's view."""
        post(self._list)

    def add_problem(self, sentence: str) -> None:
        """Show this sentence among the problems until something is opened."""
        post(lambda: self._happened(ProblemFound(sentence)))

    @on_loop
    def close(self) -> None:
        """Stop opening recordings and checking files."""
        self._reading.close()
        self._checks.close()
        self._file_checks.end()

    # --- on the loop ---------------------------------------------------------------------------------

    def _happened(self, event: ReviewEvent) -> None:
        state, effects = apply(self._state, event, self._clock())
        self._set(state)
        for effect in effects:
            match effect:
                case BeginReading(opening=opening, rows=rows):
                    self._reading.start("opening", partial(self._open, opening, rows))
                case CheckFiles():
                    self._checks.start("checking files", self._check)

    def _set(self, state: ReviewState) -> None:
        before, self._state = self._state, state
        if state.view is not before.view:
            self._changes.notify()

    def _wanted(self, event: Asked | Open | OpenFirst) -> None:
        self._list()  # the page may show a row, and ask for it, before the loop has handled `Listed`
        self._happened(event)

    def _list(self) -> None:
        if (listed := self._library.view()) is not self._state.library:
            self._happened(Listed(listed))

    def _failed(self, failure: JobFailed) -> None:
        self._happened(ReadingEnded(self._state.opening.number, f"{failure}."))

    async def _check(self, job: Job) -> None:
        while True:
            chosen = self._state.view.chosen
            info = None if chosen is None else chosen.episode.info
            self._happened(await self._file_checks.run(partial(_check_files, self._state.files, info)))
            await asyncio.sleep(CHECK_SECONDS)

    async def _open(self, number: int, rows: tuple[LibraryRow, ...], job: Job) -> None:
        # A separate pool for each opening: a disk that hangs must not block the next opening.
        aside = BlockingPool("review-open")
        try:
            shapes = SharedShapes()
            opened = await self._read_rows(aside, number, rows, job, shapes)
            without = [one for one in opened if not one.has_scene]
            await aside.run(lambda: self._give_scenes(number, job, without, shapes))
        finally:
            aside.end()

    async def _read_rows(
        self, aside: BlockingPool, number: int, rows: tuple[LibraryRow, ...], job: Job, shapes: SharedShapes
    ) -> list[Opened]:
        opened: list[Opened] = []
        problem, held = "", self._memory()
        for done, row in enumerate(rows):
            if opened and self._memory() - held > self._most_bytes:
                left = len(rows) - done
                problem = (
                    f"{row.name} {f'and {left - 1} more were' if left > 1 else 'was'} not opened: "
                    f"the recordings opened before take {format_size(self._most_bytes)} of memory. Open fewer at "
                    "once."
                )
                break
            try:
                one, files = await aside.run(partial(self._read_row, row, shapes, job))
            except (OSError, UnreadableRecording) as error:
                self._happened(RecordingNotRead(number, row.id, f"{row.name} was not opened. {error}"))
            except Exception as error:
                # The file may contain anything. Without this the page would stay on "opening" without a reason.
                log.exception("%s could not be opened.", row.name)
                why = f"{row.name} could not be opened ({type(error).__name__}: {error})."
                self._happened(RecordingNotRead(number, row.id, why))
            else:
                opened.append(one)
                self._happened(RecordingRead(number, one, files))
        self._happened(ReadingEnded(number, problem))
        return opened

    # --- off the loop --------------------------------------------------------------------------------

    def _read_row(
        self, row: LibraryRow, shapes: SharedShapes, job: Job
    ) -> tuple[Opened, dict[Path, FileStamp]]:
        """Read the recording of a row."""
        files = {path: FileStamp(row.name, _size_and_time(path)) for path in row.paths}
        episode = _shared(self._read(row, shapes, lambda: job.stopped), shapes)
        return Opened(row.id, row.name, episode, find_events(episode)), files

    def _give_scenes(self, number: int, job: Job, without: Sequence[Opened], shapes: SharedShapes) -> None:
        """Make the scenes of recordings that contain none."""

        def send_update(
            one: Opened, scene: str, making: bool = False, episode: Episode | None = None
        ) -> None:
            event = SceneUpdate(number, one.id, scene, making, episode)
            post(lambda: self._happened(event))

        def check() -> None:
            if job.stopped or {one.id for one in without} <= self._state.opening.closed:
                raise _Stopped

        make = self._make_scene
        wanted = [] if make is None else [one for one in without if one.episode.env_states]
        for one in without:
            if one in wanted:
                send_update(one, "its scene is made next", making=True)
            else:
                send_update(one, "This recording contains no scene to draw.")
        if make is None or not wanted:
            return
        scenes = make(
            [one.episode for one in wanted],
            check,
            lambda index, text: send_update(wanted[index], text, making=True),
        )
        try:
            for one, made in zip(wanted, scenes, strict=True):
                if isinstance(made, SceneError):
                    send_update(one, str(made))
                    continue
                missed = f"Not restored: {'; '.join(made[1])}." if made[1] else ""
                send_update(one, missed, episode=_shared(made[0], shapes))
        except _Stopped:
            return
        except Exception as error:
            # The process may send anything. Without this the page would stay on "making" without a reason.
            report_failure("Scenes of recordings could not be made", error)
            for one in wanted:
                send_update(one, f"Its scene could not be made ({type(error).__name__}: {error}).")


def _shared(episode: Episode, shapes: SharedShapes) -> Episode:
    """The recording, sharing equal shapes with other recordings."""
    return episode if episode.geometry is None else replace(episode, geometry=shapes.share(episode.geometry))


def _check_files(files: Mapping[Path, FileStamp], info: EpisodeInfo | None) -> FilesChecked:
    symbols = "" if info is None else changed_on_disk(info)
    return FilesChecked(files, tuple(_changed_files(files)), info, symbols)


def _changed_files(files: Mapping[Path, FileStamp]) -> list[str]:
    """A sentence for each file that was deleted or changed since it was read."""
    found = []
    for path, stamp in files.items():
        now = _size_and_time(path)
        if now is None and stamp.size_and_time is not None:
            found.append(
                f"{path.name} was deleted after it was opened; the page still shows the content that was read."
            )
        elif now != stamp.size_and_time:
            found.append(
                f"{path.name} has changed since it was opened; open {stamp.recording} again to see its new "
                "content."
            )
    return found


def _size_and_time(path: Path) -> tuple[int, int] | None:
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_size, found.st_mtime_ns
