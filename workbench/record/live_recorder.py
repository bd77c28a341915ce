"""Records episodes while the session runs, on a thread of its own."""

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
    EpisodesRecovered,
    EpisodeWritten,
    RecordEvent,
    RunningEpisodes,
    StepRecorded,
    TakeStep,
)


class LiveRecorder:
    """Records chosen envs. `close` waits until all files are written.

    The loop only passes the steps on: a row takes a millisecond or less to encode and write to the journal, but a disk may
    be slow, and the files of an episode take a fraction of a second or more.
    """

    def __init__(
        self,
        folder: Path,
        happen: Callable[[RecordEvent], object],
        on_recovered: Callable[[str], None] = lambda message: None,
    ) -> None:
        """
        Args:
            happen: takes what comes of the recording; called on the loop.
            on_recovered: called with a message about unfinished episodes of an earlier session, from a thread of its own.
        """
        self._folder, self._happen, self._on_recovered = folder, happen, on_recovered
        self._number = 0
        self._gatherer: EpisodeGatherer | None = None
        """Takes the steps, on the thread of `_aside`."""
        self.finisher = EpisodeFinisher(self._written, self._recover)
        """Makes the files, including those of `PastSaver`."""
        self._aside = BlockingPool("recorder")

    def perform(self, effect: BeginEpisodes | TakeStep | EndEpisodes) -> None:
        """Begin it; called on the loop."""
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
            self._aside.begin(gatherer.finish)

    def close(self) -> None:
        """End the running episodes, and write all files. Called on another thread than the loop."""
        do(self._end)
        self._aside.close()
        self.finisher.close()

    # --- beside the loop -------------------------------------------------------------------------------

    def _post(self, event: RecordEvent) -> None:
        post(partial(self._happen, event))

    def _take(self, gatherer: EpisodeGatherer, number: int, what: TakeStep) -> None:
        problem = None
        try:
            gatherer.take(what.stepped)
        except Exception as error:
            # Expected: a full disk, an entry of evaluate() that is no number, a lost step. All else is our own fault.
            if not isinstance(error, (RecordingError, ValueError)):
                report_failure("A step could not be recorded", error)
            problem = f"the recording ended: {error}"
        episodes = gatherer.under_way
        under_way = RunningEpisodes(
            len(episodes),
            sum(episode.steps for episode in episodes),
            sum(episode.writer.bytes_written for episode in episodes),
        )
        self._post(StepRecorded(number, what.bytes, gatherer.env_idx, under_way, problem))

    def _ended(self, episode: GatheredEpisode) -> None:
        self._post(EpisodeEnded(live=True))
        self.finisher.finish(episode)

    def _written(self) -> None:
        self._post(EpisodeWritten(self.finisher.finished))

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
        self._post(EpisodesRecovered(recovered, problem))
        if message:
            self._on_recovered(message)
