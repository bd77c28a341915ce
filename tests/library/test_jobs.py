"""Progress of jobs that record into a folder, shown in the library of that folder."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.drive.waiting import until
from tests.episodes.library_files import describe
from workbench.cli.arguments import JobArguments
from workbench.cli.run_by import status_in_folder
from workbench.library.folder import Library
from workbench.library.job_status import SILENT_SECONDS, JobFailure, JobStatus, StatusFile, read_jobs
from workbench.library.rows import job_text
from workbench.page.widgets.templates import render
from workbench.record.job import RecordProgress

RUNS = JobStatus("record", "my_task.py", 40, 100, rate=2.0)


def test_a_job_is_listed_while_it_runs_and_for_an_hour_after(tmp_path: Path) -> None:
    now = 1e9
    file = StatusFile(tmp_path, lambda: now)
    file.write(RUNS)
    (status,) = read_jobs(tmp_path, now + 1)
    assert (status.done, status.total, status.seconds_left) == (40, 100, 30.0)
    assert job_text(status, now + 1) == ", 2.0 a second, 30 s left"
    assert status.is_silent(now + SILENT_SECONDS + 1)
    file.write(JobStatus("record", "my_task.py", 100, 100, state="done"))
    assert [one.state for one in read_jobs(tmp_path, now + 60)] == ["done"]
    assert read_jobs(tmp_path, now + 3601) == ()
    assert len(list(tmp_path.iterdir())) == 1


def test_the_rate_of_a_resumed_job_counts_only_this_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = SimpleNamespace(monotonic=lambda: now)
    monkeypatch.setattr("workbench.cli.run_by.time", clock)
    with status_in_folder(JobArguments(), "record", "my_task.py", tmp_path, 100, str) as status_file:
        report = status_file.with_status(lambda progress: None)
        now = 50.0
        report(RecordProgress(80, 0, done=80.0, was_there=True))
        now = 55.0
        report(RecordProgress(90, 0, done=90.0))
        status_file.end("stopped")
    (status,) = read_jobs(tmp_path, time.time())
    assert (status.done, status.rate) == (90, 2.0)


def test_jobs_of_subfolders_are_listed_with_their_path(tmp_path: Path, child_process: None) -> None:
    below = tmp_path / "parts" / "1"
    below.mkdir(parents=True)
    describe(below, "one", id="one")
    StatusFile(below).write(RUNS)
    library = Library(tmp_path)
    library.watch()
    try:
        until(lambda: library.view().jobs, "the job")
        (job,) = library.view().jobs
        assert job.place == "parts/1"
        shown = render("library_jobs", jobs=[{"of": job, "how": "", "runs": True}])
        assert "my_task.py into parts/1/" in shown
    finally:
        library.close()


def test_a_resumed_job_replaces_only_its_own_last_status(tmp_path: Path) -> None:
    now = time.time()
    for status in (
        replace(RUNS, state="stopped"),
        replace(RUNS, part="1/2", state="done"),
        replace(RUNS, task="other.py", state="done"),
        RUNS,
    ):
        StatusFile(tmp_path, lambda: now).write(status)
    StatusFile(tmp_path, lambda: now).remove_old(RUNS)
    left = {(one.task, one.part, one.state) for one in read_jobs(tmp_path, now)}
    assert left == {
        ("my_task.py", "1/2", "done"),
        ("other.py", "", "done"),
        ("my_task.py", "", "running"),
    }, "another job may still run"


@given(content=st.binary(max_size=200) | st.builds(lambda value: msgspec.json.encode(value), st.dictionaries(
    st.sampled_from(["command", "task", "done", "total", "state", "failures", "written_at", "rate"]),
    st.none() | st.integers() | st.text() | st.floats(allow_nan=False, allow_infinity=False) | st.lists(st.integers()),
)))  # fmt: skip
def test_any_other_file_is_ignored_or_read_as_data(content: bytes) -> None:
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / ".job-0.status").write_bytes(content)
        for status in read_jobs(Path(folder), time.time()):
            assert isinstance(status, JobStatus)


def test_the_content_of_a_status_is_shown_as_text(tmp_path: Path) -> None:
    bad = "<script>alert(1)</script>"
    failure = JobFailure(bad, 2, bad, f"  {bad}\n\x1b[31m")
    StatusFile(tmp_path).write(JobStatus(bad, bad, 1, 2, failures=(failure,)))
    jobs = [
        {"of": job, "how": job_text(job, job.written_at), "runs": True}
        for job in read_jobs(tmp_path, time.time())
    ]
    shown = render("library_jobs", jobs=jobs)
    assert "<script" not in shown and "&lt;script&gt;" in shown and "\x1b" not in shown
    assert "2 failed" in shown


def test_jobs_are_listed_newest_first_and_each_is_due_once_a_second(tmp_path: Path) -> None:
    now = 1e9
    files = [StatusFile(tmp_path, lambda: now) for _ in range(3)]
    for at, file in enumerate(files):
        now = 1e9 + at
        assert file.is_due()
        file.write(replace(RUNS, done=at))
        assert not file.is_due()
        file.write(replace(RUNS, done=99))
    now += 0.99
    assert [file.is_due() for file in files] == [True, True, False]
    assert [one.done for one in read_jobs(tmp_path, now)] == [2, 1, 0]
    assert read_jobs(tmp_path, 1e9 - 60) == (), "a time to come is no time"
    (tmp_path / "sub").mkdir()
    StatusFile(tmp_path / "sub", lambda: now).write(replace(RUNS, done=7))
    jobs = read_jobs(tmp_path, now, [tmp_path / "sub", tmp_path])
    assert [(one.done, one.place) for one in jobs] == [(7, "sub"), (2, ""), (1, ""), (0, "")]
    StatusFile(tmp_path / "absent", lambda: now).write(RUNS)
    assert not (tmp_path / "absent").exists()
