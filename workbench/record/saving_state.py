"""State of saving past episodes, and its changes by events."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from workbench.live.effects import Asked
from workbench.live.events import VersionLoaded
from workbench.live.history.moments import EnvMoment, History
from workbench.live.messages import Load
from workbench.live.process.ask import WAITING
from workbench.live.process.background_jobs import JobProgress
from workbench.live.run import Run
from workbench.page.command import Command, Refused
from workbench.record.commands import SavePreviousEpisode, SaveSolved, ToggleSavePast
from workbench.task.description import TaskDescription

DOES: frozenset[type[Command]] = frozenset({ToggleSavePast, SavePreviousEpisode, SaveSolved})
"""Commands that `apply` handles."""


@dataclass(frozen=True)
class SaveStatus:
    """Progress and result of recording a past episode."""

    message: str = ""
    """Result of the last job that ended."""
    failed: bool = False
    """Whether `message` is an error."""
    refused_at: object = None
    """The version, env and moment that were shown when a save was refused; `message` is valid only while they
    are shown. None if no save was refused."""
    progress: JobProgress | None = None
    """Progress of the running job; None while no job runs."""


@dataclass(frozen=True)
class KeptEpisodes:
    """The set of episodes that a person has driven and kept."""

    saved: int = 0
    successes: int = 0
    """Number of saved episodes that end in success."""
    waiting: int = 0
    """Kept episodes that are not saved yet."""
    failed: int = 0
    """Kept episodes that could not be saved."""
    why: str = ""
    """Why the last failed one could not be saved."""


@dataclass(frozen=True)
class Saving:
    """State of saving past episodes, one job at a time."""

    status: SaveStatus = SaveStatus()
    job: int = 0
    """Number of the last job."""
    running: SaveRequest | None = None
    """What the running job saves; None while no job runs."""
    waiting: tuple[SaveRequest, ...] = ()
    """Requests that wait until `running` is done."""
    kept: KeptEpisodes = KeptEpisodes()

    @property
    def requests(self) -> tuple[SaveRequest, ...]:
        """The running request, and those that wait."""
        return self.waiting if self.running is None else (self.running, *self.waiting)

    @property
    def unsaved(self) -> int:
        """Number of episodes that are not saved yet."""
        return sum(len(request.episodes) for request in self.requests)

    @property
    def text(self) -> str:
        """Which episodes are not saved yet, such as "1 episode (rendering again, 120 of 290)"; empty for none."""
        if not self.unsaved:
            return ""
        which = f"{self.unsaved} episode{'' if self.unsaved == 1 else 's'}"
        return which if self.status.progress is None else f"{which} ({self.status.progress.text})"

    def status_of(self, run: Run) -> SaveStatus:
        """The status for the shown version, env and moment."""
        if self.status.refused_at in (None, _shown(run)):
            return self.status
        return SaveStatus(progress=self.status.progress)


@dataclass(frozen=True, eq=False)
class PastEpisode:
    """The moments of one env's episode, oldest first; the first is its reset.

    If the env jumped back, the moments up to the restored one are followed by those after the jump. The last
    moment is the one at which the env terminated or, except in a kept episode, was truncated. If neither
    happened, the last moment is the one before the next reset or jump; in a running episode, it is the newest
    moment.
    """

    env: int
    moments: tuple[EnvMoment, ...]
    seed: int
    """Seed of the episode; negative if unknown."""
    played_by: TaskDescription | None = None
    """The version that made the last moment; None if unknown."""

    @property
    def steps(self) -> int:
        return len(self.moments) - 1

    @property
    def ended(self) -> bool:
        """Whether the task ended the episode; False if the episode still runs or its env was reset early."""
        moment, env = self.moments[-1]
        step = moment.as_recorded
        return bool(step.terminated[env] or step.truncated[env])

    @property
    def succeeded(self) -> bool:
        """Whether the task reports success at the end of the episode."""
        moment, env = self.moments[-1]
        success = moment.as_recorded.evaluate.get("success")
        return success is not None and bool(np.any(success[env]))


@dataclass(frozen=True, eq=False)
class SaveRequest:
    """Past episodes to record, with all data that the worker needs, because the history changes while the job
    runs."""

    task: TaskDescription
    load: Load
    """The load that gave the running version; the background worker repeats it."""
    episodes: tuple[PastEpisode, ...]
    kept: bool = False
    """Whether a person drove these episodes and kept them; see `KeptEpisodes`."""


# --- events and effects -----------------------------------------------------------------------------


@dataclass(frozen=True)
class SaveWanted:
    """Save, for each of these envs (all if None), the episode that contains the shown moment.

    At the newest moment this is the running episode or, if it has no step yet, the previous one.
    """

    env_idx: tuple[int, ...] | None = None
    before: bool = False
    """Save the previous episode instead."""


@dataclass(frozen=True)
class EpisodesKept:
    """Save these episodes after those that are being saved."""

    what: SaveRequest


@dataclass(frozen=True)
class SaveProgressed:
    job: int
    progress: JobProgress


@dataclass(frozen=True)
class EpisodesSaved:
    job: int
    message: str
    """What was saved, for the page."""


@dataclass(frozen=True)
class SaveFailed:
    job: int
    why: str


SaveEvent = EpisodesKept | SaveProgressed | EpisodesSaved | SaveFailed
"""Events of saving."""


@dataclass(frozen=True)
class BeginSaving:
    """Begin this job. No other job runs."""

    job: int
    what: SaveRequest


@dataclass(frozen=True)
class EndSaving:
    """Cancel the job; it writes no file."""


SaveEffect = BeginSaving | EndSaving


def apply(
    saving: Saving, event: object, run: Run, chosen: tuple[int, ...] | None, solved: tuple[int, ...]
) -> tuple[Saving, list[SaveEffect]]:
    """The next state after an event, and the effects to carry out.

    Args:
        chosen: envs that a person chose for recording; None for all.
        solved: envs whose episode is solved.

    Raises:
        Refused: the command is not possible now; nothing has changed.
    """
    runs = saving.status.progress is not None
    match event:
        case Asked(command=ToggleSavePast()) if runs:
            return _stopped(saving), [EndSaving()]
        case Asked(command=ToggleSavePast()):
            return _save(saving, run, chosen)
        case Asked(command=SavePreviousEpisode()):
            return _save(saving, run, chosen, before=True)
        case Asked(command=SaveSolved()):
            if runs:
                raise Refused("An episode is already being saved: wait until it is saved.")
            if not solved:
                raise Refused("No episode is solved.")
            return _save(saving, run, solved)
        case SaveWanted(env_idx=env_idx, before=before):
            return _save(saving, run, env_idx, before)
        case VersionLoaded(loaded=loaded) if loaded.reload is None or loaded.reload.level != "same":
            return without_message(saving), []
        case SaveProgressed(job=saving.job, progress=progress) if runs:
            return replace(saving, status=replace(saving.status, progress=progress)), []
        case EpisodesKept(what=what) if runs:
            return _with_kept(replace(saving, waiting=(*saving.waiting, what)), waiting=1), []
        case EpisodesKept(what=what):
            return _begun(_with_kept(saving, waiting=1), what)
        case EpisodesSaved(job=saving.job, message=message) if runs:
            return _next(saving, SaveStatus(message))
        case SaveFailed(job=saving.job, why=why) if runs:
            return _next(saving, SaveStatus(why, failed=True))
    return saving, []


def without_message(saving: Saving) -> Saving:
    """Drop the message about the last result, because something else is recorded or another version runs."""
    if not saving.status.message:
        return saving
    return replace(saving, status=SaveStatus(progress=saving.status.progress))


def _save(
    saving: Saving, run: Run, env_idx: tuple[int, ...] | None, before: bool = False
) -> tuple[Saving, list[SaveEffect]]:
    what = request_of(run, env_idx, before)
    if isinstance(what, str):
        status = SaveStatus(what, True, refused_at=_shown(run), progress=saving.status.progress)
        return replace(saving, status=status), []
    if saving.running is not None:
        return replace(saving, waiting=(*saving.waiting, what)), []
    return _begun(saving, what)


def _begun(
    saving: Saving, what: SaveRequest, status: SaveStatus = SaveStatus()
) -> tuple[Saving, list[SaveEffect]]:
    """Begin the next job. `status` is the result of the last job; it stays on the page only if that job
    failed."""
    job = saving.job + 1
    status = replace(status if status.failed else SaveStatus(), progress=JobProgress(WAITING, 0, 0))
    return replace(saving, status=status, job=job, running=what), [BeginSaving(job, what)]


def _next(saving: Saving, status: SaveStatus) -> tuple[Saving, list[SaveEffect]]:
    """Handle the end of the running job, and begin the next."""
    what = saving.running
    if what is not None and what.kept and status.failed:
        saving = _with_kept(saving, waiting=-1, failed=1, why=status.message)
    elif what is not None and what.kept:
        saving = _with_kept(saving, waiting=-1, saved=1, successes=int(what.episodes[0].succeeded))
    if not saving.waiting:
        return replace(saving, status=status, running=None), []
    first, *rest = saving.waiting
    return _begun(replace(saving, waiting=tuple(rest)), first, status)


def _stopped(saving: Saving) -> Saving:
    """Drop the running job and those after it."""
    why, lost = "Stopped; nothing was saved", saving.kept.waiting
    if lost:
        why = f"Stopped; {lost} kept episode{' was' if lost == 1 else 's were'} not saved"
        saving = _with_kept(saving, waiting=-lost, failed=lost, why=why)
    return replace(saving, status=SaveStatus(why), running=None, waiting=())


def _with_kept(saving: Saving, why: str = "", **more: int) -> Saving:
    """The state with `more` added to its counts of kept episodes."""
    kept = saving.kept
    counts = {name: getattr(kept, name) + by for name, by in more.items()}
    return replace(saving, kept=replace(kept, why=why or kept.why, **counts))


def _shown(run: Run) -> object:
    """The shown version, env and moment."""
    past = run.past
    return run.task_serial, run.env, None if past is None else (past.at, past.pinned)


# --- the episodes -----------------------------------------------------------------------------------


def request_of(
    run: Run, env_idx: tuple[int, ...] | None, before: bool = False, kept: bool = False
) -> SaveRequest | str:
    """The request to record, for each of these envs (all if None), the episode that contains the shown moment; or the reason
    why there is none.

    Args:
        before: record the previous episode instead.
        kept: see `SaveRequest.kept`. A kept episode goes on after the time limit, until it terminates.
    """
    load = run.running_load()
    if run.task is None or run.past is None or load is None:
        return "No task is loaded yet"
    shown = run.past.shown
    serial = None if shown is None else shown.serial
    envs = range(run.num_envs) if env_idx is None else env_idx
    found = {env: find_episode(run.past.history, env, serial, before, not kept) for env in envs}
    episodes = tuple(
        replace(episode, played_by=run.version_of(episode.moments[-1][0].serial))
        for episode in found.values()
        if isinstance(episode, PastEpisode)
    )
    if not episodes:
        env, why = next(iter(found.items()))
        return f"Nothing of env {env} was saved: {why}"
    return SaveRequest(run.task, load, episodes, kept)


def find_episode(
    history: History, env: int, serial: int | None, before: bool = False, limited: bool = True
) -> PastEpisode | str:
    """This env's episode that contains the moment `serial`, up to the episode's end; or the reason why it
    cannot be recorded.

    Args:
        serial: serial of the moment; None for the running episode or, if it has no step yet, the previous one.
        before: return the previous episode instead.
        limited: whether the time limit ends the episode.
    """
    if not len(history):
        return "there is no step yet"
    found = _episode_at(history, env, history.last if serial is None else serial, limited)
    if isinstance(found, PastEpisode) and found.steps == 0 and serial is None:
        found = _episode_before(history, env, found, limited) or found
    if before and isinstance(found, PastEpisode):
        found = _episode_before(history, env, found, limited)
        while isinstance(found, PastEpisode) and found.steps == 0:  # it was reset at once
            found = _episode_before(history, env, found, limited)
        found = found or "there is no earlier episode in memory"
    if isinstance(found, PastEpisode) and found.steps == 0:
        return (
            "the previous episode has no step: it was reset at once"
            if before
            else "its episode has no step yet"
        )
    return found


def _episode_before(
    history: History, env: int, episode: PastEpisode, limited: bool
) -> PastEpisode | str | None:
    """The previous episode, or the reason why it cannot be recorded; None if it is not in memory."""
    begin = episode.moments[0][0].serial
    return _episode_at(history, env, begin - 1, limited) if begin > history.first else None


def _episode_at(history: History, env: int, serial: int, limited: bool) -> PastEpisode | str:
    moments = history.episode(env, serial)
    if not moments:
        return "there is no step yet"
    first, of = moments[0]
    if not first.jumped[of] or first.step.elapsed_steps[of] != 0:
        return "the beginning of its episode is no longer in memory"
    if any(moment.snapshot is None for moment, _ in moments):
        return "some moments have no snapshot of the task's state, so they cannot be rendered again"
    for count, (moment, at) in enumerate(moments):
        step = moment.as_recorded
        if count > 0 and (step.terminated[at] or (limited and step.truncated[at])):
            moments = moments[: count + 1]
            break
    seed = -1 if first.seeds is None else int(first.seeds[of])
    return PastEpisode(env, moments, seed)
