"""The walk of the tutorial, done in its order with the files that it gives: each mistake gives the message that the page quotes."""

from __future__ import annotations

import linecache
import re
from pathlib import Path

import pytest

import workbench
from tests.docs.pages import Fence
from tests.docs.test_fences import commands, opens
from tests.docs.walk import FILE, STEPS, Step, after, mistake, write
from workbench.checks.rules import RULES
from workbench.cli.main import main

UNTIL_LATER = {"3. The scene": {"kinematic-never-moved"}, "4. Where an episode begins": {"success-at-reset"}}
"""What the page says that a step leaves to the next one."""
QUICK = {"record": ["--no-pictures"], "check": ["--workers", "1"]}
"""Put behind what the page says to type: pictures take seconds of a process's first."""
_RULE = re.compile(rf"^{re.escape(FILE)}:\d+: ([\w-]+) \(", re.MULTILINE)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")
    return tmp_path


@pytest.mark.parametrize("step", STEPS, ids=lambda step: step.title)
def test_a_step_does_what_the_page_says(
    step: Step, folder: Path, child_process: None, capfd: pytest.CaptureFixture[str]
) -> None:
    walk(step, folder, capfd, ("", "fragment"))
    # As the reader leaves it: what the mistakes broke is kept, and any envs can be reset and stepped.
    named = {rule for fence in step.fences if fence.language == "text" for rule in _RULE.findall(fence.text)}
    said = type_in(["check", FILE, "--select", ",".join(sorted({"runs", *named}))], capfd)
    assert " 0 broken" in said, said


@pytest.mark.slow
@pytest.mark.parametrize("step", STEPS, ids=lambda step: step.title)
def test_a_step_with_pictures_and_pages_does_what_the_page_says(
    step: Step, folder: Path, renderer: None, child_process: None, capfd: pytest.CaptureFixture[str]
) -> None:
    walk(step, folder, capfd, ("", "fragment", "slow"))
    said = type_in(["check", FILE], capfd)
    assert set(_RULE.findall(said)) == UNTIL_LATER.get(step.title, set()), said


def test_the_last_step_leaves_an_episode_with_success(
    folder: Path, child_process: None, capfd: pytest.CaptureFixture[str]
) -> None:
    walk(STEPS[-1], folder, capfd, ("", "fragment"))
    (description,) = (folder / "recordings").glob("*.json")
    episode = workbench.read_episode(description)
    assert episode.success and 10 < len(episode.action) < 50


def test_what_is_quoted_is_of_all_steps_and_the_whole_page() -> None:
    """A heading or a fence that the walk overlooks would be checked by nobody."""
    assert [step.title.split(".")[0] for step in STEPS] == [str(number) for number in range(1, 11)]
    quoted = [fence for step in STEPS for fence in step.fences if fence.language == "diff"]
    assert len(quoted) >= 14
    assert {rule for step in STEPS for fence in step.fences for rule in _RULE.findall(fence.text)} <= set(
        RULES
    )


def walk(step: Step, folder: Path, capfd: pytest.CaptureFixture[str], marks: tuple[str, ...]) -> None:
    """Do a step, in a folder where those before it are done."""
    after(STEPS.index(step), folder)
    file = folder / FILE
    for fence, below in zip(step.fences, (*step.fences[1:], None)):
        if fence.mark not in marks:
            continue
        if fence.language == "python":
            write(fence, folder)
        elif fence.language == "sh":
            for words in commands(fence):
                expect(type_there(words[1:], folder, "slow" in marks, capfd), below)
        elif fence.language == "diff":
            right = file.read_text()
            file.write_text(mistake(fence, right))
            assert below is not None and below.language == "text", f"{fence.place}: its message is missing"
            rules = _RULE.findall(below.text)
            assert rules, f"{below.place} names no rule"
            expect(type_in(["check", FILE, "--select", ",".join(rules)], capfd), below)
            file.write_text(right)


def type_there(words: list[str], folder: Path, slow: bool, capfd: pytest.CaptureFixture[str]) -> str:
    """What a command prints; empty for one that is for `make test-all` alone."""
    whole = words[0] in ("open", "review") or (words[0] == "check" and "--select" not in words)
    if not whole:
        return type_in(words, capfd)
    if slow and words[0] != "check":
        opens(["workbench", *words], folder)
    return type_in(words, capfd) if slow and words[0] == "check" else ""


def type_in(words: list[str], capfd: pytest.CaptureFixture[str]) -> str:
    """What a command prints in this process."""
    linecache.checkcache()
    capfd.readouterr()
    with pytest.raises(SystemExit):
        main([*words, *QUICK.get(words[0], [])])
    printed = capfd.readouterr()
    return f"{printed.out}\n{printed.err}"


def expect(said: str, below: Fence | None) -> None:
    """That each paragraph of the fence was said; ``...`` stands for anything."""
    if below is None or below.language != "text" or not said:
        return
    flat = " ".join(said.split())
    for paragraph in below.text.strip().split("\n\n"):
        parts = [re.escape(" ".join(part.split())) for part in paragraph.split("...")]
        assert re.search(r"\s?.*?\s?".join(parts), flat), f"{below.place}: {paragraph}\n\nis not in\n\n{said}"
