"""The step profile of the running version, with a scripted background process."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any

import pytest

from tests.drive.scenes import problem
from tests.drive.session import FakeWorkerSession, work_with
from tests.drive.waiting import until
from workbench.checks.commands import StopProfile, TimeStep
from workbench.checks.profile import ProfileView
from workbench.checks.results import HookTime, StepProfile
from workbench.live.process.background_jobs import JobFailed
from workbench.page.command import Refused

PROFILE = StepProfile(3, 20, 1.0, (HookTime("evaluate", 1.0, 1.0),), ())


class Timer:
    """Returns the profile, or fails, once `let` is set."""

    def __init__(self) -> None:
        self.let = False
        self.fails: JobFailed | None = None

    async def ensure(self, *load: Any, **more: Any) -> int:
        return 1

    async def in_turns(self, job: object, work: Callable[[], Awaitable[Any]]) -> Any:
        return await work()

    async def ask(self, question: object) -> StepProfile:
        while not self.let:
            await asyncio.sleep(0.005)
        if self.fails is not None:
            raise self.fails
        return PROFILE


@pytest.fixture
def timer(fake: FakeWorkerSession) -> Timer:
    timer = Timer()
    work_with(fake.session, timer)
    return timer


def test_a_step_is_timed_and_its_profile_is_stale_once_another_version_runs(
    fake: FakeWorkerSession, timer: Timer
) -> None:
    with pytest.raises(Refused):
        fake.session.do(TimeStep())
    fake.load()
    fake.session.do(TimeStep())
    assert fake.view.of(ProfileView).state == "running"
    timer.let = True
    until(lambda: fake.view.of(ProfileView).state == "done", "the profile")
    assert fake.view.of(ProfileView).profile == PROFILE and not fake.view.of(ProfileView).stale
    fake.load("patched")
    assert fake.view.of(ProfileView).profile == PROFILE and fake.view.of(ProfileView).stale


def test_a_load_and_the_stop_button_end_a_profile(fake: FakeWorkerSession, timer: Timer) -> None:
    fake.load()
    for end in (lambda: fake.load("patched"), lambda: fake.session.do(StopProfile())):
        fake.session.do(TimeStep())
        end()
        assert fake.view.of(ProfileView).state == "stopped" and fake.view.of(ProfileView).profile is None
    timer.let = True
    fake.session.do(TimeStep())
    until(lambda: fake.view.of(ProfileView).state == "done", "the profile after a stop")


def test_an_error_of_the_task_is_shown(fake: FakeWorkerSession, timer: Timer) -> None:
    fake.load()
    timer.let, timer.fails = True, JobFailed("it cannot be timed", problem())
    fake.session.do(TimeStep())
    until(lambda: fake.view.of(ProfileView).state == "failed", "the failure")
    assert fake.view.of(ProfileView).problem == problem() and fake.view.of(ProfileView).why
    # The next one does not show the old error.
    timer.let, timer.fails = False, None
    fake.session.do(TimeStep())
    view = fake.view.of(ProfileView)
    assert (view.state, view.problem, view.why) == ("running", None, "")
    timer.let = True
    until(lambda: fake.view.of(ProfileView).state == "done", "the profile")
