"""One task through everything that a user does with it, with default options: open, check, record, rescore, export, solve.

    python -m tests.sweeps.every_command                     all examples, templates and built-in tasks, a line each
    python -m tests.sweeps.every_command swing_up PickCube-v1

The commands are those of a terminal, in processes of their own. Only the length of episodes is bounded.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from tests.drive.session import live_session, step
from tests.drive.waiting import until
from workbench.authoring.templates.new_task import TEMPLATES
from workbench.session.checks.checks import RUNNING

ROOT = Path(__file__).parents[2]
EXAMPLES = tuple(sorted(file.stem for file in (ROOT / "tasks").glob("*.py")))
FROM_TEMPLATES = tuple(f"template {template.name}" for template in TEMPLATES)
STEPS = ("--max-steps", "10")
SECONDS = 1800.0
"""For one command, on a busy machine."""


def built_in() -> tuple[str, ...]:
    """The ids of ManiSkill that need no download, as the page of all ids lists them."""
    page = (ROOT / "web_assets" / "docs" / "reference" / "task_ids.md").read_text()
    rows = re.findall(r"^\| (\S+-v\d+) \| [^|]* \| ([^|]+) \|", page, re.M)
    return tuple(env_id for env_id, outcome in rows if outcome != "download")


@dataclass(frozen=True)
class Ran:
    """What came of one command."""

    task: str
    command: str
    code: int
    seconds: float
    told: Any
    """The JSON that it printed, if that was asked for; of ``open``, states of rules and findings."""
    err: str = ""

    def rules(self, state: str) -> dict[str, str]:
        """Of ``check`` and ``open``, why the rules of this state have it."""
        return {one["rule"]: one["why"] for one in self.told["rules"] if one["state"] == state}

    @property
    def broken(self) -> list[str]:
        return [one["rule"] for one in self.told["rules"] if one["state"] == "broken"]


def walk(task: str, folder: Path) -> Iterator[Ran]:
    """Each command on a task, as it is done.

    Args:
        task: the name of an example, ``template`` and the name of one, or an id.
        folder: empty; everything is written there.
    """
    reference = task
    if task in EXAMPLES:
        reference = f"{task}.py"
        for file in (ROOT / "tasks").glob(f"{task}.*"):
            shutil.copy(file, folder)
    elif task in FROM_TEMPLATES:
        reference = "from_template.py"
        made = command(task, "new", folder, "from_template", "--from", task.removeprefix("template "))
        assert made.code == 0, made.err
    yield opened(task, folder / reference if reference.endswith(".py") else reference, folder)
    yield command(task, "check", folder, reference, "--json")
    yield command(task, "record", folder, reference, *STEPS)
    yield command(task, "rescore", folder, "recordings", "--json")
    yield command(task, "export", folder, "recordings", "--lerobot", "lerobot")
    yield command(task, "export", folder, "recordings", "--maniskill", "demos.h5")
    yield command(task, "solve", folder, reference, "--seeds", "1", *STEPS, "--out", "solved", "--json")


def command(task: str, name: str, folder: Path, *words: str) -> Ran:
    """Run ``workbench`` in this folder."""
    began = time.monotonic()
    ended = subprocess.run(
        [sys.executable, "-m", "workbench.cli.main", name, *words],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=SECONDS,
    )
    told = json.loads(ended.stdout) if "--json" in words and ended.stdout.startswith(("{", "[")) else None
    words = (name, *(word for word in words if word in ("--lerobot", "--maniskill")))
    seconds = round(time.monotonic() - began, 1)
    return Ran(task, " ".join(words), ended.returncode, seconds, told, ended.stderr[-6000:])


def opened(task: str, reference: Path | str, folder: Path) -> Ran:
    """A session of it, as a page has one: opened, stepped, and all rules of the Checks tab looked at."""
    began = time.monotonic()
    with live_session(reference, folder / "live", num_envs=16, draw=True) as session:
        step(session, 3)
        session.check_now()
        until(
            lambda: session.view().checks.state not in RUNNING,
            "the end of the checks",
            SECONDS,
            seen=lambda: session.view().checks,
        )
        checks = session.view().checks
    rules = [{"rule": one.rule, "state": one.state, "why": one.why} for one in checks.results]
    told = {"state": checks.state, "why": checks.why, "total": checks.total, "rules": rules}
    return Ran(task, "open", 0 if checks.state == "done" else 2, round(time.monotonic() - began, 1), told)


def main(tasks: Sequence[str]) -> None:
    for task in tasks or (*EXAMPLES, *FROM_TEMPLATES, *built_in()):
        with tempfile.TemporaryDirectory() as folder:
            try:
                for ran in walk(task, Path(folder)):
                    print(json.dumps(asdict(ran)), flush=True)
            except Exception as error:
                print(json.dumps({"task": task, "crash": f"{type(error).__name__}: {error}"}), flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
