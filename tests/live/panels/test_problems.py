"""What the page shows about the file and the worker: banners, the status line, the running version."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.drive.live import Live
from tests.drive.scenes import EMPTY, PLAN, problem, running
from tests.drive.waiting import until
from workbench.live.commands import (
    ChooseClass,
    FillEmptyFile,
    Interrupt,
    RebuildScene,
    ReloadCameras,
    ReloadCode,
    ReloadFile,
    RestartWorker,
)
from workbench.live.messages import ReloadReport
from workbench.live.panels.banners import (
    FILL,
    INTERRUPT,
    NEW_WORKER,
    REBUILD,
    RELOAD,
    RESTART,
    SHOWN_AFTER_SECONDS,
)
from workbench.live.panels.version_panel import MAX_NAMED
from workbench.live.process.heartbeat import Busy, busy_at
from workbench.live.run import PastLoad
from workbench.live.view import SessionView
from workbench.solve.state import SolveView

pytestmark = pytest.mark.thorough

EVIL = "<img src=x onerror=alert(1)><script>alert(2)</script>\"'&"
LOOP = Busy(6.4, "in evaluate", "/home/me/push.py", 88, "while True:", "Traceback ...")


@pytest.fixture
def live(open_live: Live) -> Iterator[Live]:
    open_live.show(EMPTY)
    open_live.asked.clear()
    open_live.session.answers["knows_file"] = lambda file: True
    yield open_live


def failed(stage: str = "evaluate", serial: int = 1, **changes: Any) -> SessionView:
    found = replace(problem(), stage=stage)
    return running(2, **{"problem": found, "problem_serial": serial, "state": "error", **changes})


def banner(live: Live) -> str:
    return live.part("Problem").html() if live.part("Problem").seen else ""


def test_a_problem_is_shown_with_its_line_as_text_and_disappears_with_it(live: Live) -> None:
    live.show(failed())
    title, rest = banner(live).split("</div>", 1)
    assert all(word in title for word in ("PushEnv", "evaluate", "push.py:88"))
    assert "KeyError" in rest and "return goal[&lt;0&gt;]" in rest
    evil = replace(problem(EVIL), file=f"/tmp/{EVIL}.py", code=EVIL, traceback=EVIL, stage=EVIL)
    live.show(failed(serial=2, problem=evil))
    assert "<script" not in banner(live) and "<img" not in banner(live)
    live.show(failed(serial=3, problem=replace(problem(), file=None, line=None, code=None, traceback="")))
    assert "KeyError" in banner(live) and "<pre" not in banner(live)
    live.show(running(2))
    assert banner(live) == ""


def test_an_open_traceback_is_not_redrawn(live: Live) -> None:
    live.show(failed())
    html = live.part("Problem").htmls()[0]
    html.content = "opened"
    live.show(failed(step_serial=99))
    assert html.content == "opened"
    live.show(failed(serial=2, problem=problem("ValueError: other")))
    assert "ValueError: other" in banner(live)
    live.show(running(2))
    live.show(failed(serial=2, problem=problem("ValueError: other")))
    assert "ValueError: other" in banner(live), "the same problem comes back"


def test_the_banner_names_the_running_version(live: Live) -> None:
    at_run = failed(state="paused", playing=False, problem_at_run=True)
    texts = []
    for view in (
        failed(state="running", stale=True),
        failed(state="starting", playing=False),
        failed(state="paused", playing=False),
        at_run,
        replace(at_run, spoiled="torch.get_default_dtype() changed"),
        failed("policy", problem_at_run=True, state="paused", playing=False),
        failed("worker", state="paused", playing=False),
    ):
        live.show(view)
        texts.append(live.part("Problem").htmls()[1].content)
    assert len({*texts}) == len(texts)
    assert "env 0: step 7" in texts[3] and "torch.get_default_dtype()" in texts[4]


@pytest.mark.parametrize(
    ("stage", "offered"),
    [("evaluate", True), ("reset", True), ("syntax", False), ("policy", False), ("worker", False)],
)
def test_the_banner_offers_the_possible_actions(live: Live, stage: str, offered: bool) -> None:
    live.show(failed(stage))
    part = live.part("Problem")
    assert part.shows(REBUILD) is offered and part.shows(NEW_WORKER) is (stage == "worker")
    part.press(RELOAD)
    if offered:
        part.press(REBUILD)
    if stage == "worker":
        part.press(NEW_WORKER)
    wanted = [ReloadFile(), *([RebuildScene()] if offered else [])]
    assert live.asked == [*wanted, *([RestartWorker()] if stage == "worker" else [])]


def test_a_press_fills_the_file_only_while_it_is_empty(live: Live, tmp_path: Path) -> None:
    file, other = tmp_path / "stack_two.py", tmp_path / "other.py"
    file.write_text("# mine\n\n")
    other.touch()
    live.session.answers["knows_file"] = str(file).__eq__
    view = replace(EMPTY, problem=replace(problem(), file=str(file)), problem_serial=1, state="error")
    live.show(view)
    assert live.shows(FILL) and file.read_text() == "# mine\n\n"
    file.write_text("x = 1\n")
    live.press(FILL)
    until(lambda: live.client.notices, "why not")
    assert file.read_text() == "x = 1\n"
    file.write_text("# mine\n\n")
    live.press(FILL)
    until(lambda: "class StackTwoEnv" in file.read_text(), "the task")
    assert file.read_text().startswith("# mine\n\n")
    live.show(replace(view, problem_serial=2))
    assert not live.shows(FILL), "it holds a task"
    live.show(replace(view, problem=replace(problem(), file=str(other)), problem_serial=3))
    assert not live.shows(FILL), "another file is not the task's"
    noticed = len(live.client.notices)
    live.do(FillEmptyFile())
    assert other.read_text() == "" and len(live.client.notices) == noticed + 1


def test_long_work_can_be_stopped_and_is_shown_instead_of_a_problem(live: Live) -> None:
    live.show(running(2, busy=replace(LOOP, seconds=SHOWN_AFTER_SECONDS - 1)))
    assert not live.part("Busy").seen
    live.show(failed(busy=LOOP))
    busy = live.part("Busy")
    html = busy.html()
    assert all(word in html for word in ("PushEnv", "in evaluate", "6 s", "push.py:88", "while True:"))
    assert not banner(live) and "Traceback ..." not in html
    busy.press(INTERRUPT)
    busy.press(RESTART)
    assert live.asked == [Interrupt(), RestartWorker()]
    live.show(running(2, busy=replace(LOOP, ignores_interrupt=True)))
    assert not busy.shows(INTERRUPT) and busy.shows(RESTART) and "Traceback ..." in busy.html()
    live.show(running(2, busy=Busy(6.0, EVIL, f"/{EVIL}.py", 1, EVIL, EVIL, ignores_interrupt=True)))
    assert "<script" not in busy.html() and "<img" not in busy.html()
    live.show(failed())
    assert not busy.seen and "KeyError" in banner(live)


@pytest.mark.parametrize(
    ("busy", "shown", "interrupt"),
    [
        (LOOP, True, True),
        (replace(LOOP, held=True), False, False),
        (replace(LOOP, drawing=True), True, False),
        (replace(LOOP, getting_ready=True), False, False),
    ],
)
def test_what_a_debugger_or_the_renderer_holds_up_is_not_interrupted(
    live: Live, busy: Busy, shown: bool, interrupt: bool
) -> None:
    live.show(running(2, busy=busy))
    assert live.part("Busy").seen == shown
    assert not shown or (live.part("Busy").shows(INTERRUPT), live.part("Busy").shows(RESTART)) == (
        interrupt,
        True,
    )
    live.show(running(2))
    assert not live.part("Busy").seen


def test_without_a_worker_the_banner_offers_one_and_nothing_that_needs_it(live: Live) -> None:
    def offered(view: SessionView) -> tuple[bool, bool]:
        live.show(view)
        return live.part("Problem").shows(NEW_WORKER), live.part("Problem").shows(REBUILD)

    assert offered(failed("evaluate", 1)) == (False, True)
    assert offered(failed("evaluate", 2, state="stopped")) == (True, False)
    assert offered(failed("evaluate", 3, task=None)) == (False, False), "there is no scene"
    assert offered(failed("worker", 4)) == (True, False)
    assert offered(failed("worker", 5, state="paused")) == (False, False), "another worker runs"


def test_the_banner_names_the_file_until_a_task_runs_and_says_what_is_left(live: Live) -> None:
    def told(view: SessionView) -> tuple[str, str]:
        live.show(view)
        title, kept, *_ = live.part("Problem").htmls()
        return re.findall(r"<b>([^<]*)</b>", title.content)[0], kept.content

    task = told(failed("evaluate", 1))[0]
    assert task == "PushEnv" and told(failed("policy", 2))[0] not in (task, "The file")
    file = told(failed("evaluate", 3, task=None))
    assert file[0] == told(failed("syntax", 4))[0] == "The file"
    nothing = told(failed("import", 5, task=None, problem=replace(problem(), file=None, line=None)))
    assert nothing[1] != file[1] and nothing[0] != "PushEnv"
    stopped = told(failed("evaluate", 6, state="stopped"))[1]
    assert stopped == told(failed("worker", 7))[1] != told(failed("worker", 8, state="paused"))[1]
    assert told(failed("evaluate", 9, state="running"))[1] != told(failed("evaluate", 10, playing=False))[1]
    steps = failed("step", 11, state="paused", playing=False, problem_at_run=True)
    assert steps.step is not None
    for number in (7, 9):
        step = replace(steps.step, elapsed_steps=np.full(2, number, np.int32))
        assert f"step {number} " in told(replace(steps, step=step))[1], "the text below is not that of before"


def test_a_long_load_is_shown_with_its_phase(live: Live) -> None:
    phase = "reading <meshes>"
    for busy, shown in ((Busy(42.0, "loading"), True), (LOOP, False)):
        live.show(running(2, busy=busy, state="loading", activity=phase))
        for html in (live.part("Busy").html(), live.html("wb-status")):
            assert ("reading &lt;meshes&gt;" in html) == shown


def test_the_reason_stays_visible_while_a_worker_starts(live: Live) -> None:
    ready = busy_at(21.0, "warming up", "", (), ignores_interrupt=False)
    live.show(failed(busy=ready, state="starting", playing=False))
    assert not live.part("Busy").seen and banner(live)
    assert "busy" not in live.html("wb-status")


def test_an_interrupt_is_not_shown_as_a_failure(live: Live) -> None:
    live.show(failed(problem=replace(problem("Interrupted: stopped by the user"), interrupted=True)))
    assert "interrupted in evaluate" in banner(live) and "failed" not in banner(live)


# --- the status line -------------------------------------------------------------------------------


def status(live: Live, view: SessionView) -> str:
    live.show(view)
    return live.html("wb-status")


def test_the_status_line_has_state_task_and_rate(live: Live) -> None:
    status_text = status(live, running(16))
    for word in (
        "running",
        "16 envs",
        "cpu (batched)",
        "20 steps/s",
        "1.00 × real time",
    ):
        assert word in status_text
    assert 'data-title="Push-v1 · Workbench"' in status_text
    slow = status(live, running(1, steps_per_second=0.93, real_time_factor=0.0465))
    assert "0.93 steps/s" in slow and "0.046 × real time" in slow
    for quiet in (
        running(4, state="paused", playing=False),
        running(1, steps_per_second=0.0),
        running(4, busy=LOOP),
        EMPTY,
    ):
        assert "steps/s" not in status(live, quiet)
    assert "in evaluate for 6 s" in status(live, running(4, busy=LOOP))
    drawing = running(4, busy=Busy(25.0, "drawing", drawing=True), state="loading", activity="compiling")
    assert "compiling" in status(live, drawing) and "busy" not in status(live, drawing)


def test_a_slow_machine_is_reported_with_the_cause(live: Live) -> None:
    slow = running(4, speed=4.0, real_time_factor=1.2)
    assert "cannot reach it" in status(live, slow)
    assert "cannot reach it" not in status(live, running(4, speed=4.0, real_time_factor=3.9))
    assert "cannot reach it" not in status(live, running(4, speed=float("inf"), real_time_factor=1.2))
    assert "slow: recording" in status(live, replace(slow, recorded_share=0.9, watched_share=0.4))
    assert "slow: camera pictures" in status(live, replace(slow, recorded_share=0.1, watched_share=0.4))


@pytest.mark.parametrize("word", ["running", "paused", "loading"])
def test_error_and_old_code_are_marks_next_to_the_state(live: Live, word: Any) -> None:
    status_text = status(
        live, running(4, state=word, playing=word == "running", stale=True, problem=problem())
    )
    assert f"<b>{word}</b>" in status_text and status_text.count(">error</span>") == 1
    assert (">old code</span>" in status_text) is (word != "loading")


def test_the_status_line_shows_the_planning_time(live: Live) -> None:
    def planning(**solve: Any) -> str:
        view = running(4, steps_per_second=0.3, real_time_factor=0.01, solve=SolveView(**solve))
        return status(live, replace(view, settings=replace(view.settings, action_source="solve")))

    status_text = planning(state="planning", plan=PLAN)
    assert (
        "<b>planning</b>" in status_text
        and "<b>0.25</b> s a plan" in status_text
        and "real time" not in status_text
    )
    assert "building 1 env" in planning(state="starting", activity="building 1 env")


# --- the version -----------------------------------------------------------------------------------


def version(live: Live, view: SessionView) -> str:
    live.show(view)
    return live.part("Code version").html()


def test_a_load_is_shown_with_level_time_reason_and_what_was_not_carried_over(live: Live) -> None:
    status_text = version(
        live, running(2, reload=ReloadReport("patched", "only evaluate changed"), load_milliseconds=43.2)
    )
    assert all(word in status_text for word in ("patched", "43 ms", "only evaluate changed"))
    missing = {f"actor cube_{i}": "<script>why</script>" for i in range(MAX_NAMED + 3)}
    report = ReloadReport("rebuilt", "_load_scene changed", ("actor goal",), missing)
    status_text = version(live, running(2, reload=report, load_milliseconds=1500.0))
    assert (
        "1.5 s" in status_text
        and "actor cube_0" in status_text
        and f"actor cube_{MAX_NAMED}" not in status_text
    )
    assert "and 3 more" in status_text and "<script" not in status_text
    times = {999.4: "999 ms", 1000.0: "1.0 s", 12345.0: "12.3 s"}
    for milliseconds, text in times.items():
        assert text in version(live, running(2, reload=report, load_milliseconds=milliseconds))
    kept, cleared = (version(live, running(2, reload=report, timeline_cleared=one)) for one in (False, True))
    assert kept != cleared


def test_while_the_file_is_broken_the_broken_save_comes_first(live: Live) -> None:
    """Otherwise the last good save would look like the one that was just saved."""
    good = ReloadReport("patched", "only evaluate changed")
    told = version(live, running(4, reload=good, stale=True, state="error", refused=problem()))
    assert told.index("push.py:88") < told.index("only evaluate") and "KeyError" in told
    loading = version(live, running(4, reload=good, stale=True, state="loading", refused=problem()))
    assert "KeyError" not in loading, "another version is loading"


def test_the_tasks_of_a_file_can_be_chosen_while_the_requested_one_fails(live: Live) -> None:
    live.show(running(4))
    assert not live.part("Code version").shows("Task")
    live.show(running(4, task=None, state="error", refused=problem(), choices=("TwoEnv", "OneEnv")))
    task = live.part("Code version")
    assert task.field("Task").value == "TwoEnv" and list(task.field("Task").options) == ["OneEnv", "TwoEnv"]
    task.set("Task", "OneEnv")
    assert live.asked[-1] == ChooseClass(name="OneEnv")
    live.show(running(4, choices=("OneEnv", "TwoEnv")))
    assert task.field("Task").value == "OneEnv"


def test_the_file_is_reloaded_at_the_pressed_level(live: Live) -> None:
    live.show(running(4))
    part = live.part("Code version")
    for name in ("Reload", REBUILD, "Only reload code", "Only reload cameras"):
        part.press(name)
    assert live.asked == [ReloadFile(), RebuildScene(), ReloadCode(), ReloadCameras()]
    live.show(running(4, state="stopped"))
    assert not part.shows("Reload")


def test_the_last_loads_are_listed_newest_first(live: Live) -> None:
    first = PastLoad(1e9, None, "the first version", 900.0)
    assert "the first version" not in version(live, running(4, loads=(first,))), "a single load is not listed"
    refused = PastLoad(1e9 + 60, None, "KeyError: '<goal>'", problem=problem())
    patched = PastLoad(1e9 + 120, "patched", "only evaluate changed", 43.0)
    told = version(live, running(4, loads=(patched, refused, first)))
    told = told[told.index("wb-loads") :]
    wanted = ("patched", "43 ms", "only evaluate", "refused", "push.py:88", "900 ms")
    assert [told.index(word) for word in wanted] == sorted(told.index(word) for word in wanted)
    assert "&lt;goal&gt;" in told
