"""The step profile of the running version, with a scripted background process."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any

import pytest

from tests.drive.scenes import problem
from tests.drive.session import Told, work_with
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
def timer(told: Told) -> Timer:
    timer = Timer()
    work_with(told.session, timer)
    return timer


def test_a_step_is_timed_and_its_profile_is_stale_once_another_version_runs(told: Told, timer: Timer) -> None:
    with pytest.raises(Refused):
        told.session.do(TimeStep())
    told.load()
    told.session.do(TimeStep())
    assert told.view.of(ProfileView).state == "running"
    timer.let = True
    until(lambda: told.view.of(ProfileView).state == "done", "the profile")
    assert told.view.of(ProfileView).profile == PROFILE and not told.view.of(ProfileView).stale
    told.load("patched")
    assert told.view.of(ProfileView).profile == PROFILE and told.view.of(ProfileView).stale


def test_a_load_and_the_stop_button_end_a_profile(told: Told, timer: Timer) -> None:
    told.load()
    for end in (lambda: told.load("patched"), lambda: told.session.do(StopProfile())):
        told.session.do(TimeStep())
        end()
        assert told.view.of(ProfileView).state == "stopped"


def test_an_error_of_the_task_is_shown(told: Told, timer: Timer) -> None:
    told.load()
    timer.let, timer.fails = True, JobFailed("it cannot be timed", problem())
    told.session.do(TimeStep())
    until(lambda: told.view.of(ProfileView).state == "failed", "the failure")
    assert told.view.of(ProfileView).problem == problem()
