"""Recording while the page runs: gather on the session's thread, write on a thread of its own.

Writing an episode takes a fraction of a second, in which no event of the worker may wait; and a file
that cannot be written must be said and must not stop the simulation.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Sequence
from pathlib import Path

from workbench.recording.episode import Episode
from workbench.recording.rrd import episode_filename, write_rrd
from workbench.session.episodes import EpisodeGatherer
from workbench.session.messages import Stepped, TaskDescription
from workbench.session.view import RecordingStatus


class LiveRecorder:
    """Start and stop as often as wanted; `close` waits for what is still being written."""

    def __init__(self, folder: Path, on_change: Callable[[], None]) -> None:
        self._folder = folder
        self._on_change = on_change
        self._lock = threading.Lock()
        self._gatherer: EpisodeGatherer | None = None
        self._env_idx: tuple[int, ...] = ()
        self._written = 0
        self._last_file: str | None = None
        self._problem: str | None = None
        self._queue: queue.Queue[Episode | None] = queue.Queue()
        self._thread = threading.Thread(target=self._write_all, name="episode-writer", daemon=True)
        self._thread.start()

    def start(self, task: TaskDescription, env_idx: Sequence[int]) -> None:
        self.stop()
        with self._lock:
            self._env_idx = tuple(env_idx)
            self._gatherer = EpisodeGatherer(task, env_idx, self._queue.put)
            self._problem = None

    def stop(self) -> None:
        """End the episodes under way; what was gathered of them is written."""
        with self._lock:
            gatherer, self._gatherer = self._gatherer, None
            self._env_idx = ()
        if gatherer is not None:
            self._guarded(gatherer.finish)

    def take(self, stepped: Stepped) -> None:
        """The next reset or step; a step that no episode can hold ends the recording, and is told."""
        gatherer = self._gatherer
        if gatherer is not None and not self._guarded(lambda: gatherer.take(stepped)):
            with self._lock:
                self._gatherer, self._env_idx = None, ()
            self._guarded(gatherer.finish)

    def _guarded(self, do: Callable[[], None]) -> bool:
        try:
            do()
        except ValueError as error:  # an entry of evaluate() that is no number, a step that was lost
            with self._lock:
                self._problem = f"the recording ended: {error}"
            return False
        return True

    def status(self) -> RecordingStatus:
        with self._lock:
            steps = self._gatherer.steps if self._gatherer is not None else 0
            return RecordingStatus(
                active=self._gatherer is not None,
                env_idx=self._env_idx,
                steps=steps,
                episodes_written=self._written,
                folder=str(self._folder),
                last_file=self._last_file,
                problem=self._problem,
            )

    def close(self) -> None:
        self.stop()
        self._queue.put(None)
        self._thread.join()

    def _write_all(self) -> None:
        while (episode := self._queue.get()) is not None:
            path = self._folder / episode_filename(episode.info)
            try:
                written = write_rrd(episode, path)
            except (OSError, ValueError, RuntimeError) as error:
                with self._lock:
                    self._problem = f"{path.name} could not be written: {error}"
            else:
                with self._lock:
                    self._written, self._last_file = self._written + 1, str(written)
            self._on_change()
