"""What the status line says about each state of the session, and when it is drawn at once."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, cast

import pytest

from tests.drive.panels import Clock, Panels
from tests.drive.scenes import EMPTY, PLAN, running
from workbench.app.status_line import STATE_WORDS, StatusLine, robot_text, slowed_by, status_values
from workbench.envs.keywords import HowMade
from workbench.live.messages import ReloadReport
from workbench.live.pause_when import PauseWhen
from workbench.live.process.heartbeat import Busy
from workbench.live.timeline_commands import ContinueFromHere
from workbench.live.view import SessionView
from workbench.record.state import RecordingStatus
from workbench.solve.state import SolveView

LOOP = Busy(6.4, "in evaluate", "/home/me/push.py", 88, "while True:")
HELD, DRAWING = replace(LOOP, held=True), Busy(9.0, "drawing", drawing=True)
QUIET: dict[str, Any] = {"state": "paused", "playing": False}


def solving(**changes: Any) -> SessionView:
    view = running(3, solve=SolveView(plan=PLAN, **changes))
    return replace(view, settings=replace(view.settings, action_source="solve"))


def slow(**changes: Any) -> SessionView:
    return running(3, **{"speed": 2.0, "real_time_factor": 1.0, "recorded_share": 0.5, **changes})


@pytest.mark.parametrize(
    ("view", "shown"),
    [
        (EMPTY, {"word": "starting", "stale": False, "moving": False, "robot": "", "recording": ""}),
        (running(3), {"state": "running", "word": "running", "moving": True, "behind": False, "plan": None}),
        (running(3, **QUIET), {"word": "paused", "moving": False}),
        (running(3, steps_per_second=0.0), {"word": "running", "moving": False, "behind": False}),
        (running(3, busy=LOOP), {"state": "loading", "word": "busy", "moving": False}),
        (running(3, busy=HELD), {"word": "held", "moving": False}),
        (running(3, busy=replace(HELD, awaited=True)), {"word": "waiting"}),
        (running(3, busy=replace(LOOP, getting_ready=True), state="starting"), {"word": "starting"}),
        (running(3, busy=DRAWING), {"word": "busy"}),
        (running(3, busy=DRAWING, activity="compiling"), {"word": "running", "activity": "compiling"}),
        (running(3, state="error"), {"word": "not loaded", "moving": False}),
        (running(3, state="stopped"), {"word": "worker stopped"}),
        (running(3, stale=True), {"stale": True}),
        (running(3, stale=True, state="loading"), {"stale": False}),
        (replace(EMPTY, stale=True, state="error"), {"stale": False}),
        (solving(state="planning"), {"word": "planning", "moving": False, "plan": PLAN}),
        (solving(state="starting", activity="building"), {"plan": None, "activity": "building"}),
        (replace(solving(state="planning"), **QUIET), {"word": "paused", "plan": None}),
        (slow(), {"behind": True}),
        (slow(real_time_factor=1.8), {"behind": False, "why_slow": None}),
        (slow(speed=0.5), {"behind": False, "why_slow": None}),
        (slow(speed=float("inf")), {"behind": False, "why_slow": None}),
        (slow(**QUIET), {"behind": False, "why_slow": None}),
        (slow(recorded_share=0.2, watched_share=0.2), {"behind": True, "why_slow": None}),
        (running(3, **QUIET, paused_at=30, pause_when=PauseWhen("success")), {"moving": False}),
        (running(3, recording=RecordingStatus(True, (0, 2), waiting=1)), {"recording": "on"}),
        (running(3, recording=RecordingStatus(True, (0, 2), waiting=2)), {"recording": "waits"}),
        (running(3, recording=RecordingStatus(False, (0, 2))), {"recording": ""}),
    ],
)  # fmt: skip
def test_each_state_has_its_word_and_its_numbers(view: SessionView, shown: dict[str, Any]) -> None:
    values = status_values(view)
    assert {name: values[name] for name in shown} == shown
    assert values["word"] in STATE_WORDS.values()


def test_the_news_are_the_new_version_and_then_why_the_run_paused() -> None:
    when = PauseWhen("reward", "rises above", 0.5)
    view = running(3, **QUIET, selected_env=2, paused_at=30, pause_when=when)
    view = replace(view, reload=ReloadReport("patched", "why"), load_milliseconds=43.0)
    fresh, later = (str(status_values(view, fresh=fresh)["news"]) for fresh in (True, False))
    assert "patched" in fresh and "43" in fresh and "why" in fresh
    assert "env 2" in later and when.text in later and "patched" not in later
    first = str(status_values(replace(view, reload=None), fresh=True)["news"])
    assert "43" in first
    for other in (replace(view, paused_at=None), replace(view, playing=True)):
        assert status_values(other)["news"] == ""


def test_work_that_takes_long_is_named_with_its_place_and_time() -> None:
    doing = str(status_values(running(3, busy=LOOP))["activity"])
    assert "in evaluate" in doing and "6 s" in doing
    held = str(status_values(running(3, busy=HELD))["activity"])
    assert "push.py:88" in held and "6 s" in held
    nowhere = str(status_values(running(3, busy=replace(HELD, file=None, line=None)))["activity"])
    assert "6 s" in nowhere and "None" not in nowhere
    awaited = str(status_values(running(3, busy=replace(HELD, awaited=True)))["activity"])
    ready = str(status_values(running(3, busy=replace(LOOP, getting_ready=True)))["activity"])
    assert len({doing, held, awaited, ready}) == 4 and "push.py" not in awaited + ready


def test_the_larger_of_two_causes_makes_the_run_slow() -> None:
    task = running(3).task
    assert task is not None
    both = slow(
        recorded_share=0.4, watched_share=0.6, steps_per_second=12.5, recording=RecordingStatus(True, (0, 2))
    )
    drawn, recorded = slowed_by(both), slowed_by(replace(both, recorded_share=0.6))
    assert drawn is not None and recorded is not None and drawn[0] != recorded[0]
    assert "60%" in drawn[1] and "60%" in recorded[1] and "2 envs" in recorded[1]
    assert all("12" in text for _, text in (drawn, recorded)) or all(
        "13" in text for _, text in (drawn, recorded)
    )
    assert slowed_by(replace(both, recorded_share=0.29, watched_share=0.29)) is None
    assert slowed_by(replace(both, task=None)) is None
    assert slowed_by(replace(both, recorded_share=0.0)) is not None
    assert status_values(slow())["why_slow"] == slowed_by(slow()) is not None


def test_the_robot_is_named_with_its_control_mode_and_actions() -> None:
    task = running(3).task
    assert task is not None
    assert robot_text(replace(task, made=HowMade("panda"))) == "panda · pd_joint_delta_pos · 2 actions"
    assert robot_text(replace(task, control_mode=None, actions=task.actions[:1])).endswith("robot · 1 action")
    assert "action" not in robot_text(replace(task, actions=()))


def test_a_past_moment_can_be_continued_from_where_that_is_possible() -> None:
    view = running(3, **QUIET)
    past = replace(view, timeline=replace(view.timeline, shown=3, can_continue=True))
    assert status_values(past)["can_continue"] == ContinueFromHere()
    assert status_values(view)["can_continue"] is None


def test_the_line_is_drawn_at_once_for_what_a_person_waits_for(panels: Panels) -> None:
    view, clock = running(3, busy=LOOP), Clock()
    line = StatusLine(panels.server, clock)
    before = line.urgent(view)
    assert line.urgent(replace(view, busy=replace(LOOP, seconds=6.44))) == before
    for change in (
        {"busy": replace(LOOP, seconds=7.6)},
        {"busy": replace(LOOP, doing="in compute_dense_reward")},
        {"busy": None},
        {"stale": True},
        {"activity": "importing"},
        {"problem_serial": 9},
    ):
        assert line.urgent(replace(view, **cast(Any, change))) != before, change
    clock.passes()
    assert line.urgent(replace(view, task_serial=2)) != before, "a new version is announced"
    line.draw(replace(view, task_serial=2, busy=None, reload=ReloadReport("patched", "")))
    assert "patched" in panels.html("wb-status")
    clock.passes(5.0)
    line.draw(replace(view, task_serial=2, busy=None, reload=ReloadReport("patched", "")))
    assert "patched" in panels.html("wb-status")
    clock.passes(5.0)
    line.draw(replace(view, task_serial=2, busy=None, reload=ReloadReport("patched", "")))
    assert "patched" not in panels.html("wb-status")


def test_the_first_version_is_not_announced(panels: Panels) -> None:
    line = StatusLine(panels.server, Clock())
    line.draw(replace(running(3, **QUIET), reload=ReloadReport("patched", "")))
    assert "patched" not in panels.html("wb-status")
