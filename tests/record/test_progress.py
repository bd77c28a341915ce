"""The progress and the options of a recording, without an env."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from workbench.envs.gpu_rules import Finding
from workbench.jobs.scheduler import Failure, Scheduler
from workbench.record.job import WorkerUpdates, chunk_of, collect
from workbench.record.job_worker import (
    BatchProgress,
    RecordOptions,
    RecordUpdate,
    Written,
    episode_id,
    with_given_actions,
)
from workbench.task.description import TaskOptions
from workbench.task.problem import Problem

PROBLEM = Problem("step", "KeyError: 'goal'", "push.py", 31, "x", "")
PLAIN = RecordOptions("Push-v1", Path("out"))


def test_running_episodes_of_all_workers_count_in_part_until_they_are_over() -> None:
    told: dict[str, list[Any]] = {"activity": [], "finding": [], "notice": []}
    updates = WorkerUpdates(*(told[name].append for name in told))
    scheduler: Scheduler[Any, Any] = Scheduler(range(6), lambda *_: None, lambda _: None)
    finding = Finding("reward-changes", "warn", "a message", "push.py", 24, "code", "evaluate", 1, 1)
    for _ in range(2):
        assert not updates.take(RecordUpdate("opening", finding=finding, notice="no reward"))
    assert told == {"activity": ["opening"] * 2, "finding": [finding], "notice": ["no reward"]}
    assert updates.take(RecordUpdate(underway=BatchProgress(((0, 10), (2, 30)), 40, 12)))
    assert updates.take(RecordUpdate(underway=BatchProgress(((2, 50), (3, 20)), 40, 5)))
    progress = updates.progress(1, None, scheduler, True)
    assert (progress.steps, progress.limit, progress.kept) == (17, 40, 1)
    assert progress.running == {0: 10, 2: 50, 3: 20} and progress.by_seed(7) == {7: 10, 9: 50, 10: 20}
    assert progress.done == pytest.approx(1 + 0.25 + 1.0 + 0.5)
    assert updates.progress(1, None, scheduler, False).done == 1
    updates.over(0)
    failure = Failure((2,), PROBLEM)
    updates.failed(failure)
    progress = updates.progress(2, (0, None), scheduler, True)
    assert (progress.running, progress.failures, progress.over) == ({3: 20}, (failure,), (0, None))
    scheduler.lower(3)
    assert updates.progress(2, None, scheduler, True).running == {}, "its result is no longer wanted"


def written(number: int, success: bool = True, corrected: bool = False) -> Written:
    return Written(number, Path(f"/elsewhere/{number}.rrd"), number, 9, 1.5, success, corrected)


def test_results_are_ordered_and_counted(tmp_path: Path) -> None:
    what = replace(PLAIN, out=tmp_path, episodes=5)
    known = {3: written(3, corrected=True), 0: written(0), 1: None, 2: written(2, corrected=True)}
    found = collect(what, known)
    assert [(one.index, one.path) for one in found.written] == [(n, tmp_path / f"{n}.rrd") for n in (0, 2, 3)]
    assert (found.tried, found.missing, found.start_corrected, found.stopped) == (4, 1, 2, False)


@pytest.mark.parametrize(
    "given",
    [
        {"episodes": 0},
        {"episodes": 2, "successes": 2},
        {"successes": 0},
        {"successes": 1, "tries": 0},
        {"workers": 0},
        {"max_steps": 0},
        {"seconds_per_seed": 0.0},
        {"seconds_per_seed": float("inf")},
        {"seconds_per_seed": float("nan")},
        {"use_env_states": True},
    ],
)
def test_numbers_that_make_no_sense_are_refused(given: dict[str, Any]) -> None:
    with pytest.raises(ValueError):
        with_given_actions(replace(PLAIN, **given))


def test_options_are_completed() -> None:
    for given, wanted in (
        ({}, (4, None)),
        ({"episodes": 7}, (7, None)),
        ({"successes": 3}, (None, 300)),
        ({"successes": 3, "tries": 8}, (None, 8)),
    ):
        what, runs = with_given_actions(replace(PLAIN, **given))
        assert ((what.episodes, what.tries if what.successes else None), len(runs)) == (wanted, 0)
    options = TaskOptions(2, env_kwargs={"robot_uids": "panda"})
    what, _ = with_given_actions(replace(PLAIN, fast_pictures=True, options=options))
    assert (what.options.pictures, what.options.num_envs) == ("fast", 2)
    assert what.options.env_kwargs == {"robot_uids": "panda"}
    assert with_given_actions(PLAIN)[0].options.pictures == PLAIN.options.pictures


def test_a_chunk_is_a_batch_or_some_in_a_long_job_and_ids_are_those_of_the_job() -> None:
    assert chunk_of(100, 4) == 4 == chunk_of(1023, 4)
    assert chunk_of(1024, 4) > 4 and chunk_of(1024, 4) % 4 == 0
    ids = {episode_id(run, number) for run in ("a", "b") for number in range(3)}
    assert len(ids) == 6 and episode_id("a", 1) == episode_id("a", 1) and all(one.isalnum() for one in ids)
