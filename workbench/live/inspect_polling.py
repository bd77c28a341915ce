"""Reads the selected env again and again while somebody looks at it: its joints, contacts, observation or state."""

from __future__ import annotations

from dataclasses import replace

from workbench.envs.inspection import Inspection
from workbench.live.effects import Later
from workbench.live.events import Now, ReadingDue, Send, VersionLoaded, WorkerDied
from workbench.live.messages import Inspect, TaskFailed
from workbench.live.run import Change, Run

READ_EVERY = 0.2
"""Minimum seconds between two readings: numbers cannot be read faster."""


def schedule(run: Run, event: object, now: Now) -> Change:
    """Let a reading follow `event`, if it made the last one old and none is on its way."""
    if run.reading != "none" and isinstance(event, Inspection | TaskFailed | VersionLoaded | WorkerDied):
        run = replace(run, reading="none")
    if run.reading != "none" or not run.read_sections or not run.pages or run.task is None:
        return run, []
    if run.read_at == _now(run):
        return run, []
    wait = max(0.0, run.read_when + READ_EVERY - now.monotonic)
    return replace(run, reading="soon"), [Later(wait, ReadingDue())]


def read(run: Run, now: Now) -> Change:
    """Ask the worker for the reading that was scheduled."""
    if run.reading != "soon" or not run.read_sections:
        return replace(run, reading="none"), []
    asked = replace(run, reading="asked", read_at=_now(run), read_when=now.monotonic)
    return asked, [Send(Inspect(run.env, run.read_sections))]


def _now(run: Run) -> object:
    return run.task_serial, run.step_serial, run.env, run.read_sections
