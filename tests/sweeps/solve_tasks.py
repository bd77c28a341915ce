"""`workbench solve` over ManiSkill's tabletop and control tasks and the examples, as a table.

    python -m tests.sweeps.solve_tasks                         all tasks that are not in solve_tasks.json yet
    python -m tests.sweeps.solve_tasks PickCube-v1 --seeds 4   some tasks, again
    python -m tests.sweeps.solve_tasks --write                 what is there into web_assets/docs/reference/solved_tasks.md

A task is added to solve_tasks.json as soon as it is done, so a sweep that was stopped goes on. Tasks that need a download
or have no dense reward are left out. Control tasks have no success: what planned episodes of `CONTROL_STEPS` steps earn
stands beside what random and zero actions earn. Seconds are the processor's, of all threads and processes: the
wall's would say how busy the machine was.
"""

from __future__ import annotations

import json
import os
import re
import resource
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from datetime import date
from importlib.metadata import version
from pathlib import Path
from statistics import mean, median
from typing import Annotated, Any

import tyro

from workbench.machine.files import replace_file

FILE = Path("solve_tasks.json")
ROOT = Path(__file__).parents[2]
PAGE = ROOT / "web_assets" / "docs" / "reference" / "solved_tasks.md"
MARKS = "<!-- solved -->\n", "<!-- /solved -->"
CONTROL_STEPS = 100
CARTPOLE_STEPS = 300
SEEDS = 16
FEWER = {"PushT-v1": 4, "TwoRobotPickCube-v1": 4, "TwoRobotStackCube-v1": 4, "PullCubeTool-v1": 4}
"""Seeds of tasks whose episodes are long and whose steps are slow."""
CONTROL_SEEDS = 4
PLAIN = {"render_backend": "none"}


@dataclass(frozen=True)
class Options:
    tasks: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    """Ids, or files of `tasks/`; all if none are named."""
    seeds: int | None = None
    """16 if it is not given, and fewer for the slow ones."""
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
    """The processor's, opening the task included, a seed."""
    why: tuple[str, ...] = ()
    """The verdicts, and what stood in the way of the seeds that none of them has."""
    returns: dict[str, float] | None = None
    """Of a control task, the mean reward a step, by who acts."""
    day: str = ""
    """On which it ran."""


def tasks() -> list[str]:
    """Ids and files with a dense reward that need no download, control tasks last."""
    import mani_skill.envs  # noqa: F401  registers the ids
    from mani_skill.envs.sapien_env import BaseEnv
    from mani_skill.utils.registration import REGISTERED_ENVS

    from workbench.core.env.task_env import default_reward_mode

    found: dict[str, list[str]] = {"tabletop": [], "control": []}
    for env_id, spec in REGISTERED_ENVS.items():
        kind = spec.cls.__module__.split(".")[-2]
        # ManiSkill's humanoids declare a dense reward and have none.
        has_one = spec.cls.compute_dense_reward is not BaseEnv.compute_dense_reward
        dense = has_one and default_reward_mode(spec.cls) in ("dense", "normalized_dense")
        if kind in found and dense and not spec.asset_download_ids:
            found[kind].append(env_id)
    files = [
        file
        for file in sorted((ROOT / "tasks").glob("*.py"))
        if "def compute_dense_reward" in file.read_text()
    ]
    return [*found["tabletop"], *(str(file.relative_to(ROOT)) for file in files), *found["control"]]


def solved(task: str, options: Options) -> Row:
    began = _processor_seconds()
    control = task.startswith("MS-")
    seeds = options.seeds or (CONTROL_SEEDS if control else FEWER.get(task, SEEDS))
    with tempfile.TemporaryDirectory() as folder:
        row = (_earned if control else _solved)(task, seeds, options.workers, Path(folder))
    row.seconds = round((_processor_seconds() - began) / seeds, 1)
    return row


def _processor_seconds() -> float:
    return sum(
        used.ru_utime + used.ru_stime
        for used in map(resource.getrusage, (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    )


def _solved(task: str, seeds: int, workers: int, folder: Path) -> Row:
    from workbench.jobs.solve import SolveOptions, solve
    from workbench.jobs.task import TaskOptions
    from workbench.recording.reader.read_episode import read_episode

    report = solve(SolveOptions(task, folder, seeds, workers, options=TaskOptions(env_kwargs=PLAIN)))
    why = [
        f"[{one.rule}](../rules/{one.rule}.md), {_seeds(one.seeds)}: {one.message}" for one in report.verdicts
    ]
    told = {seed for one in report.verdicts for seed in one.seeds}
    others: dict[str, list[int]] = {}
    for one in report.seeds:
        if one.in_the_way and one.seed not in told:
            others.setdefault(one.in_the_way, []).append(one.seed)
    why += [f"{_seeds(found)}: {text}" for text, found in others.items()]
    mode = read_episode(report.seeds[0].path).info.control_mode or ""
    return Row(task, mode, seeds, len(report.solved), report.median_steps, why=tuple(why))


def _seeds(seeds: Sequence[int]) -> str:
    return f"seed{'s' if len(seeds) > 1 else ''} {', '.join(map(str, seeds))}"


def _earned(task: str, seeds: int, workers: int, folder: Path) -> Row:
    from workbench.jobs.record import RecordOptions, record
    from workbench.jobs.task import TaskOptions
    from workbench.recording.reader.read_episode import read_episode

    row, returns = Row(task, "", seeds), dict[str, float]()
    steps = CARTPOLE_STEPS if "Cartpole" in task else CONTROL_STEPS
    for actions in ("solve", "random", "zero"):
        envs = TaskOptions(num_envs=workers, env_kwargs=PLAIN)
        what = RecordOptions(
            task,
            folder / actions,
            seeds,
            actions=actions,
            pictures=False,
            max_steps=steps,
            workers=workers,
            options=envs,
        )
        done = record(what)
        returns[actions] = round(mean(one.total_reward / one.steps for one in done.written), 4)
        if actions == "solve":
            row.mode = read_episode(done.written[0].path).info.control_mode or ""
            row.median_steps = median(one.steps for one in done.written)
            ended = [one.seed for one in done.written if one.steps < steps]
            row.why = (f"{_seeds(ended)} ended before step {steps}",) if ended else ()
    row.returns = returns
    return row


def table(rows: list[Row]) -> Iterator[str]:
    yield "| task | control mode | solved | control steps (median) | processor seconds a seed | what the rollouts told |"
    yield "| --- | --- | ---: | ---: | ---: | --- |"
    for row in rows:
        if row.returns is None:
            steps = "" if row.median_steps is None else f"{row.median_steps:g}"
            count = "" if row.solved is None else f"{row.solved} of {row.seeds}"
            yield f"| {row.task} | {row.mode} | {count} | {steps} | {row.seconds:.0f} | {_told(row)} |"
    control = [row for row in rows if row.returns is not None]
    if not control:
        return
    yield ""
    yield "| control task | control mode | seeds | steps (median) | reward a step, planned | random | zero | what was seen |"
    yield "| --- | --- | ---: | ---: | ---: | ---: | ---: | --- |"
    for row in control:
        earned = row.returns or {}
        told = " | ".join(f"{earned[name]:.3f}" for name in ("solve", "random", "zero"))
        yield f"| {row.task} | {row.mode} | {row.seeds} | {row.median_steps:g} | {told} | {_told(row)} |"


def _told(row: Row) -> str:
    return "; ".join(row.why).replace("|", "/").replace("\n", " ")


def write(rows: list[Row]) -> None:
    days = sorted({row.day for row in rows})
    run = f"Run {' to '.join(dict.fromkeys((days[0], days[-1])))}" if days else "Not run yet"
    versions = ", ".join(f"{name} {version(name)}" for name in ("mani_skill", "sapien", "torch"))
    text = "\n".join([f"{run}, with {versions}.", "", *table(rows), ""])
    pattern = f"{re.escape(MARKS[0])}.*?{re.escape(MARKS[1])}"
    page = PAGE.read_text()
    page = re.sub(pattern, lambda _: f"{MARKS[0]}{text}{MARKS[1]}", page, flags=re.DOTALL)
    replace_file(PAGE, page.encode())


def main(options: Options) -> None:
    known: dict[str, Any] = json.loads(FILE.read_text()) if FILE.exists() else {}
    if options.write:
        return write([Row(**known[task]) for task in tasks() if task in known])
    for task in options.tasks or [task for task in tasks() if task not in known]:
        try:
            row = solved(task, options)
        except Exception as error:
            row = Row(task, "", 0, why=(f"{type(error).__name__}: {error}",))
        row.day = date.today().isoformat()
        known[task] = asdict(row)
        replace_file(FILE, json.dumps(known, indent=1).encode())
        print(*table([row]), sep="\n", flush=True)


if __name__ == "__main__":
    main(tyro.cli(Options))
