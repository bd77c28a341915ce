"""Records episodes while the session runs, on its own thread."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

from workbench.episodes.reader.reading import recover_confined, recovered_text
from workbench.episodes.writing.publish import RecordingError
from workbench.machine.loop import BlockingPool, do, post
from workbench.machine.processes.watched_thread import report_failure
from workbench.record.gather import EpisodeFinisher, EpisodeGatherer, GatheredEpisode
from workbench.record.state import (
    BeginEpisodes,
    EndEpisodes,
    EpisodeEnded,
    EpisodesEnded,
    EpisodesRecovered,
    EpisodeWritten,
    RecordEvent,
    RunningEpisodes,
    StepRecorded,
    TakeStep,
)


class LiveRecorder:
    """Records the episodes of chosen envs. `close` waits until all files are written.

    The loop hands each step to a thread. Encoding a row and writing it to the journal takes a millisecond or
    less, but on a slow disk this would block the loop. So would writing the files of an episode, which takes
    a fraction of a second or more.
    """

    def __init__(
        self,
        folder: Path,
        dispatch: Callable[[RecordEvent], object],
        on_recovered: Callable[[str], None] = lambda message: None,
    ) -> None:
        """
        Args:
            dispatch: called on the loop with the events of the recording.
            on_recovered: called on another thread with a message about unfinished episodes of an earlier session.
        """
        self._folder, self._dispatch, self._on_recovered = folder, dispatch, on_recovered
        self._number = 0
        self._gatherer: EpisodeGatherer | None = None
        """Takes the steps, on the thread of `_aside`."""
        self.finisher = EpisodeFinisher(self._written, self._recover)
        """Makes the files, including those of `PastSaver`."""
        self._aside = BlockingPool("recorder")

    def perform(self, effect: BeginEpisodes | TakeStep | EndEpisodes) -> None:
        """Start the effect; called on the loop."""
        match effect:
            case BeginEpisodes():
                self._end()
                self._number = effect.number
                self._gatherer = EpisodeGatherer(
                    effect.task, effect.env_idx, self._folder, self._ended, one_each=effect.one_each
                )
            case TakeStep():
                if self._gatherer is not None:
                    self._aside.begin(partial(self._take, self._gatherer, self._number, effect))
            case EndEpisodes():
                self._end()

    def _end(self) -> None:
        gatherer, self._gatherer = self._gatherer, None
        if gatherer is not None:
            self._aside.begin(partial(self._finish, gatherer, self._number))

    def close(self) -> None:
        """End the running episodes, and write all files. Must not be called on the loop's thread."""
        do(self._end)
        self._aside.close()
        self.finisher.close()

    # --- on other threads than the loop's --------------------------------------------------------------

    def _post(self, event: RecordEvent) -> None:
        post(partial(self._dispatch, event))

    def _take(self, gatherer: EpisodeGatherer, number: int, what: TakeStep) -> None:
        problem = None
        try:
            gatherer.take(what.stepped)
        except Exception as error:
            # Expected errors: a full disk, an entry of evaluate() that is not a number, a lost step. All others are bugs.
            if not isinstance(error, (RecordingError, ValueError)):
                report_failure("A step could not be recorded", error)
            problem = f"The recording ended: {error}"
        episodes = gatherer.under_way
        under_way = RunningEpisodes(
            len(episodes),
            sum(episode.steps for episode in episodes),
            sum(episode.writer.bytes_written for episode in episodes),
        )
        self._post(StepRecorded(number, what.bytes, gatherer.env_idx, under_way, problem))

    def _finish(self, gatherer: EpisodeGatherer, number: int) -> None:
        gatherer.finish()
        self._post(EpisodesEnded(number))

    def _ended(self, episode: GatheredEpisode) -> None:
        self._post(EpisodeEnded(live=True))
        self.finisher.finish(episode)

    def _written(self) -> None:
        self._post(EpisodeWritten(self.finisher.finished))

    def _recover(self) -> None:
        """Recover episodes that an earlier server left unfinished; runs first on the finisher's thread."""
        if not self._folder.is_dir():
            return
        recovered: tuple[str, ...] = ()
        problem = None
        try:
            recovered = tuple(str(file) for file in recover_confined(self._folder))
            message = recovered_text(recovered)
        except RecordingError as error:
            message = problem = f"An earlier, unfinished recording could not be recovered: {error}"
        self._post(EpisodesRecovered(recovered, problem))
        if message:
            self._on_recovered(message)
