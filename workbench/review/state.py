"""The state of the review as one value; `apply` returns the state after each event, and the effects to perform."""

from __future__ import annotations

import datetime
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

from workbench.episodes.episode import Episode, EpisodeInfo
from workbench.episodes.row import LibraryRow
from workbench.library.folder import LibraryView
from workbench.live import commands as run
from workbench.live import timeline_commands as timeline
from workbench.live.effects import Asked
from workbench.page.command import Command, Refused
from workbench.review import commands as review
from workbench.review.view import START, Opened, Playback, ReviewView

MAX_OVERLAID = 4
"""Maximum number of overlaid recordings; more cannot be distinguished."""
MAX_OPEN = 64
FIRST_SHOWN_SECONDS = 0.4
"""Time after which the recordings read so far are shown, while others are still read. It doubles each time,
because showing recordings builds a scene."""
_NEVER = datetime.datetime.min.replace(tzinfo=datetime.timezone.utc)
First = Path | Literal["newest"]
"""The recording with this file, or the newest recording."""


@dataclass(frozen=True)
class FileStamp:
    """State of a recording's file when it was read."""

    recording: str
    """Name of the recording."""
    size_and_time: tuple[int, int] | None
    """Bytes and mtime in ns; None if the file did not exist."""


@dataclass(frozen=True)
class OpeningState:
    """Progress of the present or last opening of recordings."""

    number: int = 0
    """Increases with each opening; results of an older opening are dropped."""
    rows: tuple[LibraryRow, ...] = ()
    state: int | None = None
    """Initial state of the first recording."""
    done: int = 0
    """Number of rows that were read or could not be read."""
    read: tuple[Opened, ...] = ()
    """Recordings read so far; empty again when all are shown."""
    files: Mapping[Path, FileStamp] = field(default_factory=dict)
    show_at: float = 0.0
    """Clock time in seconds at which the recordings read so far are shown."""
    pause: float = FIRST_SHOWN_SECONDS
    """Seconds to `show_at` from the start of the opening, or from the last time recordings were shown."""
    shown: bool = False
    """Whether recordings of this opening are already shown."""
    closed: frozenset[str] = frozenset()
    """Ids of recordings that the user closed while others were still read."""


@dataclass(frozen=True)
class ReviewState:
    view: ReviewView = ReviewView()
    library: LibraryView = LibraryView()
    first: First | None = None
    """Recording to open automatically once the library lists it."""
    opening: OpeningState = OpeningState()
    files: Mapping[Path, FileStamp] = field(default_factory=dict)
    """Files of the open recordings."""
    problems: tuple[str, ...] = ()
    """Problems of the last opening, without those about files that changed afterwards."""


# --- events ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Open:
    """Open these recordings in place of the open ones."""

    ids: tuple[str, ...]
    state: int | None = None
    """Initial state of the first recording."""
    library_stays: bool = False
    """See `ReviewView.library_stays`."""


@dataclass(frozen=True)
class OpenFirst:
    """Open this recording automatically once the library lists it, unless another one is opened first."""

    what: First


@dataclass(frozen=True)
class Listed:
    """The library's view changed."""

    library: LibraryView


@dataclass(frozen=True)
class RecordingRead:
    """A recording was read."""

    opening: int
    opened: Opened
    files: Mapping[Path, FileStamp]


@dataclass(frozen=True)
class RecordingNotRead:
    """A recording could not be read."""

    opening: int
    id: str
    problem: str


@dataclass(frozen=True)
class ReadingEnded:
    """All recordings of an opening were read or left out."""

    opening: int
    problem: str = ""
    """Why some recordings were left out."""


@dataclass(frozen=True)
class SceneUpdate:
    """Result or progress of making a scene."""

    opening: int
    id: str
    scene: str
    """Message about the scene."""
    making: bool = False
    episode: Episode | None = None
    """The recording with its scene."""


@dataclass(frozen=True)
class FilesChecked:
    files: Mapping[Path, FileStamp]
    """The files that were checked."""
    changed: tuple[str, ...]
    """A sentence for each file that was deleted or changed."""
    task_of: EpisodeInfo | None = None
    """Info of the recording whose task was checked."""
    changed_symbols: str = ""
    """Symbols of that task that changed since the recording."""


@dataclass(frozen=True)
class ProblemFound:
    """A problem to show until something is opened."""

    sentence: str


ReviewEvent = (
    Asked
    | Open
    | OpenFirst
    | Listed
    | RecordingRead
    | RecordingNotRead
    | ReadingEnded
    | SceneUpdate
    | FilesChecked
    | ProblemFound
)


# --- effects -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class BeginReading:
    """Read these recordings in place of those that are being read."""

    opening: int
    rows: tuple[LibraryRow, ...]


@dataclass(frozen=True)
class CheckFiles:
    """Check the files of the open recordings and the selected one's task, now and periodically."""


ReviewEffect = BeginReading | CheckFiles
Change = tuple[ReviewState, list[ReviewEffect]]


# --- changes -----------------------------------------------------------------------------------------


def apply(state: ReviewState, event: ReviewEvent, now: float) -> Change:
    """The state after an event at clock time `now` in seconds, and the effects to perform.

    Raises `Refused` if a command is not possible; the state is unchanged then.
    """
    before = state.view.chosen
    state, effects = _applied(advanced(state, now), event, now)
    chosen = state.view.chosen
    if chosen is None or (before is not None and before.episode.info is chosen.episode.info):
        return state, effects
    return _with(state, changed_symbols=""), [*effects, CheckFiles()]


def _applied(state: ReviewState, event: ReviewEvent, now: float) -> Change:
    opening = state.opening
    if (
        isinstance(event, RecordingRead | RecordingNotRead | ReadingEnded | SceneUpdate)
        and event.opening != opening.number
    ):
        return state, []
    match event:
        case Asked(command=review.OpenAgain()):
            ids = *(one.id for one in state.view.opened), *state.view.not_opened
            return _open_ids(state, Open(ids), now)
        case Asked(command=command):
            return _asked(state, command, now), []
        case Open():
            return _open_ids(state, event, now)
        case OpenFirst(what=what):
            return _open_first(replace(state, first=what), now)
        case Listed(library=library):
            return _open_first(replace(state, library=library), now)
        case RecordingRead(opened=one, files=files):
            opening = replace(opening, read=(*opening.read, one), files={**opening.files, **files})
            state = _told(
                replace(state, opening=opening), *(file.sentence for file in one.episode.broken_files)
            )
            return _row_done(state, now), []
        case RecordingNotRead(id=id, problem=problem):
            state = _with(_told(state, problem), not_opened=(*state.view.not_opened, id))
            return _row_done(state, now), []
        case ReadingEnded(problem=problem):
            state = _with(_told(state, problem) if problem else state, loading="")
            read = tuple(sorted(opening.read, key=lambda one: one.episode.info.written_at))
            state = _show(state, read, now) if read else state
            return replace(state, opening=replace(state.opening, read=())), []
        case SceneUpdate():
            return _update_scene(state, event), []
        case FilesChecked(files=files, changed=changed, task_of=task_of, changed_symbols=symbols):
            chosen = state.view.chosen
            if (
                chosen is not None
                and chosen.episode.info is task_of
                and symbols != state.view.changed_symbols
            ):
                state = _with(state, changed_symbols=symbols)
            problems = tuple(dict.fromkeys((*state.problems, *changed)))
            if files is state.files and not state.view.loading and problems != state.view.problems:
                state = _with(state, problems=problems)
            return state, []
        case ProblemFound(sentence=sentence):
            return _told(state, sentence), []


def advanced(state: ReviewState, now: float) -> ReviewState:
    """The state with the present position of playback."""
    view = state.view
    if view.playback is None:
        return state
    position = view.playback.position + int((now - view.playback.at) * _rate(view) + 1e-6)
    if position <= view.last:
        return state if position == view.position else _with(state, position=position)
    if view.loop:
        # The last state is shown for the same time as every other state.
        return _with(state, position=view.first, playback=Playback(view.first, now))
    return _with(state, position=view.last, playback=None)


def next_position_in(state: ReviewState, now: float) -> float:
    """Seconds until playback reaches another position."""
    playback = state.view.playback
    if playback is None:
        return 3600.0
    steps = (now - playback.at) * _rate(state.view)
    return max((int(steps + 1e-6) + 1 - steps) / _rate(state.view), 1e-3)


def _rate(view: ReviewView) -> float:
    """Positions per second."""
    return view.speed / max(view.chosen.episode.info.control_dt, 1e-4) if view.chosen is not None else 0.0


def _with(state: ReviewState, **values: object) -> ReviewState:
    return replace(state, view=replace(state.view, **values))  # type: ignore[arg-type]


def _told(state: ReviewState, *sentences: str) -> ReviewState:
    state = replace(state, problems=(*state.problems, *sentences))
    return _with(state, problems=(*state.view.problems, *sentences))


# --- commands ----------------------------------------------------------------------------------------


def _asked(state: ReviewState, command: Command, now: float) -> ReviewState:
    view, count = state.view, len(state.view.opened)
    match command:
        case run.TogglePlay():
            return _play_or_pause(state, now)
        case timeline.StepBack():
            return _moved(_paused(state), view.position - 1, now)
        case timeline.StepForward():
            return _moved(_paused(state), view.position + 1, now)
        case timeline.PreviousEvent():
            return _to_event(state, -1, now)
        case timeline.NextEvent():
            return _to_event(state, 1, now)
        case timeline.Seek(step=step):
            return _moved(state, step, now)
        case timeline.GoToFirst():
            return _moved(state, view.first, now)
        case timeline.GoToLast():
            return _moved(_paused(state), view.last, now)
        case review.SelectRecording(id=id):
            return _select(state, _index_of(view, id), now)
        case review.NextRecording():
            return _select(state, (view.selected + 1) % max(count, 1), now)
        case review.PreviousRecording():
            return _select(state, (view.selected - 1) % max(count, 1), now)
        case review.CloseRecording(id=id):
            return _close(state, _index_of(view, id), now)
        case review.SwapWithFirst(index=index):
            return _swap_with_first(state, index, now)
        case review.ChoosePlaybackSpeed(speed=speed):
            return _moved(_with(state, speed=speed), view.position, now)
        case review.LoopPlayback(on=on):
            return _with(state, loop=on)
        case review.AlignRecordings(at=at) if at in view.alignments:
            kept = view.states[view.selected] if view.opened else None
            return _align(state, at, kept, now)
        case review.AlignRecordings():
            raise Refused("The open recordings have no such event to align at.")
    raise Refused(f"Not possible in a review: {command.help()}.")


def _index_of(view: ReviewView, id: str) -> int:
    for index, one in enumerate(view.opened):
        if one.id == id:
            return index
    raise Refused("This recording is not open any more.")


def _play_or_pause(state: ReviewState, now: float) -> ReviewState:
    view = state.view
    if view.playing:
        return _paused(state)
    if view.last <= view.first:
        return state
    position = view.first if view.position >= view.last else view.position
    return _with(state, position=position, playback=Playback(position, now))


def _paused(state: ReviewState) -> ReviewState:
    return _with(state, playback=None)


def _moved(state: ReviewState, position: int, now: float) -> ReviewState:
    """Go to a position, or the nearest in range; playback continues from there."""
    view = state.view
    position = min(max(position, view.first), view.last)
    return _with(state, position=position, playback=view.playback and Playback(position, now))


def _to_event(state: ReviewState, direction: int, now: float) -> ReviewState:
    """Go to the next (1) or previous (-1) event, or to the last position. Events of all open recordings
    count; if more than `MAX_OVERLAID` are open, only those of the selected one."""
    view = state.view
    if not view.opened:
        return state
    several = range(len(view.opened)) if len(view.opened) <= MAX_OVERLAID else (view.selected,)
    places = {event.state - view.anchors[index] for index in several for event in view.opened[index].events}
    ahead = [place for place in places | {view.last} if (place - view.position) * direction > 0]
    if not ahead:
        return state
    return _moved(_paused(state), min(ahead, key=lambda place: abs(place - view.position)), now)


def _select(state: ReviewState, index: int, now: float) -> ReviewState:
    return _moved(_with(state, selected=index), state.view.position, now)


def _close(state: ReviewState, index: int, now: float) -> ReviewState:
    view, opening = state.view, state.opening
    if opening.shown:
        closed = opening.closed | {view.opened[index].id}
        state = replace(state, opening=replace(opening, closed=closed))
    kept = *view.opened[:index], *view.opened[index + 1 :]
    selected = view.selected - (view.selected > index)
    return _set_opened(state, kept, min(selected, max(len(kept) - 1, 0)), view.align, now)


def _swap_with_first(state: ReviewState, index: int, now: float) -> ReviewState:
    """Swap two recordings; the position stays."""
    view = state.view
    if index >= len(view.opened):
        raise Refused("This recording is not open any more.")
    if view.loading:
        raise Refused("Recordings are still being opened.")
    order = list(range(len(view.opened)))
    order[0], order[index] = index, 0
    opened = [view.opened[k] for k in order]
    return _moved(_set_opened(state, opened, order.index(view.selected), view.align, now), view.position, now)


# --- open recordings ---------------------------------------------------------------------------------


def _open_ids(state: ReviewState, asked: Open, now: float) -> Change:
    rows, ids = {row.id: row for row in state.library.rows}, dict.fromkeys(asked.ids)
    wanted = [rows[id] for id in ids if id in rows]
    problems = []
    if missing := len(ids) - len(wanted):
        problems.append(
            "A requested recording is no longer in the folder."
            if missing == 1
            else f"{missing} requested recordings are no longer in the folder."
        )
    if len(wanted) > MAX_OPEN:
        problems.append(
            f"At most {MAX_OPEN} recordings can be open at once; the first {MAX_OPEN} were opened."
        )
    return _open(state, wanted[:MAX_OPEN], problems, asked.state, now, asked.library_stays)


def _open_first(state: ReviewState, now: float) -> Change:
    first, library = state.first, state.library
    if first is None:
        return state, []
    whole = [row for row in library.rows if row.problem is None]
    if isinstance(first, Path):
        row = next((row for row in whole if first.name in [path.name for path in row.paths]), None)
    elif library.rows and library.reading is None:
        state = replace(state, first=None)  # also if no recording can be read
        row = max(whole, key=lambda row: row.written or 0.0, default=None)
    else:
        return state, []
    return (state, []) if row is None else _open(state, [row], state.problems, None, now, True)


def _open(
    state: ReviewState,
    rows: Iterable[LibraryRow],
    problems: Iterable[str],
    at: int | None,
    now: float,
    library_stays: bool,
) -> Change:
    # The library lists the newest first, but a comparison starts from the oldest. The oldest is also read
    # first, so that it is shown first and stays selected when the others arrive.
    rows = tuple(sorted(rows, key=lambda row: (row.date is None, row.date or _NEVER)))
    opening = OpeningState(
        state.opening.number + 1, rows, at, show_at=now + FIRST_SHOWN_SECONDS, pause=FIRST_SHOWN_SECONDS
    )
    state = replace(state, first=None, opening=opening, problems=tuple(problems))
    state = _with(
        state, loading=_loading(opening), problems=state.problems, not_opened=(), library_stays=library_stays
    )
    return state, [BeginReading(opening.number, rows)]


def _loading(opening: OpeningState) -> str:
    """Text: the recording that is being opened, with a count if there are several."""
    rows, done = opening.rows, opening.done
    if done >= len(rows):
        return ""
    name = rows[done].name
    return f"opening {name}" if len(rows) == 1 else f"opening {done + 1} of {len(rows)}: {name}"


def _row_done(state: ReviewState, now: float) -> ReviewState:
    """Count one more row as done. If `OpeningState.show_at` has passed, show the recordings read so far."""
    opening = replace(state.opening, done=state.opening.done + 1)
    state = replace(state, opening=opening)
    if opening.done < len(opening.rows) and opening.read and now >= opening.show_at:
        pause = 2 * opening.pause
        opening = replace(opening, show_at=now + pause, pause=pause)
        state = _show(replace(state, opening=opening), opening.read, now)
    return _with(state, loading=_loading(opening) or state.view.loading)


def _show(state: ReviewState, read: Sequence[Opened], now: float) -> ReviewState:
    """Show recordings that were read, except those closed meanwhile.

    If recordings of this opening are already shown, selection and position are kept.
    """
    opening, view = state.opening, state.view
    kept = [one for one in read if one.id not in opening.closed]
    state = replace(state, files=opening.files, opening=replace(opening, shown=True))
    if opening.shown:
        selected = next((index for index, one in enumerate(kept) if one is view.chosen), 0)
        return _set_opened(state, kept, selected, view.align, now, stay=True)
    state = _set_opened(state, kept, 0, START, now)
    return state if opening.state is None else _moved(state, opening.state, now)


def _set_opened(
    state: ReviewState, opened: Sequence[Opened], selected: int, align: str, now: float, stay: bool = False
) -> ReviewState:
    """Show these recordings at the first position, or at the present one if `stay`."""
    view = state.view
    stay = stay and bool(view.opened and opened)
    names = dict.fromkeys(event.name for one in opened for event in one.events if event.style != "reset")
    alignments = (START, *(f"first {name}" for name in names))
    state = _with(
        state,
        opened=tuple(opened),
        opened_serial=view.opened_serial + 1,
        selected=selected,
        alignments=alignments,
        playback=view.playback if stay else None,
    )
    kept = view.states[view.selected] if stay else None
    return _align(state, align if align in alignments else START, kept, now)


def _align(state: ReviewState, how: str, kept: int | None, now: float) -> ReviewState:
    """Align the recordings. Stay at state `kept` of the selected one, or go to the first position if `kept`
    is None."""
    opened, name = state.view.opened, how.removeprefix("first ")
    anchors = tuple(0 if how == START else (one.first(name) or 0) for one in opened)
    first = -max(anchors, default=0)
    last = max((one.length - anchor for one, anchor in zip(opened, anchors, strict=True)), default=0)
    at = first if kept is None else kept - anchors[state.view.selected]
    return _moved(_with(state, align=how, anchors=anchors, first=first, last=last), at, now)


def _update_scene(state: ReviewState, update: SceneUpdate) -> ReviewState:
    opened = list(state.view.opened)
    index = next((index for index, one in enumerate(opened) if one.id == update.id), None)
    if index is None:
        return state
    before = opened[index]
    episode = update.episode or before.episode
    opened[index] = after = replace(before, episode=episode, scene=update.scene, making=update.making)
    got_scene = after.has_scene and not before.has_scene
    return _with(state, opened=tuple(opened), opened_serial=state.view.opened_serial + got_scene)
