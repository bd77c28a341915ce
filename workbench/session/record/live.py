"""Recording while the page runs: rows are gathered on one thread, files are made on another.

A row is encoded and put into the journal in a millisecond or less, but the disk may take its time over it, and
making the files of an episode takes a fraction of a second and more for a long one. No event of the worker may wait
for either. So the session's thread only hands the steps over. What waits is bounded: a disk that is slower than the
simulation for long ends the recording with a sentence, since the alternatives are to lose steps unsaid or to fill
the memory.

A file that cannot be written is said and stops nothing but the recording.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from workbench.jobs.gather import EpisodeFinisher, EpisodeGatherer
from workbench.jobs.task import Stepped, TaskDescription
from workbench.machine.processes.watched_thread import report_failure, watched_thread
from workbench.recording.reader.reading import mend, recovered_in_words
from workbench.recording.writing.publish import RecordingError
from workbench.session.record.status import RecordingStatus

_MOST_WAITING = 256 * 1024**2
"""Bytes of steps that the disk has not taken."""


class LiveRecorder:
    """Start and stop as often as wanted; `close` waits for what is still being written."""

    def __init__(
        self,
        folder: Path,
        on_change: Callable[[], None],
        on_envs: Callable[[tuple[int, ...]], None],
        on_recovered: Callable[[str], None] = lambda words: None,
    ) -> None:
        """
        Args:
            on_recovered: called with a sentence on the episodes that an earlier session left half written, from a
                thread of its own.
            on_change: called when `status` has something new, from any thread.
            on_envs: called when an env needs to be captured no longer, with those that do; from a thread of its own.
        """
        self._folder = folder
        self._on_change, self._on_envs, self._on_recovered = on_change, on_envs, on_recovered
        self._lock = threading.Lock()
        self._env_idx: tuple[int, ...] = ()
        self._gatherer: EpisodeGatherer | None = None
        self._recovered: tuple[str, ...] = ()
        self._problem: str | None = None
        self._waiting_bytes = 0
        self._ends_by_itself = False
        self._queue: queue.Queue[Callable[[], None] | None] = queue.Queue()
        """What the recorder's thread is to do; None to end."""
        self.finisher = EpisodeFinisher(on_change, self._recover)
        """Makes the files, of other episodes too."""
        self._thread = watched_thread("recorder", self._work)
        self._thread.start()

    # --- the session's side ----------------------------------------------------------------------------

    def start(self, task: TaskDescription, env_idx: Sequence[int], one_each: bool = False) -> None:
        """From each env's next reset on; of each only the next episode if `one_each`."""
        with self._lock:
            self._env_idx, self._problem, self._ends_by_itself = tuple(env_idx), None, one_each
        gatherer = EpisodeGatherer(task, env_idx, self._folder, self.finisher.finish, one_each=one_each)
        self._queue.put(partial(self._gather_with, gatherer))

    def stop(self) -> None:
        """End the episodes under way; what was gathered of them is written."""
        with self._lock:
            self._env_idx = ()
        self._queue.put(partial(self._gather_with, None))

    def take(self, stepped: Stepped) -> None:
        """The next reset or step."""
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
        """The envs that are recorded, whether or not their episodes have begun."""
        with self._lock:
            return self._env_idx

    @property
    def one_each(self) -> bool:
        """Whether it ends by itself."""
        with self._lock:
            return self._ends_by_itself

    def status(self) -> RecordingStatus:
        with self._lock:
            under_way = self._gatherer.under_way if self._gatherer is not None and self._env_idx else ()
            finished = self.finisher.finished
            return RecordingStatus(
                active=bool(self._env_idx),
                env_idx=self._env_idx,
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
        """End the episodes under way, and gather others from now on, or none."""
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
            # A disk that is full, an entry of evaluate() that is no number, a step that was lost; else it is ours.
            if not isinstance(error, (RecordingError, ValueError)):
                report_failure("A step could not be recorded", error)
            self._gather_with(None)
            with self._lock:
                self._env_idx, self._problem = (), f"the recording ended: {error}"
            # Nothing more of `_env_idx`: another recording may have been started by now.
            self._on_envs(())
            self._on_change()
            return
        left = gatherer.env_idx
        if left != before:
            with self._lock:
                self._env_idx = tuple(env for env in self._env_idx if env in left)
            self._on_envs(left)
            self._on_change()

    def _recover(self) -> None:
        """What a server before this one left behind; on the finisher's thread, before all else."""
        if not self._folder.is_dir():
            return
        try:
            recovered = [str(file) for file in mend(self._folder)]
        except RecordingError as error:
            said = f"what an earlier recording left could not be mended: {error}"
            with self._lock:
                self._problem = said
        else:
            said = recovered_in_words(recovered)
            with self._lock:
                self._recovered = tuple(recovered)
        if said:
            self._on_recovered(said)
        self._on_change()


def _size(stepped: Stepped) -> int:
    held = stepped.step, *stepped.columns.values(), *stepped.captured
    snapshot = len(stepped.snapshot) + sum(map(len, stepped.new_parts.values()))
    return snapshot + sum(part.nbytes for part in held)
