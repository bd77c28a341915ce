"""State of the live recording, and its changes by events."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

from workbench.live.effects import Asked, Then
from workbench.live.events import EnvsReset, LoadDone, Now, Send, VersionLoaded, WorkerDied
from workbench.live.messages import Loaded, SetCapture
from workbench.live.process.supervisor import End
from workbench.live.run import Run
from workbench.page.command import Command, Refused
from workbench.record import saving_state as of_saving
from workbench.record.commands import ChooseRecordedEnvs, RecordNextEpisode, StopRecording, ToggleRecording
from workbench.record.gather import Finished
from workbench.record.saving_state import KeptEpisodes, SaveEffect, SaveStatus, Saving, without_message
from workbench.task.description import Stepped, TaskDescription

DOES: frozenset[type[Command]] = of_saving.DOES | {
    ToggleRecording,
    StopRecording,
    RecordNextEpisode,
    ChooseRecordedEnvs,
}
"""Commands that `apply` handles."""
MAX_PENDING_BYTES = 256 * 1024**2
"""Maximum size of steps that may wait for the disk."""
TOO_SLOW = (
    "The recording ended: the disk is slower than the simulation. Record fewer envs, or choose another folder"
)
ChosenEnvs = Literal["selected", "all"]


@dataclass(frozen=True)
class RecordingStatus:
    """Running and finished recordings of a session, for the page."""

    active: bool = False
    env_idx: tuple[int, ...] = ()
    since: float = 0.0
    """Start of the recording in seconds since the epoch; a new version of the task does not change it."""
    episodes: int = 0
    """Number of episodes that have ended since the recording began."""
    waiting: int = 0
    """Number of recorded envs whose episode begins with their next reset."""
    steps: int = 0
    """Captured steps of the running episodes."""
    bytes_written: int = 0
    """Bytes written for this session's episodes, including the running ones."""
    episodes_written: int = 0
    being_written: int = 0
    """Number of ended episodes whose files are being made."""
    recovered: tuple[str, ...] = ()
    """.rrd files of episodes that an earlier server left unfinished, recovered at the start."""
    saved: int | None = None
    """Number of episodes of the last recording, once it has ended and their files are written; else None."""
    folder: str = ""
    last_file: str | None = None
    problem: str | None = None
    """Reason why the recording ended, or why the last file could not be written."""
    saving: SaveStatus = field(default_factory=SaveStatus)
    kept: KeptEpisodes = KeptEpisodes()
    chosen: ChosenEnvs = "selected"
    """Envs that a person chose to record and to save."""


@dataclass(frozen=True)
class RunningEpisodes:
    """Counts over the running episodes, as far as their steps are in the journals."""

    episodes: int = 0
    steps: int = 0
    bytes_written: int = 0


@dataclass(frozen=True)
class LiveRecording:
    """The running recording, and the results so far. Each env is recorded from its next reset on."""

    folder: str
    chosen: ChosenEnvs = "selected"
    env_idx: tuple[int, ...] = ()
    """The recorded envs, including those whose episode has not begun; empty while nothing is recorded."""
    one_each: bool = False
    """Whether the recording ends after one episode of each env."""
    number: int = 0
    """Number of the last gatherer; events of older gatherers are ignored."""
    since: float = 0.0
    episodes: int = 0
    """`since` and `episodes`: as in `RecordingStatus`."""
    written_before: int = 0
    """Number of episodes of this session that were written, or being written, when the recording began."""
    ended: bool = False
    """Whether the recording has ended, and all its episodes are being written."""
    under_way: RunningEpisodes = RunningEpisodes()
    waiting_bytes: int = 0
    """Bytes of steps that wait for the disk, including those of earlier recordings."""
    being_written: int = 0
    written: Finished = Finished()
    recovered: tuple[str, ...] = ()
    problem: str | None = None
    continues: Continues | None = None
    """Recording to resume once all requests that follow from a load have been sent to the worker."""
    saving: Saving = Saving()

    def status(self, run: Run) -> RecordingStatus:
        """The status for the page."""
        under_way, written = self.under_way, self.written
        return RecordingStatus(
            active=bool(self.env_idx),
            env_idx=self.env_idx,
            since=self.since,
            episodes=self.episodes,
            waiting=len(self.env_idx) - under_way.episodes if self.env_idx else 0,
            steps=under_way.steps,
            bytes_written=written.bytes_written + under_way.bytes_written,
            episodes_written=written.count,
            being_written=self.being_written,
            recovered=self.recovered,
            saved=max(written.count - self.written_before, 0)
            if self.ended and not self.being_written
            else None,
            folder=self.folder,
            last_file=None if written.last is None else str(written.last.rrd),
            problem=self.problem or written.problem,
            saving=self.saving.status_of(run),
            kept=self.saving.kept,
            chosen=self.chosen,
        )


@dataclass(frozen=True)
class Continues:
    """A recording that a load has ended."""

    env_idx: tuple[int, ...]
    one_each: bool
    put_back: bool
    """Whether the envs are still within their episodes after the load, so that a reset would lose the current
    moment."""


# --- events and effects -----------------------------------------------------------------------------


@dataclass(frozen=True)
class RecordingWanted:
    """Reset these envs (all if None) and record them until `StopRecording`."""

    env_idx: tuple[int, ...] | None = None
    next_episode: bool = False
    """Do not reset, and record only one episode of each env: the one that begins with the env's next
    reset."""


@dataclass(frozen=True)
class StepRecorded:
    """A step is in the journals, or could not be written."""

    number: int
    """Number of the gatherer."""
    bytes: int
    env_idx: tuple[int, ...]
    """Envs that are still recorded."""
    under_way: RunningEpisodes
    problem: str | None = None
    """Reason why the step could not be recorded."""


@dataclass(frozen=True)
class EpisodeEnded:
    """An episode has ended; its files are written next."""

    live: bool
    """True if the episode was recorded live, False if it was saved from the history."""


@dataclass(frozen=True)
class EpisodesEnded:
    """All episodes of a gatherer have ended."""

    number: int


@dataclass(frozen=True)
class EpisodeWritten:
    """The files of an episode are written, or could not be written."""

    finished: Finished


@dataclass(frozen=True)
class EpisodesRecovered:
    """Episodes that an earlier server left unfinished were recovered."""

    files: tuple[str, ...]
    problem: str | None


RecordEvent = StepRecorded | EpisodeEnded | EpisodesEnded | EpisodeWritten | EpisodesRecovered
"""Events of the recording."""


@dataclass(frozen=True)
class BeginEpisodes:
    """Record these envs from their next reset on; end the running episodes."""

    number: int
    task: TaskDescription
    env_idx: tuple[int, ...]
    one_each: bool


@dataclass(frozen=True)
class TakeStep:
    """Append this step to the running episodes."""

    stepped: Stepped
    bytes: int


@dataclass(frozen=True)
class EndEpisodes:
    """End the running episodes and write their files."""


RecordEffect = BeginEpisodes | TakeStep | EndEpisodes | SaveEffect | Send | Then
Change = tuple[LiveRecording, list[RecordEffect]]


# --- apply ------------------------------------------------------------------------------------------


def apply(
    recording: LiveRecording, event: object, run: Run, now: Now, solved: tuple[int, ...] = ()
) -> Change:
    """The next state of the recording after an event, and the effects to carry out.

    If the disk stays slower than the simulation, the recording ends, instead of silently losing steps or filling the memory.

    Args:
        run: the run after the event.
        solved: envs whose episode is solved.

    Raises:
        Refused: the command is not possible now; nothing has changed.
    """
    chosen = None if recording.chosen == "all" else (run.env,)
    saving, effects = of_saving.apply(recording.saving, event, run, chosen, solved)
    if saving is not recording.saving:
        recording = replace(recording, saving=saving)
    recording, more = _apply(recording, event, run, now, chosen)
    return recording, [*effects, *more]


def _apply(
    recording: LiveRecording, event: object, run: Run, now: Now, chosen: tuple[int, ...] | None
) -> Change:
    match event:
        case Asked(command=ToggleRecording()) if not recording.env_idx:
            return _start(_new(recording, now), run, chosen, one_each=False, reset=True)
        case Asked(command=ToggleRecording() | StopRecording()):
            if not recording.env_idx:
                raise Refused("Nothing is being recorded.")
            return _ended(recording), [Send(SetCapture(())), EndEpisodes()]
        case Asked(command=RecordNextEpisode()):
            return _start(_new(recording, now), run, chosen, one_each=True, reset=False)
        case Asked(command=ChooseRecordedEnvs(envs=envs)):
            return replace(recording, chosen=envs), []
        case RecordingWanted(env_idx=env_idx, next_episode=next_episode) if env_idx != ():
            return _start(_new(recording, now), run, env_idx, one_each=next_episode, reset=not next_episode)
        case Stepped() if recording.env_idx:
            return _take(recording, event)
        case StepRecorded():
            return _recorded(recording, event)
        case EpisodeEnded(live=live):
            return replace(
                recording,
                episodes=recording.episodes + live,
                being_written=recording.being_written + 1,
            ), []
        case EpisodesEnded(number=recording.number) if not recording.env_idx and recording.continues is None:
            return replace(recording, ended=True), []
        case EpisodeWritten(finished=finished):
            return replace(recording, being_written=recording.being_written - 1, written=finished), []
        case EpisodesRecovered(files=files, problem=problem):
            return replace(recording, recovered=files, problem=problem or recording.problem), []
        case WorkerDied(death=death) if recording.env_idx and death.end is not End.HANDED_OVER:
            return _ended(recording), [EndEpisodes()]
        case VersionLoaded(loaded=loaded) if recording.env_idx:
            return _loaded(recording, loaded, run)
        case LoadDone() if (continues := recording.continues) is not None:
            one_each = continues.one_each
            # The new version may have fewer envs.
            env_idx = tuple(env for env in continues.env_idx if env < run.num_envs)
            if not env_idx:
                return replace(recording, continues=None), []
            reset = not (continues.put_back or one_each)
            return _start(recording, run, env_idx, one_each=one_each, reset=reset)
    return recording, []


def _new(recording: LiveRecording, now: Now) -> LiveRecording:
    before = recording.written.count + recording.being_written
    return replace(recording, since=now.wall, episodes=0, written_before=before)


def _start(
    recording: LiveRecording, run: Run, env_idx: tuple[int, ...] | None, *, one_each: bool, reset: bool
) -> Change:
    if run.task is None:
        raise Refused("No task is loaded yet.")
    envs = tuple(range(run.num_envs)) if env_idx is None else env_idx
    begun = replace(
        _ended(recording),
        env_idx=envs,
        one_each=one_each,
        number=recording.number + 1,
        ended=False,
        problem=None,
        saving=without_message(recording.saving),
    )
    begin = BeginEpisodes(begun.number, run.task, envs, one_each)
    effects: list[RecordEffect] = [begin, Send(SetCapture(envs, from_reset=True))]
    return begun, [*effects, Then(EnvsReset(None if env_idx is None else envs))] if reset else effects


def _ended(recording: LiveRecording, problem: str | None = None) -> LiveRecording:
    return replace(
        recording,
        env_idx=(),
        under_way=RunningEpisodes(),
        problem=problem or recording.problem,
        continues=None,
    )


def _take(recording: LiveRecording, stepped: Stepped) -> Change:
    size = _size(stepped)
    waiting = recording.waiting_bytes + size
    if waiting > MAX_PENDING_BYTES:
        return _ended(recording, TOO_SLOW), [EndEpisodes(), Send(SetCapture(()))]
    return replace(recording, waiting_bytes=waiting), [TakeStep(stepped, size)]


def _recorded(recording: LiveRecording, event: StepRecorded) -> Change:
    recording = replace(recording, waiting_bytes=recording.waiting_bytes - event.bytes)
    if event.number != recording.number or not recording.env_idx:
        return recording, []  # the step belongs to a recording that has ended
    if event.problem is not None:
        return _ended(recording, event.problem), [EndEpisodes(), Send(SetCapture(()))]
    left = tuple(env for env in recording.env_idx if env in event.env_idx)
    recorded = replace(recording, env_idx=left, under_way=event.under_way)
    if left == recording.env_idx:
        return recorded, []
    capture = Send(SetCapture(left, from_reset=True))
    return (recorded, [capture]) if left else (_ended(recorded), [capture, EndEpisodes()])


def _loaded(recording: LiveRecording, loaded: Loaded, run: Run) -> Change:
    """Handle a load: an episode must not mix steps of two versions or two processes."""
    report = loaded.reload
    if report is not None and report.level == "same":
        return recording, []
    put_back = run.after_load != "gone" or (report is not None and bool(report.carried))
    continues = Continues(recording.env_idx, recording.one_each, put_back)
    return replace(_ended(recording), continues=continues), [EndEpisodes()]


def _size(stepped: Stepped) -> int:
    held = stepped.step, *stepped.columns.values(), *stepped.captured
    snapshot = len(stepped.snapshot) + sum(map(len, stepped.new_parts.values()))
    return snapshot + sum(part.nbytes for part in held)
