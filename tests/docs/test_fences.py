"""Every fence in README and the docs works: it is run, parsed, or gives the error message that the page shows."""

from __future__ import annotations

import ast
import functools
import io
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import textwrap
import warnings
from contextlib import redirect_stdout
from itertools import pairwise
from pathlib import Path

import pytest
import torch
import tyro
import yaml

from tests.docs.commands import OPENS_A_PAGE, commands, opens
from tests.docs.pages import PAGES, ROOT, Fence, fences, without_fences
from workbench.cli import job_commands as jobs
from workbench.cli import main

KINDS = {
    *(("python", mark) for mark in ("", "slow", "fragment", "wrong")),
    *(("sh", mark) for mark in ("", "slow", "fragment", "wrong")),
    ("json", ""),
    ("yaml", ""),
    ("diff", ""),
    ("text", ""),
}
RUN = ("", "slow", "wrong")
JOBS = {name: getattr(jobs, name) for name in ("record", "check", "solve", "sweep", "merge", "rescore")}
OTHER_COMMANDS = {
    name: getattr(main, name) for name in ("new", "review", "share", "export", "view", "doctor")
}
COMMANDS = {"open": main.open_page, **JOBS, **OTHER_COMMANDS}
TYPED = [
    page for page in PAGES if any(f.language in ("python", "sh") and f.mark in RUN for f in fences(page))
]


def check_that_it_learns(printed: str) -> None:
    """Assert that the example of the page on the batched env improves its policy."""
    shares = [float(share) for share in re.findall(r"succeeded ([\d.]+)", printed)]
    assert len(shares) >= 2 and shares[-1] > shares[0] + 0.2, shares


PRINTS = {
    "batched_env": lambda printed: all(
        words in printed for words in ("actor cube", "{}", "table-workspace")
    ),  # the restore report, and a contact
    "api": lambda printed: "table-workspace" in printed,
}
"""Checks of the Python output that a page promises, by page."""
FEWER = {("--seeds", "8"): "2", ("--successes", "20"): "2", ("--episodes", "8"): "2"}
"""Maps a flag and its number on a page to a smaller number for the test: the page's numbers take many minutes."""


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_a_fence_names_its_kind(page: Path) -> None:
    kinds = {(fence.language, fence.mark) for fence in fences(page)}
    assert kinds <= KINDS
    prose = without_fences(page)
    assert "```" not in prose
    # No test would run code that is indented by four spaces.
    assert re.findall(r"\n\n    .*", prose) == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_a_fragment_is_well_formed(page: Path) -> None:
    for fence in fences(page):
        if fence.language == "json":
            json.loads(fence.text)
        elif fence.language == "yaml":
            assert yaml.safe_load(fence.text), fence.place
        elif fence.language == "python":
            ast.parse(textwrap.dedent(fence.text), fence.place)
        elif fence.language == "sh":
            for words in commands(fence):
                well_formed(words, fence)


def well_formed(words: list[str], fence: Fence) -> None:
    if words[0] == "workbench" and len(words) > 1:
        # Only the arguments are parsed; the command does not run.
        command = functools.wraps(COMMANDS[words[1]])(lambda *args, **named: 0)
        config = (tyro.conf.OmitArgPrefixes, tyro.conf.DisallowNone)
        assert tyro.cli(command, args=words[2:], config=config) == 0, fence.place
    elif words[0] == "make":
        targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), flags=re.MULTILINE))
        assert {word for word in words[1:] if "=" not in word} <= targets, fence.place


@pytest.fixture
def desk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the files that the pages assume: the examples, a task, a policy, and a package with a task."""
    shutil.copytree(ROOT / "tasks", tmp_path / "tasks", ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "tasks" / "push_cube.py", tmp_path / "my_task.py")
    shutil.copy(ROOT / "tests" / "browser" / "pusher.py", tmp_path / "my_policy.py")
    text = (ROOT / "tasks" / "minimal.py").read_text()
    (tmp_path / "lab").mkdir()
    (tmp_path / "lab" / "__init__.py").touch()
    (tmp_path / "lab" / "tasks.py").write_text(
        text.replace("WorkbenchMinimal-v1", "MyTask-v1").replace("MinimalEnv", "MyEnv")
    )
    bin_folder = tmp_path / "bin"
    bin_folder.mkdir()
    (bin_folder / "workbench").symlink_to(Path(sys.executable).parent / "workbench")
    monkeypatch.setenv("PATH", f"{bin_folder}:{os.environ['PATH']}")
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.slow
@pytest.mark.parametrize("page", TYPED, ids=lambda page: page.stem)
def test_the_commands_of_a_page_work(page: Path, desk: Path, renderer: None, child_process: None) -> None:
    printed = type_all(page, desk, ("", "wrong"))
    if page.stem in PRINTS:
        assert PRINTS[page.stem](printed), printed


@pytest.mark.slow
@pytest.mark.timeout(1500)
@pytest.mark.parametrize(
    "page",
    [page for page in TYPED if any(f.mark == "slow" for f in fences(page))],
    ids=lambda page: page.stem,
)
def test_the_slow_commands_of_a_page_work_too(
    page: Path, desk: Path, renderer: None, child_process: None
) -> None:
    printed = type_all(page, desk, RUN)
    if page.stem == "batched_env":
        check_that_it_learns(printed)


def type_all(page: Path, desk: Path, marks: tuple[str, ...]) -> str:
    """Run the fences of a page in its order; returns what its Python printed."""
    names: dict[str, object] = {"__name__": "__main__"}
    out = io.StringIO()
    threads = torch.get_num_threads()
    try:
        for fence, below in zip(fences(page), (*fences(page)[1:], None)):
            if fence.mark not in marks or fence.language not in ("python", "sh"):
                continue
            wanted = promised(fence, below)
            if fence.language == "python":
                run_python(fence, names, out, wanted)
            else:
                for words in commands(fence):
                    run_command(words, fence, desk, wanted)
    finally:
        torch.set_num_threads(threads)
    return out.getvalue()


def promised(fence: Fence, below: Fence | None) -> str | None:
    """The error message that a fence marked ``wrong`` must give."""
    if fence.mark != "wrong":
        return None
    assert below is not None and below.language == "text", f"{fence.place}: its message is missing below it"
    return " ".join(below.text.split())


def run_python(fence: Fence, names: dict[str, object], out: io.StringIO, wanted: str | None) -> None:
    # Keeps the page's line numbers in tracebacks.
    code = compile("\n" * (fence.line - 1) + fence.text, str(fence.page), "exec")
    with redirect_stdout(out), warnings.catch_warnings():
        if wanted is None:
            warnings.simplefilter("error", UserWarning)
            exec(code, names)
            return
        with pytest.raises(Exception) as raised:
            exec(code, names)
    printed = " ".join(f"{type(raised.value).__name__}: {raised.value}".split())
    assert wanted in printed, f"{fence.place} says {printed}"


def run_command(words: list[str], fence: Fence, desk: Path, wanted: str | None) -> None:
    if words[:2] == ["workbench", "new"]:
        # The folder already has a task, for pages that assume one.
        (desk / f"{words[2]}.py").unlink(missing_ok=True)
    if wanted is None and words[:1] == ["workbench"] and words[1] in OPENS_A_PAGE:
        opens(words, desk)
        return
    words = [FEWER.get((flag, number), number) for flag, number in pairwise(["", *words])]
    ended = subprocess.run(
        words, cwd=desk, capture_output=True, text=True, stdin=subprocess.DEVNULL, timeout=800
    )
    printed = " ".join((ended.stdout + ended.stderr).split())
    assert (ended.returncode == 0) == (wanted is None), f"{fence.place}: {shlex.join(words)} says {printed}"
    assert wanted is None or wanted in printed, f"{fence.place}: {shlex.join(words)} says {printed}"
