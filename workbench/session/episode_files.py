"""The files of episodes that are over, made one after the other on a thread of their own."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace

from workbench.machine.watched_thread import say_failure
from workbench.recording.episode_writer import EpisodeFiles
from workbench.recording.landing import RecordingError
from workbench.session.episodes import GatheredEpisode


@dataclass(frozen=True)
class Finished:
    """What came of them so far."""

    count: int = 0
    bytes_written: int = 0
    last: EpisodeFiles | None = None
    problem: str | None = None
    """Why the last one that failed did."""


class EpisodeFinisher:
    """See the module's text. Thread-safe."""

    def __init__(
        self, on_change: Callable[[], None] = lambda: None, first: Callable[[], None] | None = None
    ) -> None:
        """
        Args:
            on_change: called on the thread when an episode has its files, or cannot have them.
            first: called on the thread before all else.
        """
        self._on_change = on_change
        self._lock = threading.Lock()
        self._finished = Finished()
        self._waiting = 0
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="episode-files")
        if first is not None:
            self._pool.submit(first)

    @property
    def finished(self) -> Finished:
        with self._lock:
            return self._finished

    @property
    def waiting(self) -> int:
        """Episodes whose files are not there yet."""
        with self._lock:
            return self._waiting

    def finish(self, episode: GatheredEpisode) -> Future[EpisodeFiles | str]:
        """Make its files; the result says why where that failed. `finished` does too, until another one succeeds."""
        with self._lock:
            self._waiting += 1
        return self._pool.submit(self._finish, episode)

    def close(self) -> None:
        """Wait for what is under way."""
        self._pool.shutdown(wait=True)

    def _finish(self, episode: GatheredEpisode) -> EpisodeFiles | str:
        size = 0
        made: EpisodeFiles | str
        try:
            made = episode.writer.finish()
            size = sum(path.stat().st_size for path in (made.rrd, made.h5, made.json))
        except Exception as error:
            # Its journal stays, and the next start tries again.
            if not isinstance(error, (RecordingError, OSError, ValueError)):
                say_failure(f"An episode of env {episode.env} could not be written", error)
            made = f"an episode of env {episode.env} could not be written: {error}"
        with self._lock:
            self._waiting -= 1
            now = self._finished
            if isinstance(made, str):
                self._finished = replace(now, problem=made)
            else:
                self._finished = Finished(now.count + 1, now.bytes_written + size, made, None)
        self._on_change()
        return made
