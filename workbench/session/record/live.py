"""Records episodes while the session runs, on a thread of its own."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from workbench.jobs.record.gather import EpisodeFinisher, EpisodeGatherer, GatheredEpisode
from workbench.jobs.task import Stepped, TaskDescription
from workbench.machine.processes.watched_thread import report_failure
from workbench.recording.reader.reading import recover_confined, recovered_text
from workbench.recording.writing.publish import RecordingError
from workbench.session.loop import Aside, on_loop, post
from workbench.session.record.save_past import SaveStatus

_MOST_WAITING = 256 * 1024**2
"""Most bytes of steps that may wait for the disk."""


@dataclass(frozen=True)
class RecordingStatus:
    """Running and finished recordings of a session, for the page."""

    active: bool = False
    env_idx: tuple[int, ...] = ()
    since: float = 0.0
    """Seconds since the epoch at which the recording began; a new version of the task does not change it."""
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
    folder: str = ""
    last_file: str | None = None
    problem: str | None = None
    """Why the recording ended, or the last file could not be written."""
    saving: SaveStatus = field(default_factory=SaveStatus)


class LiveRecorder:
    """Records chosen envs. `close` waits until all files are written.

    The loop only passes the steps on: a row takes a millisecond or less to encode and write to the journal, but a disk may
    be slow, and the files of an episode take a fraction of a second or more. What waits is bounded. A disk that is slower
    than the simulation for long ends the recording, instead of losing steps silently or filling the memory.
    """

    def __init__(
        self,
        folder: Path,
        on_change: Callable[[], None],
        on_fewer_envs: Callable[[tuple[int, ...]], None],
        on_recovered: Callable[[str], None] = lambda message: None,
    ) -> None:
        """
        Args:
            on_change: called when `status` has changed, from any thread.
            on_fewer_envs: called with the envs that still need capturing, when these are fewer.
            on_recovered: called with a message about unfinished episodes of an earlier session, from a thread of its own.
        """
        self._folder = folder
        self._on_change, self._on_fewer_envs, self._on_recovered = on_change, on_fewer_envs, on_recovered
        self.recording: tuple[int, ...] = ()
        """The recorded envs, including those whose episode has not begun."""
        self.one_each = False
        """Whether the recording ends after one episode of each env."""
        self._gatherer: EpisodeGatherer | None = None
        """Takes the steps, on the thread of `_aside`."""
        self._recovered: tuple[str, ...] = ()
        self._problem: str | None = None
        self._waiting_bytes = 0
        self._since, self._episodes = 0.0, 0
        self.finisher = EpisodeFinisher(on_change, self._recover)
        """Makes the files, including those of `PastSaver`."""
        self._aside = Aside("recorder")

    @on_loop
    def start(
        self, task: TaskDescription, env_idx: Sequence[int], one_each: bool = False, goes_on: bool = False
    ) -> None:
        """Record from each env's next reset on.

        Args:
            one_each: only the next episode of each.
            goes_on: it is the recording before, with another version of the task.
        """
        self._end()
        self.recording, self.one_each, self._problem = tuple(env_idx), one_each, None
        if not goes_on:
            self._since, self._episodes = time.time(), 0
        self._gatherer = EpisodeGatherer(task, env_idx, self._folder, self._ended, one_each=one_each)
        self._on_change()

    @on_loop
    def stop(self) -> None:
        """End the running episodes and write what they have."""
        self._end()
        self._on_change()

    def _end(self) -> None:
        gatherer, self._gatherer, self.recording = self._gatherer, None, ()
        if gatherer is not None:
            self._aside.begin(gatherer.finish)

    @on_loop
    def take(self, stepped: Stepped) -> None:
        """Take a step."""
        gatherer = self._gatherer
        if gatherer is None:
            return
        size = _size(stepped)
        if self._waiting_bytes + size > _MOST_WAITING:
            self._end()
            self._problem = (
                "the recording ended: the disk is slower than the simulation. Record fewer envs, or choose "
                "another folder"
            )
            self._on_change()
            return
        self._waiting_bytes += size
        self._aside.begin(partial(self._gather, gatherer, stepped, size))

    def status(self) -> RecordingStatus:
        under_way = () if self._gatherer is None else self._gatherer.under_way
        finished = self.finisher.finished
        return RecordingStatus(
            active=bool(self.recording),
            env_idx=self.recording,
            since=self._since,
            episodes=self._episodes,
            waiting=len(self.recording) - len(under_way) if self.recording else 0,
            steps=sum(episode.steps for episode in under_way),
            bytes_written=finished.bytes_written + sum(e.writer.bytes_written for e in under_way),
            episodes_written=finished.count,
            being_written=self.finisher.waiting,
            recovered=self._recovered,
            folder=str(self._folder),
            last_file=None if finished.last is None else str(finished.last.rrd),
            problem=self._problem or finished.problem,
        )

    def close(self) -> None:
        """Stop, and write all files. Called on another thread than the loop."""
        self.stop()
        self._aside.close()
        self.finisher.close()

    # --- beside the loop -------------------------------------------------------------------------------

    def _gather(self, gatherer: EpisodeGatherer, stepped: Stepped, size: int) -> None:
        before = gatherer.env_idx
        problem = None
        try:
            gatherer.take(stepped)
        except Exception as error:
            # Expected: a full disk, an entry of evaluate() that is no number, a lost step. All else is our own fault.
            if not isinstance(error, (RecordingError, ValueError)):
                report_failure("A step could not be recorded", error)
            problem = f"the recording ended: {error}"
        left = gatherer.env_idx
        post(lambda: self._gathered(gatherer, size, None if left == before else left, problem))

    def _gathered(
        self, gatherer: EpisodeGatherer, size: int, left: tuple[int, ...] | None, problem: str | None
    ) -> None:
        """A step was taken.

        Args:
            left: the envs that go on being recorded, if these are fewer now.
            problem: why it could not be taken.
        """
        self._waiting_bytes -= size
        if gatherer is not self._gatherer:
            return  # another recording has begun, or none
        if problem is not None:
            self._end()
            self._problem = problem
            self._on_fewer_envs(())
            self._on_change()
        elif left is not None:
            self.recording = tuple(env for env in self.recording if env in left)
            self._on_fewer_envs(left)
            if not self.recording:
                self._end()
            self._on_change()

    def _ended(self, episode: GatheredEpisode) -> None:
        post(self._count_episode)
        self.finisher.finish(episode)

    def _count_episode(self) -> None:
        self._episodes += 1
        self._on_change()

    def _recover(self) -> None:
        """Recover episodes that an earlier server left unfinished; on the finisher's thread, before all else."""
        if not self._folder.is_dir():
            return
        recovered: tuple[str, ...] = ()
        problem = None
        try:
            recovered = tuple(str(file) for file in recover_confined(self._folder))
            message = recovered_text(recovered)
        except RecordingError as error:
            message = problem = f"what an earlier recording left could not be recovered: {error}"
        post(lambda: self._set_recovered(recovered, problem))
        if message:
            self._on_recovered(message)

    def _set_recovered(self, recovered: tuple[str, ...], problem: str | None) -> None:
        self._recovered, self._problem = recovered, problem or self._problem
        self._on_change()


def _size(stepped: Stepped) -> int:
    held = stepped.step, *stepped.columns.values(), *stepped.captured
    snapshot = len(stepped.snapshot) + sum(map(len, stepped.new_parts.values()))
    return snapshot + sum(part.nbytes for part in held)
