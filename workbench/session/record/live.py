"""Records episodes while the session runs, on a thread of its own."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from workbench.jobs.record.gather import EpisodeFinisher, EpisodeGatherer, GatheredEpisode
from workbench.jobs.task import Stepped, TaskDescription
from workbench.machine.processes.watched_thread import report_failure, watched_thread
from workbench.recording.reader.reading import recover_confined, recovered_text
from workbench.recording.writing.publish import RecordingError
from workbench.session.record.save_past import SaveStatus

_MOST_WAITING = 256 * 1024**2
"""Bytes of steps that wait for the disk."""


@dataclass(frozen=True)
class RecordingStatus:
    """Running and finished recordings of a session, for the page."""

    active: bool = False
    env_idx: tuple[int, ...] = ()
    since: float = 0.0
    """Seconds since the epoch: when it was begun, also where a new version came meanwhile."""
    episodes: int = 0
    """That have ended since."""
    waiting: int = 0
    """Envs of these whose episode begins with their next reset."""
    steps: int = 0
    """Steps captured of the running episodes."""
    bytes_written: int = 0
    """Of this session's episodes, the running ones included."""
    episodes_written: int = 0
    being_written: int = 0
    """Ended episodes whose files are being made."""
    recovered: tuple[str, ...] = ()
    """.rrd files of episodes that an earlier server left unfinished, recovered at the start."""
    folder: str = ""
    last_file: str | None = None
    problem: str | None = None
    """Why the recording ended, or the last file could not be written."""
    saving: SaveStatus = field(default_factory=SaveStatus)


class LiveRecorder:
    """Records chosen envs. `close` waits until all files are written.

    The session's thread only queues the steps: a row takes a millisecond or less to encode and write to the journal, but
    a disk may be slow, and the files of an episode take a fraction of a second or more. The queue is bounded. A disk that
    is slower than the simulation for long ends the recording, instead of losing steps silently or filling the memory.
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
            on_fewer_envs: called with the envs that still need capturing, when these are fewer; from a thread of its own.
            on_recovered: called with a message about unfinished episodes of an earlier session, from a thread of its own.
        """
        self._folder = folder
        self._on_change, self._on_fewer_envs, self._on_recovered = on_change, on_fewer_envs, on_recovered
        self._lock = threading.Lock()
        self._env_idx: tuple[int, ...] = ()
        self._gatherer: EpisodeGatherer | None = None
        self._recovered: tuple[str, ...] = ()
        self._problem: str | None = None
        self._waiting_bytes = 0
        self._ends_by_itself = False
        self._since, self._episodes = 0.0, 0
        self._queue: queue.Queue[Callable[[], None] | None] = queue.Queue()
        """Work of the recorder's thread; None ends it."""
        self.finisher = EpisodeFinisher(on_change, self._recover)
        """Makes the files, also those of `PastSaver`."""
        self._thread = watched_thread("recorder", self._work)
        self._thread.start()

    # --- the session's side ----------------------------------------------------------------------------

    def start(
        self, task: TaskDescription, env_idx: Sequence[int], one_each: bool = False, goes_on: bool = False
    ) -> None:
        """Record from each env's next reset on.

        Args:
            one_each: only the next episode of each.
            goes_on: it is the recording before, with another version of the task.
        """
        with self._lock:
            self._env_idx, self._problem, self._ends_by_itself = tuple(env_idx), None, one_each
            if not goes_on:
                self._since, self._episodes = time.time(), 0
        gatherer = EpisodeGatherer(task, env_idx, self._folder, self._ended, one_each=one_each)
        self._queue.put(partial(self._gather_with, gatherer))

    def _ended(self, episode: GatheredEpisode) -> None:
        with self._lock:
            self._episodes += 1
        self.finisher.finish(episode)

    def stop(self) -> None:
        """End the running episodes and write what they have."""
        with self._lock:
            self._env_idx = ()
        self._queue.put(partial(self._gather_with, None))

    def take(self, stepped: Stepped) -> None:
        """Queue the next reset or step."""
        size = _size(stepped)
        with self._lock:
            if not self._env_idx:
                return
            if self._waiting_bytes + size > _MOST_WAITING:
                self._env_idx = ()
                self._problem = (
                    "the recording ended: the disk is slower than the simulation. Record fewer envs, or choose "
                    "another folder"
                )
                self._queue.put(partial(self._gather_with, None))
                return
            self._waiting_bytes += size
        self._queue.put(partial(self._take, stepped, size))

    @property
    def recording(self) -> tuple[int, ...]:
        """The recorded envs, including those whose episode has not begun."""
        with self._lock:
            return self._env_idx

    @property
    def one_each(self) -> bool:
        """Whether the recording ends after one episode of each env."""
        with self._lock:
            return self._ends_by_itself

    def status(self) -> RecordingStatus:
        with self._lock:
            under_way = self._gatherer.under_way if self._gatherer is not None and self._env_idx else ()
            finished = self.finisher.finished
            return RecordingStatus(
                active=bool(self._env_idx),
                env_idx=self._env_idx,
                since=self._since,
                episodes=self._episodes,
                waiting=len(self._env_idx) - len(under_way) if self._env_idx else 0,
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
        self.stop()
        self._queue.put(None)
        self._thread.join()
        self.finisher.close()

    # --- the recorder's thread -------------------------------------------------------------------------

    def _work(self) -> None:
        while (work := self._queue.get()) is not None:
            work()

    def _gather_with(self, gatherer: EpisodeGatherer | None) -> None:
        """End the running episodes; the next steps go to `gatherer`, or nowhere."""
        with self._lock:
            before, self._gatherer = self._gatherer, gatherer
        if before is not None:
            before.finish()
        self._on_change()

    def _take(self, stepped: Stepped, size: int) -> None:
        with self._lock:
            self._waiting_bytes -= size
        gatherer = self._gatherer
        if gatherer is None:
            return
        before = gatherer.env_idx
        try:
            gatherer.take(stepped)
        except Exception as error:
            # Expected: a full disk, an entry of evaluate() that is no number, a lost step. All else is our own fault.
            if not isinstance(error, (RecordingError, ValueError)):
                report_failure("A step could not be recorded", error)
            self._gather_with(None)
            with self._lock:
                self._env_idx, self._problem = (), f"the recording ended: {error}"
            # `_env_idx` stays as it is from here on: another recording may have started by now.
            self._on_fewer_envs(())
            self._on_change()
            return
        left = gatherer.env_idx
        if left != before:
            with self._lock:
                self._env_idx = tuple(env for env in self._env_idx if env in left)
            self._on_fewer_envs(left)
            self._on_change()

    def _recover(self) -> None:
        """Recover episodes that an earlier server left unfinished; on the finisher's thread, before all else."""
        if not self._folder.is_dir():
            return
        try:
            recovered = [str(file) for file in recover_confined(self._folder)]
        except RecordingError as error:
            message = f"what an earlier recording left could not be recovered: {error}"
            with self._lock:
                self._problem = message
        else:
            message = recovered_text(recovered)
            with self._lock:
                self._recovered = tuple(recovered)
        if message:
            self._on_recovered(message)
        self._on_change()


def _size(stepped: Stepped) -> int:
    held = stepped.step, *stepped.columns.values(), *stepped.captured
    snapshot = len(stepped.snapshot) + sum(map(len, stepped.new_parts.values()))
    return snapshot + sum(part.nbytes for part in held)
