"""Run `workbench solve` on ManiSkill's tabletop and control tasks and on the examples, and write a table.

    python -m tests.sweeps.solve_tasks                         all tasks that are not in solve_tasks.json yet
    python -m tests.sweeps.solve_tasks PickCube-v1 --seeds 4   some tasks
    python -m tests.sweeps.solve_tasks PickCube-v1 --again     delete the task's results first
    python -m tests.sweeps.solve_tasks --write                 write the results into web_assets/docs/reference/solved_tasks.md

Each episode is added to solve_tasks.json when it ends, so a stopped sweep can be resumed. The table and its verdicts come
from that file. Tasks that need a download or have no dense reward are left out. Control tasks have no success: the table
compares the reward of planned episodes of `CONTROL_STEPS` steps with random and zero actions. Times are CPU seconds of all
threads and processes, since wall time depends on the machine's load.
"""

from __future__ import annotations

import json
import os
import re
import resource
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from datetime import date
from importlib.metadata import version
from pathlib import Path
from statistics import mean, median
from typing import Annotated, Any

import numpy as np
import tyro

from workbench.machine.files import replace_file
from workbench.planning.planned_episodes import PlannedEpisode
from workbench.planning.verdicts import in_the_way, of_episodes

FILE = Path("solve_tasks.json")
ROOT = Path(__file__).parents[2]
PAGE = ROOT / "web_assets" / "docs" / "reference" / "solved_tasks.md"
MARKS = "<!-- solved -->\n", "<!-- /solved -->"
SEEDS = 16
CONTROL_SEEDS = 2
CONTROL_STEPS = 100
CARTPOLE_STEPS = 300
PLAIN = {"render_backend": "none"}
OWN_CONTROL = ("tasks/swing_up.py", "tasks/locomotion.py")
"""Examples without success; their episodes last until the time limit."""
DRAWN = ("PushT-v1",)
"""Tasks that cannot be built without a renderer."""


@dataclass(frozen=True)
class Options:
    tasks: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    """Env ids or files of `tasks/`; all by default."""
    seeds: int | None = None
    """Seeds of each task; 16 by default, and 2 for control tasks."""
    workers: int = len(os.sched_getaffinity(0))
    again: bool = False
    """Delete the stored results of these tasks first."""
    write: bool = False
    """Only write the stored results into the docs page."""


@dataclass
class Row:
    """Results of one task."""

    task: str
    mode: str = ""
    """Control mode."""
    episodes: list[dict[str, Any]] = field(default_factory=list)
    """Planned episodes of seeds 0, 1, ... in order: the fields of `PlannedEpisode`."""
    seconds: float = 0.0
    """CPU seconds of all episodes, including opening the task."""
    returns: dict[str, float] = field(default_factory=dict)
    """Mean reward per step of random and of zero actions; for control tasks only."""
    error: str = ""
    """Why it cannot be planned."""
    day: str = ""
    """Date of the last episode."""


def tasks() -> list[str]:
    """Return ids and files with a dense reward that need no download, control tasks last."""
    import mani_skill.envs  # noqa: F401  registers the ids
    from mani_skill.envs.sapien_env import BaseEnv
    from mani_skill.utils.registration import REGISTERED_ENVS

    from workbench.envs.assets import MissingAssets, require_assets, robots_of
    from workbench.envs.task_env import default_reward_mode

    found: dict[str, list[str]] = {"tabletop": [], "control": []}
    for env_id, spec in REGISTERED_ENVS.items():
        kind = spec.cls.__module__.split(".")[-2]
        # ManiSkill's humanoids declare a dense reward but do not implement it.
        has_one = spec.cls.compute_dense_reward is not BaseEnv.compute_dense_reward
        dense = has_one and default_reward_mode(spec.cls) in ("dense", "normalized_dense")
        if kind not in found or not dense or spec.asset_download_ids:
            continue
        with suppress(MissingAssets):
            require_assets(env_id, (), robots_of(spec.cls, spec.default_kwargs))
            found[kind].append(env_id)
    files = [
        file
        for file in sorted((ROOT / "tasks").glob("*.py"))
        if "def compute_dense_reward" in file.read_text()
    ]
    return [*found["tabletop"], *(str(file.relative_to(ROOT)) for file in files), *found["control"]]


def is_control(task: str) -> bool:
    """Whether the task has no success."""
    return task.startswith("MS-") or task in OWN_CONTROL


# --- running ----------------------------------------------------------------------------------------


class StoredRows:
    """The rows so far, stored in `FILE`."""

    def __init__(self) -> None:
        rows: dict[str, Any] = json.loads(FILE.read_text()) if FILE.exists() else {}
        self.rows = {task: Row(**row) for task, row in rows.items()}

    def of(self, task: str, again: bool) -> Row:
        if again:
            self.rows.pop(task, None)
        return self.rows.setdefault(task, Row(task))

    def save(self) -> None:
        replace_file(FILE, json.dumps({task: asdict(row) for task, row in self.rows.items()}).encode())


def run(row: Row, options: Options, stored: StoredRows) -> None:
    """Run the episodes that a row lacks; each is saved once all before it are done."""
    from workbench.episodes.reader.read_episode import read_episode
    from workbench.record.job import RecordProgress, record
    from workbench.record.job_worker import RecordOptions
    from workbench.solve.job import SolveOptions
    from workbench.task.description import TaskOptions

    control, task = is_control(row.task), row.task
    steps = (CARTPOLE_STEPS if "Cartpole" in task else CONTROL_STEPS) if task.startswith("MS-") else None
    seeds = options.seeds or (CONTROL_SEEDS if control else SEEDS)
    first, before, began = len(row.episodes), row.seconds, _cpu_seconds()
    ended: dict[int, dict[str, Any]] = {}

    def on_progress(progress: RecordProgress) -> None:
        if progress.over is None or (written := progress.over[1]) is None:
            return
        assert written.planned is not None
        ended[written.seed] = as_json(written.planned)
        row.mode = row.mode or read_episode(written.path).info.control_mode or ""
        while len(row.episodes) in ended:
            row.episodes.append(ended.pop(len(row.episodes)))
        row.day = date.today().isoformat()
        stored.save()
        print(f"{task} seed {written.seed}: {_outcome_text(written.planned)}", flush=True)

    with tempfile.TemporaryDirectory() as folder:
        if first < seeds:
            plain = TaskOptions(num_envs=1, seed=first, env_kwargs={} if task in DRAWN else PLAIN)
            what = SolveOptions(
                task, Path(folder), seeds - first, options.workers, False, steps, options=plain
            )
            record(what.recording(), on_progress=on_progress)
            # Measure after the job: RUSAGE_CHILDREN counts only processes that have ended.
            row.seconds = before + _cpu_seconds() - began
        for actions in ("random", "zero") if control and not row.returns else ():
            # One env, since the hoppers fail in partial resets.
            envs = TaskOptions(num_envs=1, env_kwargs=PLAIN)
            out = Path(folder, actions)
            plain_run = RecordOptions(
                task, out, seeds, actions=actions, pictures=False, max_steps=steps, options=envs
            )
            done = record(plain_run)
            row.returns[actions] = mean((one.total_reward or 0.0) / one.steps for one in done.written)
    stored.save()


def _cpu_seconds() -> float:
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(each.ru_utime + each.ru_stime for each in used)


def _outcome_text(episode: PlannedEpisode) -> str:
    if episode.solved_at:
        return f"solved at step {episode.solved_at}"
    return f"{episode.steps} steps, {episode.reward.mean():.3f} a step, {episode.reward[-1]:.3f} at its end"


def as_json(episode: PlannedEpisode) -> dict[str, Any]:
    fields = {
        name: getattr(value, "tolist", lambda value=value: value)() for name, value in vars(episode).items()
    }
    return {**fields, "terms": {name: term.tolist() for name, term in episode.terms.items()}}


def from_json(fields: dict[str, Any]) -> PlannedEpisode:
    kinds = {"success": np.bool_, "fail": np.bool_}
    rows = {
        name: np.array(value, kinds.get(name, np.float32))
        for name, value in fields.items()
        if isinstance(value, list)
    }
    terms = {name: np.array(term, np.float32) for name, term in fields["terms"].items()}
    return PlannedEpisode(**{**fields, **rows, "terms": terms})


# --- the table --------------------------------------------------------------------------------------


def table(rows: Sequence[Row]) -> Iterator[str]:
    yield "| task | control mode | solved | control steps (median) | CPU seconds per seed | verdicts |"
    yield "| --- | --- | ---: | ---: | ---: | --- |"
    for row in rows:
        if is_control(row.task):
            continue
        episodes = [from_json(fields) for fields in row.episodes]
        solved = [one.solved_at for one in episodes if one.solved_at]
        count = f"{len(solved)} of {len(episodes)}" if episodes else ""
        steps = f"{median(solved):g}" if solved else ""
        yield f"| {row.task} | {row.mode} | {count} | {steps} | {_seconds(row)} | {_cell(_why(row, episodes))} |"
    control = [row for row in rows if is_control(row.task)]
    if not control:
        return
    yield ""
    yield "| control task | control mode | seeds | steps (median) | reward per step, planned | random | zero | CPU seconds per seed |"
    yield "| --- | --- | ---: | ---: | ---: | ---: | ---: | ---: |"
    for row in control:
        episodes = [from_json(fields) for fields in row.episodes]
        planned = f"{mean(one.reward.mean() for one in episodes):.3f}" if episodes else row.error
        others = " | ".join(f"{row.returns[name]:.3f}" if row.returns else "" for name in ("random", "zero"))
        steps = f"{median(one.steps for one in episodes):g}" if episodes else ""
        if failed := sum(one.failed_at > 0 for one in episodes):
            steps += f", {failed} failed"
        yield (
            f"| {row.task} | {row.mode} | {len(episodes)} | {steps} | {_cell([planned])} | {others} | {_seconds(row)} |"
        )


def _seconds(row: Row) -> str:
    # Empty if the sweep was stopped during the task.
    return f"{row.seconds / len(row.episodes):.0f}" if row.episodes and row.seconds else ""


def _why(row: Row, episodes: Sequence[PlannedEpisode]) -> Iterator[str]:
    """Yield the verdicts, then the reasons for the unsolved seeds that no verdict covers."""
    if row.error:
        yield row.error
    verdicts = of_episodes(episodes)
    for one in verdicts:
        yield f"[{one.rule}](../rules/{one.rule}.md), {_seeds(one.seeds)}: {one.message}"
    covered = {seed for one in verdicts for seed in one.seeds}
    others: dict[str, list[int]] = {}
    for one in episodes:
        if not one.solved_at and one.seed not in covered:
            others.setdefault(in_the_way(one, episodes), []).append(one.seed)
    for text, found in others.items():
        yield f"{_seeds(found)}: {text}"


def _seeds(seeds: Sequence[int]) -> str:
    return f"seed{'s' if len(seeds) > 1 else ''} {', '.join(map(str, seeds))}"


def _cell(texts: Iterator[str] | Sequence[str]) -> str:
    return "; ".join(texts).replace("|", "/").replace("\n", " ")


def write(rows: Sequence[Row]) -> None:
    days = sorted({row.day for row in rows if row.day})
    ran = f"Run {' to '.join(dict.fromkeys((days[0], days[-1])))}" if days else "Not run yet"
    versions = ", ".join(f"{name} {version(name)}" for name in ("mani_skill", "sapien", "torch"))
    text = "\n".join([f"{ran}, with {versions}.", "", *table(rows), ""])
    pattern = f"{re.escape(MARKS[0])}.*?{re.escape(MARKS[1])}"
    page = PAGE.read_text()
    page = re.sub(pattern, lambda _: f"{MARKS[0]}{text}{MARKS[1]}", page, flags=re.DOTALL)
    replace_file(PAGE, page.encode())


def main(options: Options) -> None:
    stored = StoredRows()
    if options.write:
        return write([stored.rows[task] for task in tasks() if task in stored.rows])
    for task in options.tasks or tasks():
        row = stored.of(task, options.again)
        if row.error and not options.tasks:
            continue
        row.error = ""
        try:
            run(row, options, stored)
        except Exception as error:
            row.error, row.day = f"{type(error).__name__}: {error}", date.today().isoformat()
            stored.save()
        print(*table([row]), sep="\n", flush=True)


if __name__ == "__main__":
    main(tyro.cli(Options))
