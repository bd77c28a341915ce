"""Runs ``workbench record``: prints a progress bar (or, outside a terminal, lines of progress), then the
episodes. Ctrl-C keeps finished episodes."""

from __future__ import annotations

import shlex
import signal
import time
from collections.abc import Callable
from pathlib import Path
from types import FrameType

from rich.markup import escape
from rich.progress import MofNCompleteColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.progress import Progress as Bar

from workbench.actions.choose import SOLVE, needed_by
from workbench.cli.arguments import ONE_WORKER, JobArguments
from workbench.cli.output import (
    Exit,
    err,
    interrupted,
    print_failures,
    print_finding,
    print_text,
    progress_bar,
    refuse,
    warn,
)
from workbench.cli.run_by import (
    EPISODES_KEPT,
    JOB_ENDS,
    exit_after,
    is_recorded,
    items_of,
    print_part,
    run_by,
    status_in_folder,
)
from workbench.envs.backends import unused_gpu_text
from workbench.episodes.reader.reading import recover_confined
from workbench.episodes.writing.publish import try_folder
from workbench.episodes.writing.upload import require_place
from workbench.jobs.results_file import JobKey, job_of
from workbench.machine.text import rate_text
from workbench.planning.seeds_report import underway_text
from workbench.record.job import Recorded, RecordProgress, chunk_of, record
from workbench.record.job_worker import RecordOptions, Written, with_given_actions
from workbench.rescore.recording_jobs import hidden_modules_text


class RecordBar:
    """Progress bar that handles Ctrl-C: the first Ctrl-C stops after the current step. A second Ctrl-C, or a
    first one before any episode has begun, stops at once."""

    def __init__(
        self,
        bar: Bar,
        total: int | None,
        doing: str = "recording",
        first_seed: int | None = None,
        named: Callable[[int], str] = lambda number: f"episode {number}",
    ) -> None:
        """
        Args:
            total: number of requested episodes, if known.
            doing: text of the bar while episodes run.
            first_seed: seed of the first episode if actions are planned. A planned control step takes long,
                so the bar then shows the current step of each seed.
            named: returns the name of an episode; called only if `first_seed` is None.
        """
        self._doing, self._first_seed, self._named = doing, first_seed, named
        self._bar, self._row = bar, bar.add_task("opening", total=total)
        self._total = total
        self.stop_requested = False
        self._began: float | None = None
        """Time when the first episode began."""
        self._last_printed = time.monotonic()
        """Time when something other than the bar was last printed."""

    def __enter__(self) -> RecordBar:
        self._before = signal.signal(signal.SIGINT, self._on_signal)
        return self

    def __exit__(self, *error: object) -> None:
        signal.signal(signal.SIGINT, self._before)

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        if self.stop_requested or self._began is None:
            raise KeyboardInterrupt
        self.stop_requested = True
        # A step may hang, so a second Ctrl-C stops at once.
        self.describe("stopping after this step; Ctrl-C again stops at once")

    def describe(self, text: str, kept: int | None = None) -> None:
        self._bar.update(self._row, description=text, completed=kept)

    def _print_progress(self, line: str) -> None:
        """Print a progress line if stderr is not a terminal: in a file the bar is drawn only once, at the
        end, so a log would be silent for hours."""
        if not err.is_terminal:
            self._last_printed = time.monotonic()
            err.print(escape(line), soft_wrap=True)

    def show(self, now: RecordProgress) -> None:
        if now.was_there:
            # Without the reset, the remaining time would be estimated from the speed of reading finished episodes.
            self._bar.reset(self._row, total=self._total, completed=int(now.done))
            return
        self._began = self._began or time.monotonic()
        seconds = max(time.monotonic() - self._began, 1e-3)
        self._bar.update(self._row, completed=now.done)
        if not self.stop_requested:
            rate = f"{rate_text(now.steps / seconds)} steps per second"
            at = "" if self._first_seed is None else underway_text(now.by_seed(self._first_seed), now.limit)
            failed = sum(len(failure.numbers) for failure in now.failures)
            doing = f"{self._doing}, {at or rate}" + (f", {failed} failed" if failed else "")
            self.describe(doing)
            if time.monotonic() - self._last_printed > _LOG_SECONDS:
                self._print_progress(doing)
        if now.over is not None:
            number, kept = now.over
            named = self._named(number) if self._first_seed is None else f"seed {self._first_seed + number}"
            self._print_progress(f"{named}: {_ended_text(kept)}, {now.kept} of {self._total} kept")


_LOG_SECONDS = 30.0
"""Interval between progress lines in a log."""


def _ended_text(kept: Written | None) -> str:
    if kept is None:
        return "not kept"
    return ", ".join((f"{kept.steps} steps", *_outcome_texts(kept)))


def _outcome_texts(kept: Written) -> tuple[str, ...]:
    """Texts of return and success, if the task has them."""
    earned = "no reward" if kept.total_reward is None else f"return {kept.total_reward:.3f}"
    return (earned, *{None: (), True: ("success",), False: ("no success",)}[kept.success])


def record_in_terminal(what: RecordOptions, run: JobArguments = ONE_WORKER) -> int:
    """Record and print the result; returns the exit code."""
    before = set(what.out.glob("*.json"))
    try:
        if what.upload:
            require_place(what.upload)
        else:
            try_folder(what.out)
        requested, _ = with_given_actions(what)
        if recovered := recover_confined(what.out):
            err.print(f"recovered {_episodes(len(recovered))} that an earlier recording left unfinished")
        # Warn before the task is opened. A module next to the task's file cannot be imported if a library has
        # the same name, and the error of the import does not say so.
        hidden = hidden_modules_text(what.task)
        for notice in hidden:
            warn(notice)
        if (left_alone := unused_gpu_text(what.options.backend)) is not None:
            warn(left_alone)
        if run.shard is not None and requested.successes is not None:
            raise ValueError(
                "--shard divides episodes, but --successes does not fix their number: give --episodes"
            )
        most = requested.tries if requested.successes is not None else requested.episodes
        assert most is not None
        chunk = chunk_of(most, what.options.num_envs)
        wanted = requested.successes or items_of(run, most, chunk)
        left = (TextColumn("left"), TimeRemainingColumn())
        with (
            run_by(
                run, "record", -(-most // chunk), lambda: job_of_record(requested), is_recorded(what.out)
            ) as (executor, name),
            progress_bar(MofNCompleteColumn(), TimeElapsedColumn(), *left) as bar,
            status_in_folder(
                run, "record", what.task, None if what.upload else what.out, wanted, _named
            ) as status,
        ):
            first_seed = what.options.seed if what.actions == SOLVE else None
            with RecordBar(bar, wanted, first_seed=first_seed) as record_bar:
                recorded = record(
                    what,
                    record_bar.describe,
                    status.with_status(record_bar.show),
                    lambda: record_bar.stop_requested,
                    print_finding,
                    executor,
                    name,
                    lambda notice: None if notice in hidden else warn(notice),
                )
            record_bar.describe("recorded", len(recorded.written))
            status.end("stopped" if recorded.stopped else "done")
    except JOB_ENDS as error:
        code = exit_after(error)
        if not isinstance(error, KeyboardInterrupt):
            _print_kept(what, before)
        return code
    code = print_recorded(requested, recorded)
    print_part(run, "record", recorded.stopped)
    return code


def job_of_record(requested: RecordOptions) -> JobKey:
    """Key of the job file of this recording. Raises OSError."""
    files = needed_by(requested.task, requested.actions).files
    return job_of("record", requested.task, requested, ("out", "workers", "upload"), files)


def _print_kept(requested: RecordOptions, before: set[Path]) -> None:
    kept = len(set(requested.out.glob("*.json")) - before)
    if kept:
        folder = shlex.quote(str(requested.out))
        print_text(
            f"{_episodes(kept)} that had finished {'is' if kept == 1 else 'are'} kept: workbench review {folder}"
        )


def print_recorded(requested: RecordOptions, recorded: Recorded) -> int:
    """Print the episodes and the result of the request; returns the exit code."""
    for episode in recorded.written:
        print_text("  ".join((episode.shown, f"{episode.steps} steps", *_outcome_texts(episode))))
    kept = len(recorded.written)
    if requested.successes is not None:
        print_text(f"{kept} of {recorded.tried} episodes succeeded and were kept.")
    if recorded.start_corrected:
        count = _episodes(recorded.start_corrected)
        print_text(
            f"{count} did not start in the recorded state after a reset with the recorded seed, and got that "
            "state."
        )
    if recorded.written and not recorded.written[0].address:
        folder = shlex.quote(str(recorded.written[0].path.parent))
        print_text(f"Look at them with: workbench review {folder}")
    if recorded.failures:
        print_failures(recorded.failures, _named)
        without = sum(len(failure.numbers) for failure in recorded.failures)
        err.print(f"{_episodes(kept)} recorded, {without} without a result", soft_wrap=True)
    if recorded.stopped:
        return interrupted(EPISODES_KEPT)
    if recorded.failures:
        return Exit.FAILED
    if requested.successes is not None and kept < requested.successes:
        wanted = "1 success was" if requested.successes == 1 else f"{requested.successes} successes were"
        return refuse(f"{wanted} requested; given up after {_episodes(recorded.tried)}")
    return 0


def _named(number: int) -> str:
    return f"episode {number}"


def _episodes(count: int) -> str:
    return f"{count} episode{'' if count == 1 else 's'}"
