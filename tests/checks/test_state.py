"""Checks of the running version, with a scripted background process."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Awaitable, Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from tests.drive.scenes import description, problem, table_scene
from tests.drive.session import FakeWorkerSession, fake_worker_session, live_session, wait_until, work_with
from tests.drive.waiting import until
from workbench.checks import state
from workbench.checks.commands import CheckAfterSave, CheckNow, StopChecks
from workbench.checks.questions import CheckedGroup, CheckGroup, RuleProgress
from workbench.checks.results import RuleResult
from workbench.checks.state import MAX_DEATHS, RUNNING, ChecksView
from workbench.envs.gpu_rules import GPU_RULES, Finding
from workbench.live.commands import PlayRun
from workbench.live.events import FileSaved, LoadDone
from workbench.live.messages import Load, Settings
from workbench.live.process.ask import Preempted
from workbench.live.process.background_jobs import Job, JobFailed, ProcessDied, StoppedBy
from workbench.live.run import first_run
from workbench.machine.preferences import preferences
from workbench.page.command import Refused
from workbench.record.saving_state import SaveWanted
from workbench.record.state import RecordingStatus
from workbench.task.description import TaskOptions

FIRST, SECOND = "success-at-reset", "reward-changes"
GROUPS = ((FIRST,), (SECOND,))
FILE = "/home/me/push.py"
FIRST_TEXT = "def evaluate(self):\n    return 1\n"
NEXT_TEXT = "def evaluate(self):\n    print()\n    return 1\n"
MENDED_TEXT = "def evaluate(self):\n    return 2\n"


def finding(rule: str, line: int = 7) -> Finding:
    return Finding(rule, "stop", f"{rule} is broken", FILE, line, "return 1", "evaluate", 8, 0)


def broken(rule: str) -> RuleResult:
    return RuleResult(rule, "broken", (finding(rule),))


class ScriptedBackground:
    """Returns the results of each group once `let` allows it."""

    def __init__(self) -> None:
        self.comes_to: dict[str, RuleResult] = {}
        self.asked: list[CheckGroup] = []
        self.priorities: list[str] = []
        self.loads: list[Load] = []
        self.give_way_after = 99
        """Number of results of a group after which a job of higher priority preempts it, once."""
        self.groups: tuple[tuple[str, ...], ...] = GROUPS
        self.dies_at: str | None = None
        """The rule that kills the process; ``any`` if it dies before the first one."""
        self.fails: JobFailed | None = None
        self.let = threading.Semaphore(1000)

    def hold(self) -> None:
        self.let = threading.Semaphore(0)

    async def ensure(self, job: Job, load: Load, or_else: Load | None = None) -> int:
        if self.fails is not None:
            raise self.fails
        self.loads.append(load)
        return 1

    async def in_turns(self, job: Job, work: Callable[[], Awaitable[Any]], priority: str) -> Any:
        self.priorities.append(priority)
        while True:
            try:
                return await work()
            except Preempted:
                continue

    async def ask(self, question: CheckGroup, on_progress: Callable[..., None]) -> CheckedGroup:
        self.asked.append(question)
        if self.dies_at == "any":
            raise ProcessDied("the process in the background was killed by SIGSEGV")
        for done, rule in enumerate(self.groups[question.group], 1):
            while not self.let.acquire(blocking=False):
                await asyncio.sleep(0.005)
            if rule not in question.known:
                on_progress(done - 1, 2, RuleProgress(rule))
                if rule == self.dies_at:
                    raise ProcessDied("the process in the background was killed by SIGSEGV")
                result = self.comes_to.get(rule, RuleResult(rule, "kept"))
                on_progress(done, 2, RuleProgress(rule, result))
            if done >= self.give_way_after:
                self.give_way_after = 99
                raise Preempted
        following = question.group + 1
        return CheckedGroup(2, 2, "rewards" if following < 2 else "")


@pytest.fixture
def background() -> ScriptedBackground:
    return ScriptedBackground()


@pytest.fixture
def checks(background: ScriptedBackground, tmp_path: Path) -> Iterator[FakeWorkerSession]:
    with fake_worker_session(tmp_path / "recordings", check=True) as fake:
        work_with(fake.session, background)
        yield fake


def load(fake: FakeWorkerSession, text: str = FIRST_TEXT, **changes: Any) -> None:
    fake.load("patched", source={FILE: text}, **changes)


def shown(fake: FakeWorkerSession) -> ChecksView:
    return fake.view.of(ChecksView)


def ended(fake: FakeWorkerSession) -> ChecksView:
    until(lambda: shown(fake).state not in RUNNING, "the end of the checks", seen=lambda: shown(fake))
    return shown(fake)


def check_first(fake: FakeWorkerSession, background: ScriptedBackground, *found: Finding) -> None:
    """Load the first version, of which the check ends with these findings."""
    background.comes_to = {one.rule: RuleResult(one.rule, "broken", (one,)) for one in found}
    load(fake)
    ended(fake)


def rules_of(of: Iterable[RuleResult | Finding]) -> list[str]:
    return [one.rule for one in of]


def test_each_load_is_checked_group_by_group_with_the_degree_of_each_rule(
    checks: FakeWorkerSession, background: ScriptedBackground
) -> None:
    background.comes_to = {SECOND: broken(SECOND)}
    load(checks)
    view = ended(checks)
    assert (view.state, view.total, rules_of(view.results)) == ("done", 2, [FIRST, SECOND])
    assert view.findings == (finding(SECOND),)
    assert [question.group for question in background.asked] == [0, 1]
    assert background.asked[0].degrees[FIRST] == "stop" and background.asked[0].degrees[SECOND] == "warn"
    assert background.loads[0].source == {FILE: FIRST_TEXT}


def test_the_same_version_is_not_checked_twice(
    checks: FakeWorkerSession, background: ScriptedBackground
) -> None:
    for _ in range(2):
        load(checks)
        ended(checks)
    assert len(background.asked) == 2
    checks.session.do(CheckNow())
    ended(checks)
    assert len(background.asked) == 4


@pytest.mark.parametrize(
    "changed",
    [{"env_kwargs": {"control_mode": "pd_joint_pos"}}, {"rules": "warn"}],
    ids=lambda changed: next(iter(changed)),
)
def test_envs_with_other_options_are_checked_again(
    checks: FakeWorkerSession, background: ScriptedBackground, changed: dict[str, Any]
) -> None:
    load(checks)
    ended(checks)
    load(checks, options=TaskOptions(3, **changed))
    ended(checks)
    assert len(background.asked) == 4


def test_findings_of_the_previous_version_stay_until_their_rule_is_checked(
    checks: FakeWorkerSession, background: ScriptedBackground
) -> None:
    check_first(checks, background, finding(FIRST), finding(SECOND))
    background.comes_to = {SECOND: broken(SECOND)}
    background.hold()
    # Of the first of these versions no rule is checked.
    for text in (NEXT_TEXT, NEXT_TEXT + "\n"):
        checks.session.dispatch(FileSaved())
        load(checks, text)
        assert rules_of(shown(checks).before) == [FIRST, SECOND] and shown(checks).findings == ()
    background.let.release()
    until(lambda: len(shown(checks).results) == 1, "the first rule")
    assert rules_of(shown(checks).before) == [SECOND]
    background.let.release()
    view = ended(checks)
    assert view.before == () and rules_of(view.findings) == [SECOND]


@pytest.mark.parametrize(
    "changes",
    [
        pytest.param({"text": MENDED_TEXT}, id="its line is gone"),
        pytest.param({"env_id": "Pull-v1"}, id="another task"),
        pytest.param({"options": TaskOptions(3, rules="off")}, id="no rule is checked"),
    ],
)
def test_a_finding_that_no_longer_holds_is_gone_at_once(
    changes: dict[str, Any], checks: FakeWorkerSession, background: ScriptedBackground
) -> None:
    check_first(checks, background, finding(FIRST))
    background.hold()
    load(checks, **changes)
    assert (shown(checks).before, shown(checks).results) == ((), ())
    if "options" in changes:
        assert shown(checks).state == "off" and len(background.asked) == 2


@pytest.mark.parametrize(
    "changes", [{"file": None, "line": None, "code": ""}, {"code": ""}, {"file": "/home/me/other.py"}]
)
def test_a_finding_whose_line_is_not_known_stays_until_its_rule_is_checked(
    changes: dict[str, Any], checks: FakeWorkerSession, background: ScriptedBackground
) -> None:
    one = replace(finding(FIRST), **changes)
    check_first(checks, background, one)
    background.hold()
    load(checks, MENDED_TEXT)
    assert shown(checks).before == (one,)


def test_a_save_stops_a_check_and_results_so_far_stay(
    checks: FakeWorkerSession, background: ScriptedBackground
) -> None:
    background.hold()
    load(checks)
    background.let.release()
    until(lambda: len(shown(checks).results) == 1, "the first rule")
    checks.session.dispatch(FileSaved())
    assert (shown(checks).state, shown(checks).stopped_by) == ("stopped", StoppedBy.SAVE)
    assert rules_of(shown(checks).results) == [FIRST]
    # The same text again, or a save that could not be loaded and was undone.
    background.let = threading.Semaphore(10)
    load(checks)
    assert ended(checks).state == "done"


def test_a_preempted_group_is_resumed_without_the_finished_rules(
    checks: FakeWorkerSession, background: ScriptedBackground
) -> None:
    background.give_way_after = 1
    load(checks)
    assert ended(checks).state == "done"
    assert [question.group for question in background.asked] == [0, 0, 1]
    assert [question.known for question in background.asked] == [(), (FIRST,), (FIRST,)]


def test_a_rule_that_kills_the_process_fails_and_the_others_continue(
    checks: FakeWorkerSession, background: ScriptedBackground
) -> None:
    background.dies_at = FIRST
    load(checks)
    view = ended(checks)
    assert view.state == "done" and [result.state for result in view.results] == ["failed", "kept"]
    first = view.results[0]
    assert "SIGSEGV" in first.why and first.problem is not None
    assert [question.known for question in background.asked] == [(), (FIRST,), (FIRST,)]


def test_without_automatic_checks_a_load_marks_the_findings_as_old(
    checks: FakeWorkerSession, background: ScriptedBackground
) -> None:
    check_first(checks, background, finding(FIRST))
    checks.session.do(CheckAfterSave(on=False))
    for text in (NEXT_TEXT, NEXT_TEXT + "\n"):
        load(checks, text)
        view = shown(checks)
        assert view.state == "none" and rules_of(view.before) == [FIRST] and not view.results
    assert len(background.asked) == 2


def test_turning_automatic_checks_on_is_remembered_and_checks_at_once(
    checks: FakeWorkerSession, background: ScriptedBackground
) -> None:
    with pytest.raises(Refused):
        checks.session.do(CheckNow())
    for wanted in (True, False):
        checks.session.do(CheckAfterSave(on=wanted))
        assert preferences().check_after_save == wanted == shown(checks).after_each_save
    load(checks)
    assert background.asked == []
    checks.session.do(CheckAfterSave(on=True))
    assert ended(checks).state == "done"


def test_a_check_stopped_by_hand_says_so(checks: FakeWorkerSession, background: ScriptedBackground) -> None:
    background.hold()
    load(checks)
    checks.session.do(StopChecks())
    view = shown(checks)
    assert (view.state, view.stopped_by) == ("stopped", StoppedBy.USER)
    checks.session.do(StopChecks())
    assert shown(checks) == view


def test_rules_of_gpu_simulation_that_kill_the_process_fail_together(
    checks: FakeWorkerSession, background: ScriptedBackground
) -> None:
    background.groups, background.dies_at = ((FIRST,), ("",)), ""
    load(checks)
    view = ended(checks)
    states = {result.rule: result.state for result in view.results}
    assert view.state == "done" and states == {FIRST: "kept"} | dict.fromkeys(GPU_RULES, "failed")
    assert [question.group for question in background.asked] == [0, 1]


def test_a_process_that_dies_again_and_again_ends_the_check_and_the_next_check_begins_anew(
    checks: FakeWorkerSession, background: ScriptedBackground
) -> None:
    background.dies_at = "any"
    load(checks)
    view = ended(checks)
    assert view.state == "failed" and "SIGSEGV" in view.why and len(background.asked) == MAX_DEATHS + 1
    background.dies_at = None
    background.fails = JobFailed("it cannot be loaded", problem())
    checks.session.do(CheckNow())
    view = ended(checks)
    assert view.state == "failed" and view.problem == problem() and "SIGSEGV" not in view.why
    background.fails = None
    checks.session.do(CheckNow())
    view = ended(checks)
    assert (view.state, view.why, view.problem, view.stopped_by) == ("done", "", None, None)


@pytest.mark.parametrize(("ahead", "priorities"), [(1e9, ["low", "low"]), (0.0, ["low", "lowest"])])
def test_a_long_check_goes_on_behind_all_other_work(
    ahead: float,
    priorities: list[str],
    checks: FakeWorkerSession,
    background: ScriptedBackground,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("workbench.checks.state.AHEAD_SECONDS", ahead)
    load(checks)
    ended(checks)
    assert background.priorities == priorities


def test_the_page_sees_how_far_a_check_is_and_what_it_waits_for() -> None:
    run = replace(first_run("push.py", TaskOptions(1), 1, Settings()), task=description(table_scene(1)[0]))
    now, _ = state.apply(
        state.Checks(ChecksView(before=(finding(FIRST), finding(SECOND)))), LoadDone(), run, run
    )

    def seen(event: object) -> ChecksView:
        nonlocal now
        now, effects = state.apply(now, event, run, run)
        assert effects == []
        return now.view

    assert (now.view.state, len(now.view.before), now.view.total) == ("loading", 2, 0)
    assert seen(state.CheckWaits(True)).waits
    view = seen(state.GroupBegan())
    assert (view.state, view.waits) == ("checking", False)
    view = seen(state.RuleChecked(broken(FIRST), 1.5, 58))
    assert (view.total, view.seconds, rules_of(view.results)) == (58, 1.5, [FIRST])
    assert rules_of(view.before) == [SECOND]
    view = seen(state.GroupChecked(58, "rewards"))
    assert view.looks_at == "rewards"
    view = seen(state.RuleChecked(RuleResult(FIRST, "kept"), 2.5))
    assert (view.total, view.seconds) == (58, 2.5), (
        "of the process that died the number of rules is not known"
    )
    (result,) = view.results
    assert result.state == "broken", "another rule may find that the task raises, which breaks the same rule"
    assert seen(state.CheckWaits(True)).waits
    view = seen(state.CheckDone())
    assert (view.state, view.looks_at, view.waits, view.before) == ("done", "", False, ())
    assert seen(state.RuleChecked(broken(SECOND), 9.0, 9)) is view, "it came late"


# --- with processes -----------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_broken_save_is_found_at_its_line_while_playing_and_a_fix_clears_it(
    child_process: None, task_file: Path
) -> None:
    text = task_file.read_text()
    good, bad = "(distance < GOAL_RADIUS)", "(distance < 1)"
    line = text[: text.index(good)].count("\n") + 1
    with live_session(task_file, task_file.parent / "recordings") as session:
        session.do(CheckAfterSave(on=True))
        session.do(PlayRun())
        task_file.write_text(text.replace(good, bad))

        def found(rule: str) -> Callable[[Any], bool]:
            return lambda view: any(one.rule == rule for one in view.of(ChecksView).findings)

        view = wait_until(session, found(FIRST), "the finding")
        (one,) = (each for each in view.of(ChecksView).findings if each.rule == FIRST)
        assert (one.file, one.line, one.degree) == (str(task_file), line, "stop") and bad in one.code
        assert view.playing
        # A person waits for this request: the checks are preempted and then resumed.
        session.dispatch(SaveWanted((0,)))
        wait_until(session, lambda view: view.of(RecordingStatus).saving.message != "", "the saved episode")
        task_file.write_text(text)
        wait_until(
            session,
            lambda view: FIRST in rules_of(view.of(ChecksView).results) and not found(FIRST)(view),
            "the rule checked anew",
        )
        assert all(one.rule != FIRST for one in session.view().of(ChecksView).before)
