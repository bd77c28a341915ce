"""`workbench solve` over ManiSkill's tabletop and control tasks and the examples, as a table.

    python -m tests.sweeps.solve_tasks                         all tasks that are not in solve_tasks.json yet
    python -m tests.sweeps.solve_tasks PickCube-v1 --seeds 4   some tasks, again
    python -m tests.sweeps.solve_tasks --write                 what is there into web_assets/docs/reference/solved_tasks.md

A task is added to solve_tasks.json as soon as it is done, so a sweep that was stopped goes on. Tasks that need a download
or have no dense reward are left out. Control tasks have no success: what planned episodes of `CONTROL_STEPS` steps earn
stands beside what random and zero actions earn.
"""

from __future__ import annotations

import json
import os
import re
import tempfile
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import mean, median
from typing import Annotated, Any

import tyro

FILE = Path("solve_tasks.json")
ROOT = Path(__file__).parents[2]
PAGE = ROOT / "web_assets" / "docs" / "reference" / "solved_tasks.md"
MARKS = "<!-- solved -->\n", "<!-- /solved -->"
CONTROL_STEPS = 100
PLAIN = {"render_backend": "none"}


@dataclass(frozen=True)
class Options:
    tasks: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    """Ids, or files of `tasks/`; all if none are named."""
    seeds: int = 16
    workers: int = len(os.sched_getaffinity(0))
    write: bool = False
    """Put what is in the file into the docs page, and run nothing."""


@dataclass
class Row:
    """What came of one task."""

    task: str
    mode: str
    """Control mode."""
    seeds: int
    solved: int | None = None
    """None for a control task."""
    median_steps: float | None = None
    seconds: float = 0.0
    """Wall time, opening the task included, a seed."""
    why: tuple[str, ...] = ()
    """What stood in the way of the seeds that were not solved, and the verdicts."""
    returns: dict[str, float] | None = None
    """Of a control task, the mean reward a step, by who acts."""


def tasks() -> list[str]:
    """Ids and files with a dense reward that need no download, control tasks last."""
    import mani_skill.envs  # noqa: F401  registers the ids
    from mani_skill.utils.registration import REGISTERED_ENVS

    from workbench.core.env.task_env import default_reward_mode

    found: dict[str, list[str]] = {"tabletop": [], "control": []}
    for env_id, spec in REGISTERED_ENVS.items():
        kind = spec.cls.__module__.split(".")[-2]
        dense = default_reward_mode(spec.cls) in ("dense", "normalized_dense")
        if kind in found and dense and not spec.asset_download_ids:
            found[kind].append(env_id)
    files = [
        file
        for file in sorted((ROOT / "tasks").glob("*.py"))
        if "def compute_dense_reward" in file.read_text()
    ]
    return [*found["tabletop"], *(str(file.relative_to(ROOT)) for file in files), *found["control"]]


def solved(task: str, options: Options) -> Row:
    from workbench.jobs.record import RecordOptions, record
    from workbench.jobs.solve import SolveOptions, solve
    from workbench.jobs.task import TaskOptions
    from workbench.recording.reader.read_episode import read_episode

    with tempfile.TemporaryDirectory() as folder:
        what = SolveOptions(
            task, Path(folder), options.seeds, options.workers, options=TaskOptions(env_kwargs=PLAIN)
        )
        if not task.startswith("MS-"):
            report = solve(what)
            mode = read_episode(report.seeds[0].path).info.control_mode or ""
            reasons = [f"seed {one.seed} {one.in_the_way}" for one in report.seeds if one.in_the_way]
            verdicts = [f"{one.rule}: {one.message}" for one in report.verdicts]
            row = Row(
                task, mode, options.seeds, len(report.solved), report.median_steps, why=(*verdicts, *reasons)
            )
            row.seconds = round(report.seconds / options.seeds, 1)
            return row
        row = Row(task, "", options.seeds, returns={})
        for actions in ("solve", "random", "zero"):
            envs = TaskOptions(num_envs=options.workers, env_kwargs=PLAIN)
            done = record(
                RecordOptions(
                    task,
                    Path(folder, actions),
                    options.seeds,
                    actions=actions,
                    pictures=False,
                    max_steps=CONTROL_STEPS,
                    workers=options.workers,
                    options=envs,
                )
            )
            assert row.returns is not None
            row.returns[actions] = round(mean(one.total_reward / one.steps for one in done.written), 4)
            if actions == "solve":
                row.mode = read_episode(done.written[0].path).info.control_mode or ""
                row.median_steps = median(one.steps for one in done.written)
        return row


def table(rows: list[Row]) -> Iterator[str]:
    yield "| task | control mode | solved | control steps (median) | seconds a seed | why not |"
    yield "| --- | --- | ---: | ---: | ---: | --- |"
    for row in rows:
        if row.solved is not None:
            steps = "" if row.median_steps is None else f"{row.median_steps:g}"
            why = "; ".join(row.why).replace("|", "/")
            yield f"| {row.task} | {row.mode} | {row.solved} of {row.seeds} | {steps} | {row.seconds:.0f} | {why} |"
    control = [row for row in rows if row.returns]
    if control:
        yield ""
        yield "| control task | control mode | steps (median) | planned, reward a step | random | zero |"
        yield "| --- | --- | ---: | ---: | ---: | ---: |"
    for row in control:
        earned = row.returns or {}
        told = " | ".join(f"{earned.get(name, float('nan')):.3f}" for name in ("solve", "random", "zero"))
        yield f"| {row.task} | {row.mode} | {row.median_steps:g} | {told} |"


def write(rows: list[Row]) -> None:
    page = PAGE.read_text()
    pattern = f"{re.escape(MARKS[0])}.*?{re.escape(MARKS[1])}"
    text = "\n".join([*table(rows), ""])
    PAGE.write_text(re.sub(pattern, lambda _: f"{MARKS[0]}{text}{MARKS[1]}", page, flags=re.DOTALL))


def main(options: Options) -> None:
    known: dict[str, Any] = json.loads(FILE.read_text()) if FILE.exists() else {}
    if options.write:
        return write([Row(**known[task]) for task in tasks() if task in known])
    for task in options.tasks or [task for task in tasks() if task not in known]:
        try:
            row = solved(task, options)
        except Exception as error:
            row = Row(task, "", options.seeds, 0, why=(f"{type(error).__name__}: {error}",))
        known[task] = asdict(row)
        FILE.write_text(json.dumps(known, indent=1))
        print(*table([row]), sep="\n", flush=True)


if __name__ == "__main__":
    main(tyro.cli(Options))
