"""What the commands print about loads, failures and broken rules, and their questions in a terminal."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
from rich.console import Console
from rich.style import Style

from tests.drive.scenes import description, step_of, table_scene
from workbench.cli import output
from workbench.cli.output import (
    MAX_QUESTIONS,
    Exit,
    TerminalPrompt,
    interrupted,
    not_trusted_lines,
    print_addresses,
    print_event,
    print_failures,
    print_line,
    print_problem,
    print_question,
    print_texts,
    refuse,
    warn,
)
from workbench.envs.gpu_rules import Finding
from workbench.jobs.scheduler import Failure
from workbench.live.messages import Loaded, ReloadReport, RulesBroken, TaskFailed
from workbench.live.process.captured_output import PrintedLine, StyledText
from workbench.task.problem import Problem
from workbench.trust.clearance import CodeFile, Consent, NotTrusted, Since, TrustQuestion

PROBLEM = Problem("step", "KeyError: '[x]'", "/w/task.py", 12, "a['[x]']", "Traceback\n  in [evaluate]\n")
PUSH = TrustQuestion(
    "Push-v1",
    False,
    (CodeFile("/w/push.py", "a" * 12, "x = 1\nreach = 2\n"), CodeFile("beside.py", "b" * 12, "")),
)


@pytest.fixture(autouse=True)
def wide(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setenv("NO_COLOR", "1")


def test_a_load_is_printed_with_its_level_and_times_and_each_notice_once(
    capsys: pytest.CaptureFixture[str],
) -> None:
    geometry, poses = table_scene(2)
    task = replace(description(geometry, ()), notices=("about [cameras]", "about shapes"))
    loaded = Loaded(task, step_of(poses), {"import": 20.4, "build": 100.0})
    reload = ReloadReport(level="patched", reason="only evaluate changed")
    for event in (loaded, replace(loaded, reload=reload)):
        print_event(event)
    first, second = (printed := capsys.readouterr()).out.splitlines()
    assert first == f"loaded {task.env_id} in 120 ms (import 20, build 100)"
    assert second == f"patched {task.env_id}: only evaluate changed in 120 ms (import 20, build 100)"
    assert printed.err.splitlines() == ["about [cameras]", "about shapes"]


def test_a_failure_is_printed_with_its_line_and_what_runs_now(capsys: pytest.CaptureFixture[str]) -> None:
    failed = TaskFailed(PROBLEM, kept=False)
    policy = replace(PROBLEM, stage="policy")
    ends = set()
    print_problem(PROBLEM)
    alone = capsys.readouterr().err
    place, code, *trace = alone.splitlines()
    assert "/w/task.py:12: KeyError: '[x]'" in place and code == "    a['[x]']"
    assert trace == ["Traceback", "  in [evaluate]"]
    for event in (
        failed,
        replace(failed, kept=True),
        replace(failed, kept=True, spoiled="a thread"),
        replace(failed, kept=True, at_run=True),
        replace(failed, kept=True, at_run=True, spoiled="a thread"),
        replace(failed, problem=policy, kept=True, at_run=True),
    ):
        print_event(event)
        printed = capsys.readouterr().err
        if event.problem is PROBLEM:
            assert printed.startswith(alone)
        assert ("a thread" in printed) == bool(event.at_run and event.spoiled)
        assert ("policy" in printed) == (event.problem is policy)
        assert ("paused" in printed.splitlines()[-1] and "reset" in printed) == event.at_run
        ends.add(printed.splitlines()[-1])
    assert len(ends) == 6
    print_event(TaskFailed(replace(PROBLEM, stage="worker"), kept=True))
    assert capsys.readouterr().err.splitlines()[-1] in ends, "as after any failure that ends the process"


def test_only_new_findings_are_printed(capsys: pytest.CaptureFixture[str]) -> None:
    old, new = (
        Finding("info-rows", "warn", f"{age} [message]", "/w/task.py", 3, "a[0]", "evaluate", 1, 0)
        for age in ("old", "new")
    )
    print_event(RulesBroken((old, new), new=(new,)))
    printed = capsys.readouterr().err
    assert "old" not in printed and "/w/task.py:3: new [message] (rule info-rows)" in printed
    assert printed.splitlines()[1] == "    a[0]"


def test_failures_are_printed_by_kind_with_the_names_of_their_items(
    capsys: pytest.CaptureFixture[str],
) -> None:
    other = replace(PROBLEM, line=99)
    failures = [Failure((4,), PROBLEM), Failure((7,), other), Failure((2, 3), PROBLEM)]
    print_failures(failures, lambda number: f"seed {number + 10}")
    printed = capsys.readouterr().err
    assert printed.count("/w/task.py:12") == printed.count("/w/task.py:99") == 1
    items = [line.strip() for line in printed.splitlines() if "seed" in line]
    assert items == [
        "3 items without a result: seed 12, seed 13, seed 14",
        "1 item without a result: seed 17",
    ]


def test_messages_go_to_stderr_with_their_exit_codes(capsys: pytest.CaptureFixture[str]) -> None:
    assert (refuse("no [file]\x1b"), interrupted(), interrupted("kept")) == (Exit.REFUSED, 130, 130)
    warn("careful")
    assert capsys.readouterr().err.splitlines() == [
        "no [file]\\x1b", "interrupted", "interrupted; kept", "careful",
    ]  # fmt: skip
    print_addresses(["http://a/", "http://b/"])
    first, second = capsys.readouterr().out.splitlines()
    assert first.split() == ["page", "http://a/"] and second.split() == ["or", "http://b/"]


@pytest.mark.parametrize("colours", [True, False])
def test_the_tasks_own_lines_are_marked_and_coloured_only_in_a_colour_terminal(
    colours: bool, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        output, "out", SimpleNamespace(color_system="256" if colours else None, no_color=False)
    )
    print_line(PrintedLine("stdout", "plain"))
    print_line(PrintedLine("stdout", "red", (StyledText("red", Style(color="color(1)")),)))
    first, second = capsys.readouterr().out.splitlines()
    assert first == "  | plain" and ("\x1b" in second) == colours and second.startswith("  | ")


# --- questions -------------------------------------------------------------------------------------------


class Recorded:
    """A console and the context in which nothing else prints."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.quiet_in: list[bool] = []
        self._quiet = False

    def print(self, text: object = "", **_: Any) -> None:
        self.lines.append(str(text))
        self.quiet_in.append(self._quiet)

    @contextmanager
    def quiet(self) -> Iterator[None]:
        self._quiet = True
        yield
        self._quiet = False


@pytest.mark.parametrize(
    ("typed", "answer"),
    [
        (["y"], Consent.ONCE),
        ([" YES "], Consent.ONCE),
        (["a"], Consent.ALWAYS),
        (["always"], Consent.ALWAYS),
        (["q"], Consent.NONE),
        (["n"], Consent.NO),
        ([""], Consent.NO),
        (["yess"], Consent.NO),
        ([], Consent.NO),
        (["show", "s", "y"], Consent.ONCE),
        (["show"], Consent.NO),
    ],
)
def test_only_a_clear_yes_in_the_terminal_runs_code(
    typed: list[str], answer: Consent, monkeypatch: pytest.MonkeyPatch
) -> None:
    answers = iter(typed)

    def read() -> str:
        try:
            return next(answers)
        except StopIteration:
            raise EOFError from None

    monkeypatch.setattr("builtins.input", read)
    console: Any = Recorded()
    assert TerminalPrompt(console, console.quiet).ask(PUSH, lambda: False) is answer
    asked = sum("Run it?" in line for line in console.lines)
    shown = sum("reach = 2" in line for line in console.lines)
    assert asked == len(typed) + (typed[-1:] in ([], ["show"])) and shown == sum(
        one in ("s", "show") for one in typed
    )
    assert all(console.quiet_in) and any("/w/push.py" in line for line in console.lines)


def test_the_number_of_other_questions_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("builtins.input", lambda: "n")
    console: Any = Recorded()
    for more in (0, 3):
        console.lines.clear()
        TerminalPrompt(console, console.quiet).ask(replace(PUSH, more=more), lambda: False)
        (asked,) = [line for line in console.lines if "Run it?" in line]
        assert ("q:" in asked) == bool(more) and ("3 others" in asked) == bool(more)


def test_code_that_was_not_allowed_is_named_with_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    can_ask: Callable[[bool], None] = lambda can: monkeypatch.setattr(output, "can_ask", lambda: can)  # noqa: E731
    can_ask(False)
    (reason,) = not_trusted_lines(NotTrusted((), ["it names a file"]))
    assert "it names a file" in reason and "--trust" in reason
    files = (replace(PUSH.files[0], name="/w/other.py"),)
    lines = "\n".join(not_trusted_lines(NotTrusted([PUSH, replace(PUSH, files=files)], ["it names a file"])))
    assert all(said in lines for said in ("it names a file", "/w/push.py", "/w/other.py", "a" * 12, "--task"))
    assert f"beside.py ({'b' * 12})" in lines and "more" not in lines
    many = [
        replace(PUSH, files=(replace(PUSH.files[0], name=f"/w/{number}.py"),))
        for number in range(MAX_QUESTIONS + 2)
    ]
    lines = "\n".join(not_trusted_lines(NotTrusted(many)))
    assert f"/w/{MAX_QUESTIONS - 1}.py" in lines and f"/w/{MAX_QUESTIONS}.py" not in lines
    assert "and 2 more" in lines
    can_ask(True)
    (said,) = not_trusted_lines(NotTrusted([PUSH]))
    assert "push.py" not in said, "the person has just read it"


MANY = tuple(CodeFile(f"m{k}.py", f"{k:012}", "") for k in range(60))


def printed(question: TrustQuestion, what: object = print_question) -> str:
    out = io.StringIO()
    assert callable(what)
    what(question, Console(file=out, width=80))
    return out.getvalue()


def test_every_file_is_named_with_its_hash_and_its_change() -> None:
    main = CodeFile("/w/push.py", "a" * 12, "", Since.CHANGED)
    output = printed(TrustQuestion("Push-v1", False, (main, *MANY), trusted_before=True, gone=("old.py",)))
    lines = output.splitlines()
    assert f"    /w/push.py  {main.hash}  changed since" in lines
    assert all(f"    {one.name}  {one.hash}" in lines for one in MANY)
    assert "It imports these modules next to it:" in lines and "removed since: old.py" in output
    output = printed(TrustQuestion("Push-v1", False, (main, *MANY), computed=True))
    assert "it may import every module next to it" in output and "It imports" not in output


def test_a_file_is_printed_unchanged_and_as_plain_text() -> None:
    text = "x = '[bold] :x: \x1b[2J \u202e'\n\treturn 1\n"
    output = printed(TrustQuestion("Push-v1", True, (CodeFile("push.py", "0" * 12, text),)), print_texts)
    assert r"x = '[bold] :x: \x1b[2J \u202e'" in output and "\x1b" not in output and "return 1" in output
