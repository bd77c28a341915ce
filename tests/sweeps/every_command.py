"""Run every command on a task with default options: open, check, record, rescore, export, solve.

    python -m tests.sweeps.every_command                     all examples, templates and built-in tasks, one line each
    python -m tests.sweeps.every_command swing_up PickCube-v1
    python -m tests.sweeps.every_command --quick     few envs, seeds and rollouts in one process: 20 times faster

Commands run in their own processes, as from a terminal, except ``new`` and ``export``. Only the length of episodes and the
candidates of ``solve`` are limited.
"""

from __future__ import annotations

import io
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import chdir, redirect_stderr, redirect_stdout
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from tests.drive.session import live_session, step
from tests.drive.waiting import until
from tests.sweeps.upstream_faults import faults_of
from workbench.checks.commands import CheckNow
from workbench.checks.state import RUNNING, ChecksView
from workbench.cli.main import main as workbench
from workbench.envs.action_vector import hold_action
from workbench.task.description import TaskOptions
from workbench.task.load import undo_load
from workbench.task.new_task import TEMPLATES
from workbench.task.open import open_task

ROOT = Path(__file__).parents[2]
EXAMPLES = tuple(sorted(file.stem for file in (ROOT / "tasks").glob("*.py")))
FROM_TEMPLATES = tuple(f"template {template.name}" for template in TEMPLATES)
COMMAND_TIMEOUT_SECONDS = 1800.0
"""Timeout of one command; generous for a busy machine."""
ALONE = ("--workers", "1", "--num-envs", "2")
FEW_CANDIDATES = "--rollouts", "4", "--knots", "2"
FEW: Mapping[str, Sequence[str]] = {
    "check": (*ALONE, "--seeds", "2"),
    "record": (*ALONE, "--episodes", "2"),
    "rescore": ALONE,
    "solve": ("--workers", "1"),
}
"""Options of each command in a quick walk."""


def built_in() -> tuple[str, ...]:
    """Return ManiSkill's ids that need no download, as listed on the docs page of all ids."""
    page = (ROOT / "web_assets" / "docs" / "reference" / "task_ids.md").read_text()
    rows = re.findall(r"^\| (\S+-v\d+) \| [^|]* \| ([^|]+) \|", page, re.M)
    return tuple(env_id for env_id, outcome in rows if outcome != "download")


def fails_in_partial_resets(task: str) -> bool:
    return "partial reset" in faults_of(task)


@dataclass(frozen=True)
class Ran:
    """Result of one command."""

    task: str
    command: str
    code: int
    seconds: float
    output: Any
    """The printed JSON with ``--json``, else None; for ``open``, the states of rules and the findings."""
    err: str = ""

    def rules(self, state: str) -> dict[str, str]:
        """Return the reasons of all rules in this state, for ``check`` and ``open``."""
        return {one["rule"]: one["why"] for one in self.output["rules"] if one["state"] == state}

    @property
    def broken(self) -> list[str]:
        return [one["rule"] for one in self.output["rules"] if one["state"] == "broken"]


def walk(task: str, folder: Path, quick: bool = False, checks: bool = True) -> Iterator[Ran]:
    """Run each command on a task and yield its result.

    Args:
        task: the name of an example, ``template NAME``, or an env id.
        folder: an empty folder for all output.
        quick: run in this process with the options of `FEW`; ``open`` without a session.
        checks: also run all rules in the session, as its Checks tab does.

    ManiSkill's tasks that fail in a partial reset run with one env where a batch is refused.
    """
    alone = ("--num-envs", "1") if fails_in_partial_resets(task) else ()
    num_envs = 1 if alone else 16
    steps = "--max-steps", "3" if quick else "10"
    reference, command = task, in_this_process if quick else in_a_process
    if task in EXAMPLES:
        reference = f"{task}.py"
        for file in (ROOT / "tasks").glob(f"{task}.*"):
            shutil.copy(file, folder)
    elif task in FROM_TEMPLATES:
        reference = "from_template.py"
        created = in_this_process(
            task, "new", folder, "from_template", "--from", task.removeprefix("template ")
        )
        assert created.code == 0, created.err
    at = folder / reference if reference.endswith(".py") else reference
    yield opened_here(task, at, num_envs) if quick else opened(task, at, folder, num_envs, checks)
    yield command(task, "check", folder, reference, "--json")
    yield command(task, "record", folder, reference, *steps, *alone)
    yield command(task, "rescore", folder, "recordings", "--json", *alone)
    # In this process, which saves two starts of Python; export does not depend on its process.
    yield in_this_process(task, "export", folder, "recordings", "--lerobot", "lerobot")
    yield in_this_process(task, "export", folder, "recordings", "--maniskill", "demos.h5")
    yield command(
        task, "solve", folder, reference, "--seeds", "1", *FEW_CANDIDATES, *steps, "--out", "solved", "--json"
    )


def in_this_process(task: str, name: str, folder: Path, *words: str) -> Ran:
    """Run ``workbench`` in this process in `folder`, with the options of `FEW`."""
    began, code = time.monotonic(), 0
    out, err = io.StringIO(), io.StringIO()
    with chdir(folder), redirect_stdout(out), redirect_stderr(err):
        try:
            workbench([name, *FEW.get(name, ()), *words])
        except SystemExit as ended:
            code = int(ended.code or 0)
    return _ran(task, name, words, code, began, out.getvalue(), err.getvalue())


def in_a_process(task: str, name: str, folder: Path, *words: str) -> Ran:
    """Run ``workbench`` in a new process in `folder`."""
    began = time.monotonic()
    ended = subprocess.run(
        [sys.executable, "-m", "workbench.cli.main", name, *words],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=COMMAND_TIMEOUT_SECONDS,
    )
    return _ran(task, name, words, ended.returncode, began, ended.stdout, ended.stderr)


def _ran(task: str, name: str, words: Sequence[str], code: int, began: float, out: str, err: str) -> Ran:
    output = json.loads(out) if "--json" in words and out.startswith(("{", "[")) else None
    words = (name, *(word for word in words if word in ("--lerobot", "--maniskill")))
    return Ran(task, " ".join(words), code, round(time.monotonic() - began, 1), output, err[-6000:])


def opened_here(task: str, reference: Path | str, num_envs: int) -> Ran:
    """Open the task as a session does, and step it."""
    began = time.monotonic()
    done = open_task(str(reference), TaskOptions(num_envs=num_envs))
    try:
        for _ in range(3):
            done.env.step(hold_action(done.env.parts, done.env.num_envs))
    finally:
        done.env.close()
        undo_load(done.loaded)
    return Ran(task, "open", 0, round(time.monotonic() - began, 1), None)


def opened(task: str, reference: Path | str, folder: Path, num_envs: int, checks: bool) -> Ran:
    """Open the task in a session as a page does, step it, and run all rules if `checks`."""
    began = time.monotonic()
    with live_session(reference, folder / "live", num_envs=num_envs, draw=True) as session:
        step(session, 3)
        if not checks:
            return Ran(task, "open", 0, round(time.monotonic() - began, 1), None)
        session.do(CheckNow())
        until(
            lambda: session.view().of(ChecksView).state not in RUNNING,
            "the end of the checks",
            COMMAND_TIMEOUT_SECONDS,
            seen=lambda: session.view().of(ChecksView),
        )
        view = session.view().of(ChecksView)
    rules = [{"rule": one.rule, "state": one.state, "why": one.why} for one in view.results]
    output = {"state": view.state, "why": view.why, "total": view.total, "rules": rules}
    return Ran(task, "open", 0 if view.state == "done" else 2, round(time.monotonic() - began, 1), output)


def main(words: Sequence[str]) -> None:
    quick, tasks = "--quick" in words, [word for word in words if word != "--quick"]
    for task in tasks or (*EXAMPLES, *FROM_TEMPLATES, *built_in()):
        with tempfile.TemporaryDirectory() as folder:
            try:
                for ran in walk(task, Path(folder), quick):
                    print(json.dumps(asdict(ran)), flush=True)
            except Exception as error:
                print(json.dumps({"task": task, "crash": f"{type(error).__name__}: {error}"}), flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
