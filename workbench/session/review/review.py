"""Opens recordings in the background and plays them along one time axis."""

from __future__ import annotations

import asyncio
import datetime
import logging
import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

from workbench.core.scene.shapes import SharedShapes
from workbench.machine.processes.family import allocated_memory
from workbench.machine.processes.watched_thread import report_failure
from workbench.recording.episode.episode import Episode
from workbench.recording.episode.row import LibraryRow, UnreadableRecording
from workbench.recording.library.library import Library
from workbench.recording.reader.reading import read_recording
from workbench.session.loop import Aside, ChangeCounter, begin, do, later, on_loop, post
from workbench.session.process.jobs import Job, JobFailed, Jobs
from workbench.session.process.memory_limit import format_size, total_memory
from workbench.session.review.recorded_scene import SceneError, SceneProcess
from workbench.session.review.view import START, Opened, ReviewView, find_events

log = logging.getLogger(__name__)

MOST_COMPARED = 4
"""Most recordings that are drawn over each other; more cannot be told apart."""
MOST_OPEN = 64
MEMORY_SHARE = 0.25
"""Share of the machine's memory for open recordings: without a limit the system may kill the server."""
SPEEDS = (0.1, 0.25, 0.5, 1.0, 2.0, 4.0)
FIRST_SHOWN = 0.4
"""Seconds after which the recordings read so far are shown, while others are read; doubled each time, since each time
a scene is built."""
_NEVER = datetime.datetime.min.replace(tzinfo=datetime.timezone.utc)
CHECK_SECONDS = 2.0
"""Seconds between two checks whether files changed since they were read."""


@dataclass(frozen=True)
class _Stamp:
    """Name, size and time of a file when it was read."""

    recording: str
    """Name of the recording."""
    size_and_time: tuple[int, int] | None
    """Bytes and mtime in ns; None if the file did not exist."""


@dataclass
class _Playback:
    """Position and time at which playing began."""

    position: int
    at: float
    """Clock time in seconds."""


class _Stopped(Exception):
    """The scenes are no longer needed."""


class Review:
    """Up to `MOST_OPEN` opened recordings and one position. All methods may be called on any thread, and return at
    once.

    Recordings are in memory (pictures encoded), so seeking changes a number. While playing, the position follows from
    the clock when it is asked for; nothing ticks. A later opening, or `close`, makes an earlier one stop.
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
            read: reads the recording of a row, sharing shapes with others, until it is stopped; raises OSError or
                UnreadableRecording with a sentence. None for `read_recording`.
            make_scene: for recordings without a scene; None leaves them without.
            clock: seconds.
            most_bytes: of memory for the recordings of one opening; None for `MEMORY_SHARE`.
            memory: bytes that the process has allocated.
        """
        self._most_bytes = int(MEMORY_SHARE * total_memory()) if most_bytes is None else most_bytes
        self._library, self._make_scene, self._clock = library, make_scene, clock
        self._read = read or (
            lambda row, shapes, stopped: read_recording(row.source, shapes, library.folder, stopped)
        )
        self._memory = memory
        self._changes = ChangeCounter()
        self._view = ReviewView()
        self._playback: _Playback | None = None
        self._opening = Jobs(lambda: None, self._failed)
        self._partly_shown = False
        """Whether the newest opening has put something on the page."""
        self._closed: set[str] = set()
        """Ids closed by the user while the opening still runs."""
        self._files: dict[Path, _Stamp] = {}
        """Files of the open recordings."""
        self._open_problems: tuple[str, ...] = ()
        self._next_check: asyncio.TimerHandle | None = None
        self._file_checks = Aside("review-files")
        self._first: Path | Literal["newest"] | None = None
        """What to open by itself once the library lists it."""

    # --- what the page reads -------------------------------------------------------------------------

    @on_loop
    def view(self) -> ReviewView:
        """A snapshot; cheap enough for every frame."""
        self._advance()
        return self._view

    def wait(self, seen: int, timeout: float) -> int:
        """Sleep until the view is newer than `seen`, at most `timeout` seconds; returns the newest serial."""
        deadline = time.monotonic() + timeout
        while True:
            changes = self._changes.count
            serial, next_position_in = do(self._now)
            left = deadline - time.monotonic()
            if serial != seen or left <= 0:
                return serial
            self._changes.wait(changes, min(left, next_position_in))

    def _now(self) -> tuple[int, float]:
        self._advance()
        return self._view.serial, self._next_position_in()

    # --- opening -------------------------------------------------------------------------------------

    def open(self, ids: Sequence[str], state: int | None = None) -> None:
        """Show these recordings instead of the open ones, the oldest first.

        Args:
            ids: rows of the library; those beyond `MOST_OPEN` are left out, with a message.
            state: of the first recording, to begin at.
        """
        rows = {row.id: row for row in self._library.view().rows}
        wanted = [rows[id] for id in dict.fromkeys(ids) if id in rows]
        missing = len(dict.fromkeys(ids)) - len(wanted)
        problems: list[str] = []
        if missing:
            problems.append(
                "A requested recording is no longer in the folder."
                if missing == 1
                else f"{missing} requested recordings are no longer in the folder."
            )
        if len(wanted) > MOST_OPEN:
            problems.append(
                f"At most {MOST_OPEN} recordings can be open at once; the first {MOST_OPEN} were opened."
            )
            wanted = wanted[:MOST_OPEN]
        do(lambda: self._begin(wanted, problems, state))

    def open_first(self, what: Path | Literal["newest"]) -> None:
        """Open the recording of this file, or the newest, as soon as the library lists it, unless another is opened before."""
        post(lambda: self._open_first(what))

    def library_changed(self) -> None:
        """The library has another view."""
        post(lambda: self._open_first(self._first))

    def _open_first(self, first: Path | Literal["newest"] | None) -> None:
        self._first, listed = first, self._library.view()
        whole = [row for row in listed.rows if row.problem is None]
        if isinstance(first, Path):
            row = next((row for row in whole if first.name in [path.name for path in row.paths]), None)
        elif first == "newest" and listed.rows and listed.reading is None:
            self._first = None  # also if none of them can be read
            row = max(whole, key=lambda row: row.written or 0.0, default=None)
        else:
            return
        if row is not None:
            self._begin([row], [], None, by_itself=True)

    def _begin(
        self, wanted: list[LibraryRow], problems: list[str], state: int | None, by_itself: bool = False
    ) -> None:
        self._first = None
        self._opening.stop()
        self._partly_shown = False
        self._closed = set()
        if not wanted:
            self._change(problems=tuple(problems), not_opened=(), loading="", by_itself=False)
            return
        # The library lists the newest first, but a comparison asks what became of the oldest. It is also read first:
        # the recording that is shown first stays selected when others arrive.
        wanted.sort(key=lambda row: (row.date is None, row.date or _NEVER))
        self._change(
            loading=_opening_text(wanted, 0), problems=tuple(problems), not_opened=(), by_itself=by_itself
        )
        self._opening.start("opening", lambda job: self._open(job, wanted, problems, state))

    async def _open(self, job: Job, rows: list[LibraryRow], problems: list[str], state: int | None) -> None:
        # Each opening has one of its own: a disk that hangs must not keep the next.
        aside = Aside("review-open")
        try:
            await self._open_on(aside, job, rows, problems, state)
        finally:
            aside.end()

    def open_again(self) -> None:
        """Read what could not be read once more, and keep what is open: a busy machine may have been too slow."""
        view = self.view()
        self.open((*(one.id for one in view.opened), *view.not_opened))

    @on_loop
    def close_one(self, index: int) -> None:
        """Close one of the open recordings."""
        if 0 <= index < len(self._view.opened):
            kept = [o for number, o in enumerate(self._view.opened) if number != index]
            selected = self._view.selected - (self._view.selected > index)
            if self._partly_shown:
                self._closed.add(self._view.opened[index].id)
            self._set_opened(kept, min(selected, max(len(kept) - 1, 0)), self._view.align)

    @on_loop
    def swap(self, index: int, other: int) -> None:
        """Swap two open recordings in the order; the position stays."""
        view = self._view
        if not {index, other} <= set(range(len(view.opened))):
            return
        self._advance()
        order = list(range(len(view.opened)))
        order[index], order[other] = other, index
        position = self._view.position
        self._opening.stop()
        self._set_opened([view.opened[k] for k in order], order.index(view.selected), view.align)
        self._seek(position)

    def close(self) -> None:
        """Stop opening, and checking files."""
        do(self._close)

    def _close(self) -> None:
        self._opening.close()
        self._file_checks.end()
        if self._next_check is not None:
            self._next_check.cancel()

    async def _open_on(
        self, aside: Aside, job: Job, rows: list[LibraryRow], problems: list[str], state: int | None
    ) -> None:
        opened: list[Opened] = []
        failed: list[str] = []
        shapes = SharedShapes()
        files: dict[Path, _Stamp] = {}
        shown_at, wait = time.monotonic(), FIRST_SHOWN
        held = self._memory()
        for done, row in enumerate(rows):
            if opened and self._memory() - held > self._most_bytes:
                left = len(rows) - done
                problems.append(
                    f"{row.name} {f'and {left - 1} more were' if left > 1 else 'was'} not opened: those before take "
                    f"{format_size(self._most_bytes)} of memory. Open fewer at once."
                )
                break
            if opened and time.monotonic() - shown_at > wait:
                self._show(opened, files, state)
                shown_at, wait = time.monotonic(), 2 * wait
            self._change(loading=_opening_text(rows, done))
            try:
                one, stamps = await aside.run(partial(self._read_row, row, shapes, job))
            except (OSError, UnreadableRecording) as error:
                problems.append(f"{row.name} was not opened. {error}")
                failed.append(row.id)
            except Exception as error:
                # The file may hold anything. Without this the page would stay on "opening" without a reason.
                log.exception("%s could not be opened.", row.name)
                problems.append(f"{row.name} could not be opened ({type(error).__name__}: {error}).")
                failed.append(row.id)
            else:
                opened.append(one)
                files.update(stamps)
                problems += [broken.sentence for broken in one.episode.broken_files]
        opened.sort(key=lambda one: one.episode.info.written_at)
        self._open_problems = tuple(problems)
        if opened:
            self._show(opened, files, state)
        self._change(loading="", problems=self._open_problems, not_opened=tuple(failed))
        without = [one for one in opened if not one.has_scene]
        await aside.run(lambda: self._give_scenes(job, without, shapes))

    def _read_row(self, row: LibraryRow, shapes: SharedShapes, job: Job) -> tuple[Opened, dict[Path, _Stamp]]:
        """Read the recording of a row. Called off the loop."""
        stamps = _stamps_of(row)
        episode = _shared(self._read(row, shapes, lambda: job.stopped), shapes)
        return Opened(row.id, row.name, episode, find_events(episode)), stamps

    def _failed(self, failure: JobFailed) -> None:
        self._change(loading="", problems=(*self._view.problems, f"{failure}."))

    def _show(self, opened: Sequence[Opened], files: Mapping[Path, _Stamp], state: int | None) -> None:
        """Show the recordings read so far, without those closed again.

        Selection and position stay once something of this opening was shown.
        """
        self._files = dict(files)
        self._check_files_later()
        kept = [one for one in opened if one.id not in self._closed]
        chosen = self._view.chosen if self._partly_shown else None
        selected = next((index for index, one in enumerate(kept) if one is chosen), 0)
        if self._partly_shown:
            self._set_opened(kept, selected, self._view.align, stay=True)
        else:
            self._partly_shown = True
            self._set_opened(kept, 0, START)
            if state is not None:
                self._seek(state)

    def _give_scenes(self, job: Job, without: Sequence[Opened], shapes: SharedShapes) -> None:
        """Make the scenes of recordings without one. Called off the loop."""

        def update(one: Opened, **values: Any) -> None:
            post(lambda: job.stopped or self._replace_opened(one.id, **values))

        def check() -> None:
            if job.stopped or all(one.id in self._closed for one in without):
                raise _Stopped

        make = self._make_scene
        wanted = [] if make is None else [one for one in without if one.episode.env_states]
        for one in without:
            if one in wanted:
                update(one, scene="its scene is made next", making=True)
            else:
                update(one, scene="This recording holds no scene to draw.", making=False)
        if make is None or not wanted:
            return
        scenes = make(
            [one.episode for one in wanted],
            check,
            lambda index, text: update(wanted[index], scene=text, making=True),
        )
        try:
            for one, made in zip(wanted, scenes, strict=True):
                if isinstance(made, SceneError):
                    update(one, scene=str(made), making=False)
                    continue
                episode = _shared(made[0], shapes)
                message = f"Not restored: {'; '.join(made[1])}." if made[1] else ""
                update(one, episode=episode, scene=message, making=False)
        except _Stopped:
            return
        except Exception as error:
            # That process may send anything. Without this the page would stay on "making" without a reason.
            report_failure("Scenes of recordings could not be made", error)
            for one in wanted:
                text = f"Its scene could not be made ({type(error).__name__}: {error})."
                update(one, scene=text, making=False)

    def _replace_opened(self, id: str, **values: Any) -> None:
        index = next((index for index, one in enumerate(self._view.opened) if one.id == id), None)
        if index is not None:
            opened = list(self._view.opened)
            had_scene = opened[index].has_scene
            opened[index] = replace(opened[index], **values)
            got_scene = opened[index].has_scene and not had_scene
            self._change(opened=tuple(opened), opened_serial=self._view.opened_serial + got_scene)

    def _set_opened(self, opened: Sequence[Opened], selected: int, align: str, stay: bool = False) -> None:
        """Show these at the first position, or at the present one if `stay`."""
        if stay:
            self._advance()
        else:
            self._playback = None
            self._change(playing=False)
        stay = stay and bool(self._view.opened) and bool(opened)
        state = self._view.states[self._view.selected] if stay else None
        names = dict.fromkeys(h.name for o in opened for h in o.events if h.style != "reset")
        alignments = (START, *(f"first {name}" for name in names))
        self._change(
            opened=tuple(opened),
            opened_serial=self._view.opened_serial + 1,
            selected=selected,
            alignments=alignments,
        )
        self._align(align if align in alignments else START, position=state)

    @on_loop
    def add_problem(self, sentence: str) -> None:
        """Show this among the problems, until something is opened."""
        self._open_problems = (*self._open_problems, sentence)
        self._change(problems=(*self._view.problems, sentence))

    # --- the position --------------------------------------------------------------------------------

    @on_loop
    def seek(self, position: int) -> None:
        """Go to a position, or the nearest in range."""
        self._seek(position)

    @on_loop
    def seek_by(self, steps: int) -> None:
        """Go some states forward, or back if negative; pauses."""
        self._advance()
        self._pause()
        self._seek(self._view.position + steps)

    @on_loop
    def seek_event(self, direction: int) -> None:
        """Go to the next (1) or previous (-1) event of any open recording; of the selected one if many are open."""
        self._advance()
        view = self._view
        several = range(len(view.opened)) if len(view.opened) <= MOST_COMPARED else (view.selected,)
        places = {
            h.state - view.anchors[index]
            for index in several
            if view.opened
            for h in view.opened[index].events
        }
        places |= {view.last} if view.opened else set()
        ahead = [p for p in places if (p - view.position) * direction > 0]
        if ahead:
            self._pause()
            self._seek(min(ahead, key=lambda place: abs(place - view.position)))

    @on_loop
    def to_first(self) -> None:
        self._seek(self._view.first)

    @on_loop
    def to_last(self) -> None:
        self._pause()
        self._seek(self._view.last)

    @on_loop
    def show(self, index: int, state: int) -> None:
        """Select a recording and go to a state of it."""
        if 0 <= index < len(self._view.opened):
            self._pause()
            self._change(selected=index)
            self._seek(state - self._view.anchors[index])

    @on_loop
    def select(self, index: int) -> None:
        if 0 <= index < len(self._view.opened):
            self._change(selected=index)

    @on_loop
    def align(self, how: str) -> None:
        """Align at one of `ReviewView.alignments`. The shown state of the selected recording stays.

        Raises:
            ValueError: unknown alignment.
        """
        if how not in self._view.alignments:
            raise ValueError("The recordings cannot be aligned at that.")
        self._advance()
        view = self._view
        kept = view.states[view.selected] if view.opened else None
        self._align(how, position=kept)

    # --- playing -------------------------------------------------------------------------------------

    @on_loop
    def toggle_play(self) -> None:
        self._advance()
        if self._view.playing:
            self._pause()
        elif self._view.opened and self._view.last > self._view.first:
            at_end = self._view.position >= self._view.last
            position = self._view.first if at_end else self._view.position
            self._playback = _Playback(position, self._clock())
            self._change(playing=True, position=position)

    @on_loop
    def set_speed(self, speed: float) -> None:
        """Set the speed, as a multiple of real time.

        Raises:
            ValueError: not between 0 and 1000.
        """
        if not 0 < speed < 1000:
            raise ValueError("The speed is a number above 0.")
        self._advance()
        self._restart_playback()
        self._change(speed=speed)

    @on_loop
    def set_loop(self, loop: bool) -> None:
        self._change(loop=loop)

    # --- files ---------------------------------------------------------------------------------------

    def _check_files_later(self) -> None:
        if self._next_check is None and self._files:
            self._next_check = later(CHECK_SECONDS, lambda: begin(self._check_files()))

    async def _check_files(self) -> None:
        """Report files that were deleted or changed since they were read."""
        files = self._files
        found = await self._file_checks.run(partial(_changed_files, files))
        self._next_check = None
        self._check_files_later()
        problems = tuple(dict.fromkeys((*self._open_problems, *found)))
        if problems != self._view.problems and files is self._files and not self._view.loading:
            self._change(problems=problems)

    # --- on the loop ---------------------------------------------------------------------------------

    def _change(self, **values: object) -> None:
        self._view = replace(self._view, serial=self._view.serial + 1, **values)  # type: ignore[arg-type]
        self._changes.notify()

    def _align(self, how: str, position: int | None) -> None:
        """Align, and stay at a state of the selected recording (`position`); None goes to the first position."""
        opened = self._view.opened
        name = how.removeprefix("first ")
        anchors = tuple(0 if how == START else (o.first(name) or 0) for o in opened)
        first = -max(anchors, default=0)
        last = max((o.length - a for o, a in zip(opened, anchors, strict=True)), default=0)
        at = first if position is None else position - anchors[self._view.selected]
        self._change(align=how, anchors=anchors, first=first, last=last, position=min(max(at, first), last))
        self._restart_playback()

    def _seek(self, position: int) -> None:
        position = min(max(position, self._view.first), self._view.last)
        if position != self._view.position:
            self._change(position=position)
        self._restart_playback()

    def _pause(self) -> None:
        self._playback = None
        if self._view.playing:
            self._change(playing=False)

    def _restart_playback(self) -> None:
        if self._playback is not None:
            self._playback = _Playback(self._view.position, self._clock())

    def _rate(self) -> float:
        """Positions per second."""
        chosen = self._view.chosen
        return self._view.speed / max(chosen.episode.info.control_dt, 1e-4) if chosen is not None else 0.0

    def _advance(self) -> None:
        """Move the position to where playing is by now."""
        playback, view = self._playback, self._view
        if playback is None:
            return
        position = playback.position + int((self._clock() - playback.at) * self._rate() + 1e-6)
        if position > view.last:
            if view.loop:
                # The last state is shown for as long as any other.
                self._playback = _Playback(view.first, self._clock())
                self._change(position=view.first)
            else:
                self._playback = None
                self._change(position=view.last, playing=False)
        elif position != view.position:
            self._change(position=position)

    def _next_position_in(self) -> float:
        if self._playback is None:
            return 3600.0
        steps = (self._clock() - self._playback.at) * self._rate()
        return max((int(steps + 1e-6) + 1 - steps) / self._rate(), 1e-3)


def _shared(episode: Episode, shapes: SharedShapes) -> Episode:
    """The recording, sharing equal shapes with other recordings."""
    return episode if episode.geometry is None else replace(episode, geometry=shapes.share(episode.geometry))


def _stamps_of(row: LibraryRow) -> dict[Path, _Stamp]:
    """Stamps of the row's files as they are now."""
    return {path: _Stamp(row.name, _size_and_time(path)) for path in row.paths}


def _changed_files(files: Mapping[Path, _Stamp]) -> list[str]:
    """A sentence for each file that was deleted or changed since it was read."""
    found = []
    for path, stamp in files.items():
        now = _size_and_time(path)
        if now is None and stamp.size_and_time is not None:
            found.append(f"{path.name} was deleted since it was opened; what was read of it is still shown.")
        elif now != stamp.size_and_time:
            found.append(
                f"{path.name} has changed since it was opened; open {stamp.recording} again to see what is in it now."
            )
    return found


def _opening_text(rows: Sequence[LibraryRow], done: int) -> str:
    """What is being opened, with a count if there are several."""
    name = rows[done].name
    return f"opening {name}" if len(rows) == 1 else f"opening {done + 1} of {len(rows)}: {name}"


def _size_and_time(path: Path) -> tuple[int, int] | None:
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_size, found.st_mtime_ns
