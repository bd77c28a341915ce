"""Follows the tutorial step by step with its own files: each mistake breaks the rule that the page quotes, at its line.

``WORKBENCH_RENEW=1`` updates the quotes to the current output of the checks.
"""

from __future__ import annotations

import linecache
import os
import re
from collections.abc import Iterator
from pathlib import Path
from textwrap import TextWrapper

import gymnasium
import pytest
from mani_skill.utils.registration import REGISTERED_ENVS

import workbench
from tests.docs.commands import OPENS_A_PAGE, commands, opens
from tests.docs.pages import Fence, fences
from tests.docs.walk import FILE, PAGE, STEPS, Step, after, mistake, write
from tests.drive.commands import exit_code

ENV_ID = "PushIt-v1"
UNTIL_LATER = {"3. The scene": {"kinematic-never-moved"}, "4. Where an episode begins": {"success-at-reset"}}
"""Broken rules that the page leaves to the next step, by step."""
QUICK = {"record": ["--no-pictures", "--workers", "1"], "check": ["--workers", "1"]}
"""Options added to the page's commands to save time: first pictures and extra processes take seconds each."""
OF_NUMBERS = "... times"
"""Marks a quote without numbers, because they differ slightly between machines."""
_PLACE = re.compile(rf"^{re.escape(FILE)}:\d+: [\w-]+ \(\w+", re.MULTILINE)
_RULE = re.compile(rf"^{re.escape(FILE)}:\d+: ([\w-]+) \(", re.MULTILINE)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")
    return tmp_path


@pytest.mark.slow
@pytest.mark.parametrize("step", STEPS, ids=lambda step: step.title)
def test_a_step_works_as_the_page_says(
    step: Step, folder: Path, renderer: None, child_process: None, capfd: pytest.CaptureFixture[str]
) -> None:
    after(STEPS.index(step), folder)
    for fence, below in pairs(step):
        if fence.language == "python":
            write(fence, folder)
        elif fence.language == "diff":
            check_mistake(fence, below, folder / FILE, capfd)
        elif fence.language == "sh":
            for words in commands(fence):
                if not is_long(words):
                    run_command(words[1:], capfd)
    # After the step, the rules that the mistakes broke are kept, and any envs can be reset and stepped.
    rules_shown = {
        rule for fence in step.fences if fence.language == "text" for rule in _RULE.findall(fence.text)
    }
    rules = ",".join(sorted({"runs", *rules_shown}))
    printed = run_command(["check", FILE, "--seeds", "8", "--select", rules], capfd)
    assert " 0 broken" in printed, printed
    if step is STEPS[-1]:
        (recorded,) = (folder / "recordings").glob("*.json")
        success = workbench.read_episode(recorded).evaluate["success"]
        assert success[-1].all() and not success[:-1].any() and len(success) > 10


@pytest.mark.slow
@pytest.mark.parametrize("step", STEPS, ids=lambda step: step.title)
def test_a_step_keeps_all_rules_and_opens(
    step: Step, folder: Path, renderer: None, child_process: None, capfd: pytest.CaptureFixture[str]
) -> None:
    """Except for the rules that the page leaves to the next step."""
    after(STEPS.index(step) + 1, folder)
    printed = run_command(["check", FILE], capfd)
    assert set(_RULE.findall(printed)) == UNTIL_LATER.get(step.title, set()), printed
    for fence in step.fences:
        for words in commands(fence) if fence.language == "sh" else ():
            if words[1] in OPENS_A_PAGE:
                opens(words, folder)
            elif words[1] == "record":
                run_command(words[1:], capfd)


def test_the_whole_page_is_covered() -> None:
    """No other test would check a heading or fence that the walk misses."""
    assert [step.title.split(".")[0] for step in STEPS] == [str(number) for number in range(1, 11)]
    assert sum(len(step.fences) for step in STEPS) == len(fences(PAGE))
    assert all(fence.mark in ("", "fragment") for fence in fences(PAGE))
    assert sum(fence.language == "diff" for fence in fences(PAGE)) >= 14


def pairs(step: Step) -> Iterator[tuple[Fence, Fence | None]]:
    """Each fence of a step with the next one."""
    return zip(step.fences, (*step.fences[1:], None))


def is_long(words: list[str]) -> bool:
    """Whether only `make test-all` runs the command: it opens a page, or checks every rule."""
    return words[1] in (*OPENS_A_PAGE, "check")


def check_mistake(fence: Fence, below: Fence | None, file: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """Make a mistake, check the rules that the fence below it quotes, and undo it."""
    assert below is not None and below.language == "text", f"{fence.place}: its message is missing below it"
    rules = _RULE.findall(below.text)
    assert rules, f"{below.place} names no rule"
    right = file.read_text()
    file.write_text(mistake(fence, right))
    printed = run_command(["check", FILE, "--select", ",".join(rules)], capfd)
    if os.environ.get("WORKBENCH_RENEW") and OF_NUMBERS not in below.text:
        PAGE.write_text(PAGE.read_text().replace(below.text, quoted(printed, rules)))
    else:
        assert set(_PLACE.findall(below.text)) <= set(_PLACE.findall(printed)), f"{below.place}:\n\n{printed}"
    file.write_text(right)


def quoted(printed: str, rules: list[str]) -> str:
    """The report of each rule, formatted as on the page."""
    found = [re.search(rf"^({FILE}:\d+: {rule} \(.+\))\n  (.+)$", printed, re.MULTILINE) for rule in rules]
    assert all(found), printed
    wrap = TextWrapper(98, initial_indent="  ", subsequent_indent="  ", break_on_hyphens=False)
    return "\n\n".join(f"{one[1]}\n{wrap.fill(one[2])}" for one in found if one) + "\n"


def run_command(words: list[str], capfd: pytest.CaptureFixture[str]) -> str:
    """Run a command in this process; returns its output."""
    linecache.checkcache()
    for known in (REGISTERED_ENVS, gymnasium.registry):
        # Start as in a new process: another test's recording may have left the task registered.
        known.pop(ENV_ID, None)
    capfd.readouterr()
    exit_code(*words, *QUICK.get(words[0], []))
    printed = capfd.readouterr()
    return f"{printed.out}\n{printed.err}"
