"""The job file: a job is resumed from it, only the same job accepts it, and parts are merged."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest

from workbench.jobs.results_file import JobFile, JobFileError, JobKey, Kept, job_of, read_parts, write_whole
from workbench.jobs.scheduler import ItemQueue, Scheduler, Shard, ThisProcess, Work
from workbench.record.job_worker import RecordOptions
from workbench.task.description import TaskOptions

WHOLE = Shard()
JOB = JobKey("square", {"command": "square", "seeds": "9"}, b"")


def run(
    path: Path,
    shard: Shard = WHOLE,
    job: JobKey = JOB,
    stop_after: int = 99,
    squared: Callable[[int], int] = lambda number: number**2,
    is_there: Callable[[int], bool] = lambda result: True,
) -> tuple[dict[int, int], list[int]]:
    """Run a job that squares nine numbers; returns the results, and the numbers computed in this run."""
    made: list[int] = []
    results: dict[int, int] = {}

    def square(setup: None, queue: ItemQueue) -> None:
        while (chunk := queue.next()) is not None:
            for number in sorted(chunk.wanted):
                if number < queue.limit():
                    made.append(number)
                    queue.send_result(number, squared(number))

    scheduler: Scheduler[int, None] = Scheduler(
        range(9), results.__setitem__, stop=lambda: len(made) >= stop_after, chunk=2
    )
    file = JobFile(path, job)
    try:
        Kept(ThisProcess(), file, shard, is_there).run(
            Work(square, None, int, None, "that squares"), scheduler
        )
    finally:
        file.close()
    return results, made


def test_a_job_is_resumed_after_its_finished_items(tmp_path: Path) -> None:
    _, first = run(tmp_path / "a.job", stop_after=5)
    assert 5 <= len(first) < 9
    results, second = run(tmp_path / "a.job")
    assert sorted(first + second) == list(range(9)) and results == {n: n * n for n in range(9)}
    assert run(tmp_path / "a.job") == (results, [])


def test_merged_parts_equal_the_whole(tmp_path: Path) -> None:
    parts = [tmp_path / f"{index}.job" for index in (1, 2, 3)]
    for index, path in enumerate(parts, 1):
        run(path, Shard(index, 3))
    merged = read_parts(parts)
    assert merged.results(int) == {n: n * n for n in range(9)}
    write_whole(tmp_path / "whole.job", merged)
    assert run(tmp_path / "whole.job") == ({n: n * n for n in range(9)}, [])


def test_another_job_is_refused_with_the_differences(tmp_path: Path) -> None:
    run(tmp_path / "a.job")
    other = replace(JOB, about={"command": "square", "seeds": "10", "rules": "off"})
    with pytest.raises(
        JobFileError, match="seeds is 10 here and 9 there; rules is off here and not given there"
    ):
        JobFile(tmp_path / "a.job", other)
    run(tmp_path / "b.job", job=other)
    with pytest.raises(JobFileError, match="b.job belongs to another job"):
        read_parts([tmp_path / "a.job", tmp_path / "b.job"])


def _text(path: Path) -> None:
    path.write_text("no database")


def _other_database(path: Path) -> None:
    with sqlite3.connect(path) as database:
        database.execute("CREATE TABLE result (number INTEGER)")


def _folder(path: Path) -> None:
    path.mkdir()


@pytest.mark.parametrize("make", [_text, _other_database, _folder])
def test_a_file_that_is_no_job_file_is_refused_and_unchanged(
    make: Callable[[Path], None], tmp_path: Path
) -> None:
    path = tmp_path / "a.job"
    make(path)
    before = path.read_bytes() if path.is_file() else b""
    for use in (lambda: JobFile(path, JOB), lambda: read_parts([path])):
        with pytest.raises((JobFileError, FileNotFoundError), match=r"a\.job"):
            use()
    assert not path.is_file() or path.read_bytes() == before


def test_a_part_given_twice_is_refused_by_its_first_common_item(tmp_path: Path) -> None:
    for index in (1, 2):
        run(tmp_path / f"{index}.job", Shard(index, 2))
    parts = [tmp_path / "1.job", tmp_path / "2.job"]
    assert sorted(read_parts(parts).values) == list(range(9))
    with pytest.raises(JobFileError, match=r"1\.job and .*1\.job both .* item 0"):
        read_parts([*parts, parts[0]])
    with pytest.raises(JobFileError):
        read_parts([])


def test_a_file_that_is_open_in_another_process_is_not_used(tmp_path: Path) -> None:
    file = JobFile(tmp_path / "a.job", JOB)
    file.keep(3, 9)
    for use in (lambda: JobFile(tmp_path / "a.job", JOB), lambda: read_parts([tmp_path / "a.job"])):
        with pytest.raises(JobFileError, match=r"a\.job cannot be used"):
            use()
    file.close()
    again = JobFile(tmp_path / "a.job", JOB)
    assert (again.count, again.run, again.results(int)) == (1, file.run, {3: 9})
    with pytest.raises(JobFileError, match=r"a\.job"):
        again.results(str)
    again.close()
    other = JobFile(tmp_path / "b.job", JOB)
    assert other.run != file.run and other.count == 0
    other.close()


def test_an_item_whose_files_are_gone_runs_again(tmp_path: Path) -> None:
    run(tmp_path / "a.job")
    results, made = run(
        tmp_path / "a.job", squared=lambda number: -1, is_there=lambda square: square not in (4, 49)
    )
    assert made == [2, 7] and results == {n: -1 if n in (2, 7) else n * n for n in range(9)}
    assert read_parts([tmp_path / "a.job"]).results(int) == results, "the new results are kept"


def test_results_of_parts_replace_those_of_the_whole(tmp_path: Path) -> None:
    run(tmp_path / "part.job", Shard(1, 2))
    whole = JobFile(tmp_path / "whole.job", JOB)
    for number in (0, 8):
        whole.keep(number, -1)
    whole.close()
    merged = read_parts([tmp_path / "part.job"])
    write_whole(tmp_path / "whole.job", merged)
    assert read_parts([tmp_path / "whole.job"]).results(int) == {**merged.results(int), 8: -1}
    with pytest.raises(JobFileError, match="part"):
        merged.requested(TaskOptions)
    with pytest.raises(JobFileError):
        merged.results(str)


def test_only_some_of_many_differences_are_named(tmp_path: Path) -> None:
    run(tmp_path / "a.job", job=replace(JOB, about={f"name{k}": "1" for k in range(8)}))
    with pytest.raises(JobFileError) as refused:
        JobFile(tmp_path / "a.job", replace(JOB, about={f"name{k}": "2" for k in range(8)}))
    assert (
        "name4" in str(refused.value) and "name5" not in str(refused.value) and "3 more" in str(refused.value)
    )


# --- which job it is -------------------------------------------------------------------------------------


@dataclass
class Place:
    """A folder with a task and a policy."""

    task: Path
    policy: Path

    def job(self, **other: Any) -> JobKey:
        asked = RecordOptions(
            str(self.task), **{"episodes": 4, "options": TaskOptions(num_envs=2), "out": Path("a"), **other}
        )
        return job_of("record", str(self.task), asked, ("out", "workers"), [self.policy])


@pytest.fixture
def place(tmp_path: Path) -> Place:
    task, policy = tmp_path / "mine.py", tmp_path / "act.npy"
    task.write_text("import beside\n")
    (tmp_path / "beside.py").write_text("A = 1\n")
    policy.write_bytes(b"123")
    return Place(task, policy)


def test_the_same_job_may_run_in_another_folder_with_another_number_of_workers(
    place: Place, tmp_path: Path
) -> None:
    moved = tmp_path / "moved"
    moved.mkdir()
    for name in ("mine.py", "beside.py", "act.npy"):
        (moved / name).write_bytes((tmp_path / name).read_bytes())
    there = Place(moved / "mine.py", moved / "act.npy")
    assert place.job().about == there.job(out=Path("b"), workers=7).about


@pytest.mark.parametrize(
    "other",
    [
        {"episodes": 5},
        {"max_steps": 3},
        {"options": TaskOptions(num_envs=3)},
        {"options": TaskOptions(2, seed=1)},
    ],
)
def test_options_that_affect_the_results_make_another_job(other: dict[str, Any], place: Place) -> None:
    assert place.job(**other).about != place.job().about


@pytest.mark.parametrize("name", ["mine.py", "beside.py", "act.npy"])
def test_changed_texts_of_task_or_policy_make_another_job(name: str, place: Place, tmp_path: Path) -> None:
    before = place.job().about
    (tmp_path / name).write_text("import beside  # changed\n")
    assert place.job().about != before
