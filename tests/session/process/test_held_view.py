"""The one view of a background job: changes are counted and told, and a stopped job changes nothing."""

from __future__ import annotations

from dataclasses import dataclass

from workbench.session.process.held_view import HeldView
from workbench.session.process.job_lane import Job, JobLane


@dataclass(frozen=True)
class Told:
    serial: int = 0
    state: str = "none"
    done: int = 0


def test_every_change_is_counted_and_told() -> None:
    told: list[Told] = []
    held = HeldView(Told(), lambda: told.append(held.now))
    held.change(state="running")
    with held.lock:
        held.put(Told(done=3))
    held.changed()
    assert told == [Told(1, "running"), Told(2, "none", 3)]


def test_what_a_stopped_job_says_is_dropped() -> None:
    told: list[Told] = []
    held = HeldView(Told(), lambda: told.append(held.now))
    job = Job(JobLane("test", lambda: None, lambda job, failure: None), "a job", lambda job: None)
    held.update(job, done=1)
    job.stopped = True
    held.update(job, done=2)
    assert told == [Told(1, done=1)]
