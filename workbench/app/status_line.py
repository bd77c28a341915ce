"""The status line in the bar."""

from __future__ import annotations

import math
import time
from typing import Literal

import viser

from workbench.live.panels.banners import phase_of
from workbench.live.panels.moment import MomentPart
from workbench.live.panels.timeline_panel import ago_in_words
from workbench.live.panels.version_panel import took
from workbench.live.process.heartbeat import Busy
from workbench.live.timeline_commands import ContinueFromHere
from workbench.live.view import SessionView
from workbench.machine.text import rate_text
from workbench.page.widgets.keys_and_palette import with_key
from workbench.page.widgets.parts import Clock
from workbench.page.widgets.templates import counted, place, render
from workbench.record.panel import SAVE
from workbench.record.state import RecordingStatus
from workbench.solve.state import SolveView
from workbench.task.description import TaskDescription

NEW_VERSION_SECONDS = 6.0
"""Time for which a new version is announced."""

STATE_WORDS = {
    "starting": "starting",
    "loading": "loading",
    "running": "running",
    "paused": "paused",
    "error": "not loaded",
    "stopped": "worker stopped",
    "busy": "busy",
    "held": "held",
    "awaited": "waiting",
    "planning": "planning",
}


class StatusLine(MomentPart):
    """State, speed, activity and task of the session."""

    def __init__(self, server: viser.ViserServer, clock: Clock = time.monotonic) -> None:
        self._handle = server.gui.add_html("")
        self._clock = clock
        self._task_serial = 0
        self._loaded_at = -math.inf

    def urgent(self, view: SessionView) -> object:
        busy = view.busy and (view.busy.doing, f"{view.busy.seconds:.0f}")
        return (
            super().urgent(view),
            busy,
            view.stale,
            view.activity,
            self._is_fresh(view),
            view.problem_serial,
        )

    def _is_fresh(self, view: SessionView) -> bool:
        """Whether a new version was loaded less than `NEW_VERSION_SECONDS` ago."""
        if view.task_serial != self._task_serial:
            # The first version is not announced.
            self._loaded_at = self._clock() if self._task_serial else -math.inf
            self._task_serial = view.task_serial
        return self._clock() - self._loaded_at < NEW_VERSION_SECONDS

    def draw(self, view: SessionView) -> None:
        self._handle.content = render("status_line", **status_values(view, self._is_fresh(view)))


def status_values(view: SessionView, fresh: bool = False) -> dict[str, object]:
    """The values for the template of the status line.

    Args:
        fresh: whether a new version has just been loaded.
    """
    task = view.task
    # While the renderer works, the session's activity is more specific than "busy".
    busy = None if view.busy is not None and view.busy.drawing and view.activity else view.busy
    moving = view.playing and view.state == "running" and task is not None and busy is None
    # Planning takes most of the time, so a rate of steps would mean nothing.
    planning = moving and view.settings.action_source == "solve"
    starting = planning and view.of(SolveView).state == "starting"
    known = view.steps_per_second > 0  # the rate is known from the second step on
    slow = (
        known and view.real_time_factor < 0.85 * view.settings.speed and view.settings.speed != float("inf")
    )
    return {
        "view": view,
        "state": view.state if busy is None else "loading",
        "word": STATE_WORDS["planning" if planning else _state(view, busy)],
        "stale": view.stale and task is not None and view.state not in ("starting", "loading"),
        "activity": (view.of(SolveView).activity if starting else view.activity)
        if busy is None
        else _doing(busy, phase_of(busy, view)),
        "news": _news(view) if fresh else _pause(view),
        "ago": ago_in_words(view.timeline),
        "can_continue": ContinueFromHere() if view.timeline.can_continue else None,
        "continue_hint": with_key(ContinueFromHere),
        "moving": moving and known and not planning,
        "plan": view.of(SolveView).plan if planning and not starting else None,
        "behind": moving and slow,
        "why_slow": slowed_by(view) if moving and slow else None,
        "recording": _recording(view.of(RecordingStatus)),
        "robot": "" if task is None else robot_text(task),
    }


def _recording(recording: RecordingStatus) -> Literal["", "waits", "on"]:
    """``on`` if steps are recorded, ``waits`` if all envs to record wait for their next reset; empty without
    a recording."""
    if not recording.active:
        return ""
    return "waits" if recording.waiting == len(recording.env_idx) else "on"


def robot_text(task: TaskDescription) -> str:
    """Robot, control mode and width of the action of one env."""
    count = len(task.actions)
    parts = (
        task.made.robot or "no robot",
        task.control_mode or "",
        counted(count, "action") if count else "",
    )
    return " · ".join(part for part in parts if part)


MIN_SLOWING_SHARE = 0.3
"""Minimum share of the time at which recording or rendering is named as the cause of slow playing."""


def slowed_by(view: SessionView) -> tuple[str, str] | None:
    """Why playing is slow: because of recording, or because of rendering for the page. Returns (short text,
    full text); None if each of them takes less than `MIN_SLOWING_SHARE` of the time."""
    task, recorded, watched = view.task, view.recorded_share, view.watched_share
    if task is None or max(recorded, watched) < MIN_SLOWING_SHARE:
        return None
    rate = f"{rate_text(view.steps_per_second)} steps a second"
    if recorded >= watched:
        cameras = counted(len(task.cameras) if task.can_render else 0, "camera")
        envs = counted(len(view.of(RecordingStatus).env_idx), "env")
        what = f"recording {cameras} of {envs} in every step takes {recorded:.0%} of the time"
        advice = f"{SAVE} (Episodes) records afterwards, and costs nothing while playing"
        return f"recording; {advice}", f"{rate}: {what}. Record fewer envs, or none: {advice}."
    cameras = counted(len(view.settings.cameras), "camera")
    what = f"drawing the {cameras} that this page shows takes {watched:.0%} of the time"
    return "camera pictures", f"{rate}: {what}. Untick them on the Cameras tab."


def _state(view: SessionView, busy: Busy | None) -> str:
    if busy is None:
        return view.state
    if busy.held:
        return "awaited" if busy.awaited else "held"
    return view.state if busy.getting_ready else "busy"


def _doing(busy: Busy, phase: str) -> str:
    if busy.awaited:
        return f"for a debugger to attach, {busy.seconds:.0f} s; the log has the address"
    if busy.held:
        at = f" at {place(busy)}" if busy.file else ""
        return f"by a debugger{at} for {busy.seconds:.0f} s; continue in the debugger, not on this page"
    if busy.getting_ready:
        return f"a new worker has been starting for {busy.seconds:.0f} s"
    return f"{busy.doing} for {busy.seconds:.0f} s{f': {phase}' if phase else ''}"


def _pause(view: SessionView) -> str:
    """Why the run paused by itself; empty if it did not."""
    if view.paused_at is None or view.playing:
        return ""
    return f"env {view.selected_env}: {view.pause_when.text}"


def _news(view: SessionView) -> str:
    report, seconds = view.reload, took(view.load_milliseconds)
    if report is None:
        return f"new version in {seconds}"
    return f"{report.level} in {seconds}" + (f": {report.reason}" if report.reason else "")
