"""Polls the joints, contacts, observation or state of the selected env while a page inspects them."""

from __future__ import annotations

from dataclasses import replace

from workbench.envs.inspection import Inspection
from workbench.live.effects import Later
from workbench.live.events import Now, ReadingDue, Send, VersionLoaded, WorkerDied
from workbench.live.messages import Inspect, TaskFailed
from workbench.live.run import Change, Run

READ_PERIOD_SECONDS = 0.2
"""Minimum interval of readings: a person cannot read numbers faster."""


def schedule(run: Run, event: object, now: Now) -> Change:
    """Schedule a reading if `event` made the last reading outdated and no reading is pending."""
    if run.reading != "none" and isinstance(event, Inspection | TaskFailed | VersionLoaded | WorkerDied):
        run = replace(run, reading="none")
    if run.reading != "none" or not _wanted(run) or not run.pages or run.task is None:
        return run, []
    if run.read_at == _now(run):
        return run, []
    wait = max(0.0, run.read_when + READ_PERIOD_SECONDS - now.monotonic)
    return replace(run, reading="soon"), [Later(wait, ReadingDue())]


def read(run: Run, now: Now) -> Change:
    """Request the scheduled reading from the worker."""
    if run.reading != "soon" or not _wanted(run):
        return replace(run, reading="none"), []
    asked = replace(run, reading="asked", read_at=_now(run), read_when=now.monotonic)
    return asked, [Send(Inspect(run.env, run.read_sections, run.read_body))]


def _wanted(run: Run) -> bool:
    return bool(run.read_sections or run.read_body)


def _now(run: Run) -> object:
    return run.task_serial, run.step_serial, run.env, run.read_sections, run.read_body
