"""The cost of planning, compared with its bare steps: python tests/benchmarks/solve.py

For each task, alternately in one process: *quick* and *exact*, one plan of K rollouts of H steps for a live env in the
middle of an episode, with each of the two kinds of restore; *bare*, the same actions from the same state in K envs of
`workbench.make`, restored before the timing starts. Printed are the medians and their ratios.

    python tests/benchmarks/solve.py --write    # also writes a row of the table of benchmarks
    python tests/benchmarks/solve.py --demonstrations 20 --packages numpy1

``--demonstrations`` instead measures successes per hour of ``workbench record --actions solve --successes`` and of ManiSkill's
motion-planning scripts (`mani_skill.examples.motionplanning.panda.run`), each in one run with one process per core, start
included. The scripts need mplib; version 0.1.1, which ManiSkill pins, crashes with a segmentation fault with numpy 2, so the
scripts run with another numpy: ``pip install --no-deps --target numpy1 numpy==1.26.4``.
"""

# ManiSkill annotates an env's members with the widest types of all tasks.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mani_skill.envs  # noqa: F401  registers the ids
import torch
import tyro

sys.path.insert(0, str(Path(__file__).parents[2]))
import workbench
from tests.benchmarks.table import Row, keep
from workbench.envs.maniskill_private import open_env
from workbench.planning.options import PlanOptions
from workbench.planning.rollouts import RolloutPlanner, make_rollout_env

ROOT = Path(__file__).resolve().parents[2]
_TIMEOUT_SECONDS = 3600.0
KEPT_TASK = "PickCube-v1"
"""The task whose rows are in the table of benchmarks."""


@dataclass(frozen=True)
class Options:
    env_ids: tuple[str, ...] = ("PushCube-v1", "PickCube-v1", "StackCube-v1")
    turns: int = 9
    """Turns of each side; a turn is one plan, or as many bare steps."""
    steps: int = 5
    """Planned control steps of the live env before the measurement."""
    plan: PlanOptions = field(default_factory=PlanOptions)
    processor: bool = False
    """Measure the CPU time of all threads instead of the wall time, which is meaningless on a busy machine."""
    demonstrations: int = 0
    """Measure demonstrations instead of plans, with this number of successes per side."""
    packages: Path | None = None
    """A folder with packages that the motion-planning scripts import first."""
    write: bool = False
    """Write a row of the table of benchmarks, for `KEPT_TASK`."""


def seconds(action: Callable[[], Any], clock: Callable[[], float]) -> float:
    began = clock()
    action()
    return clock() - began


def measure(env_id: str, options: Options) -> dict[str, float]:
    """Seconds of each side, and the control steps of a plan."""
    made: dict[str, Any] = {"backend": "cpu", "render_backend": "none", "max_episode_steps": -1}
    live = workbench.make(env_id, 1, **made)
    many = workbench.make(env_id, options.plan.rollouts, rules="off", **made)
    rolled = make_rollout_env(open_env(live), live.spec.kwargs, options.plan.rollouts)  # type: ignore[union-attr]
    planners = {side: RolloutPlanner(rolled, options.plan, side == "exact") for side in ("quick", "exact")}
    horizon = planners["quick"].horizon
    live.reset(seed=0)
    for planner in planners.values():
        planner.begin(0, 0)
    for _ in range(options.steps):
        plan = planners["quick"].plan(workbench.take_snapshot(live), 0)
        live.step(torch.from_numpy(plan.actions[:1]))
    many.reset(seed=0)
    snapshot = workbench.take_snapshot(live)
    tried: list[Any] = []

    def restore() -> None:
        workbench.restore_snapshot(many, snapshot, range(options.plan.rollouts), source=0)

    def bare() -> None:
        for action in tried:
            many.step(action)

    def plan_with(side: str) -> Callable[[], None]:
        def plan() -> None:
            # Always the first plan of an episode, so that all sides make the same steps.
            planners[side].begin(0, 0)
            planners[side].plan(workbench.take_snapshot(live), 0)

        return plan

    sides: dict[str, Callable[[], None]] = {"bare": bare, **{side: plan_with(side) for side in planners}}
    step = rolled.step
    rolled.step = lambda action: tried.append(action.clone()) or step(action)  # type: ignore[method-assign, assignment]
    sides["exact"]()
    del rolled.step
    sides["quick"]()
    clock = time.process_time if options.processor else time.perf_counter
    took: dict[str, list[float]] = {name: [] for name in sides}
    for number in range(options.turns):
        for name in sorted(sides, reverse=bool(number % 2)):
            restore()
            took[name].append(seconds(sides[name], clock))
    for env in (live, many, rolled):
        env.close()
    return {name: statistics.median(each) for name, each in took.items()} | {"horizon": horizon}


def table(options: Options, kept: list[Row]) -> Iterator[str]:
    yield "| task | rollouts x steps | bare, ms | plan, quick restore, ms | plan, exact restore, ms | quick / bare | exact / bare |"
    yield "|---|---|---|---|---|---|---|"
    for env_id in options.env_ids:
        took = measure(env_id, options)
        bare, quick, exact = took["bare"], took["quick"], took["exact"]
        if env_id == KEPT_TASK:
            what = f"Planning {env_id}: a plan of {options.plan.rollouts} rollouts of {took['horizon']:.0f} steps"
            what += " with exact restores, against the bare steps"
            unit = "ms of CPU time" if options.processor else "ms"
            kept.append(Row(what, 1e3 * exact, 1e3 * bare, unit, "less", "solve.py"))
        yield (
            f"| {env_id} | {options.plan.rollouts} x {took['horizon']:.0f} | {1e3 * bare:.0f} | {1e3 * quick:.0f} | "
            f"{1e3 * exact:.0f} | {quick / bare:.2f} | {exact / bare:.2f} |"
        )


# --- demonstrations --------------------------------------------------------------------------------------


def demonstration_commands(env_id: str, count: int, folder: Path) -> dict[str, list[str]]:
    """The command of each side."""
    cores = str(len(os.sched_getaffinity(0)))
    ours = ["workbench.cli.main", "record", env_id, "--actions", "solve", "--successes", str(count)]
    ours += ["--no-pictures", "--num-envs", "1", "--workers", cores]
    ours += ["--env", "render_backend=none", "--out", str(folder / "ours")]
    theirs = ["mani_skill.examples.motionplanning.panda.run", "--env-id", env_id, "--num-traj", str(count)]
    theirs += ["--only-count-success", "--num-procs", cores, "--sim-backend", "cpu"]
    theirs += ["--record-dir", str(folder / "theirs")]
    return {"solve": ours, "motion planning": theirs}


def demonstration_table(options: Options, kept: list[Row]) -> Iterator[str]:
    yield "| task | side | successes | wall, s | successes per hour | CPU seconds per success |"
    yield "|---|---|---|---|---|---|"
    for env_id in options.env_ids:
        rates: dict[str, float] = {}
        with tempfile.TemporaryDirectory() as folder:
            for side, command in demonstration_commands(env_id, options.demonstrations, Path(folder)).items():
                used, began = _children_seconds(), time.perf_counter()
                environment = dict(os.environ)
                if side != "solve" and options.packages is not None:
                    environment["PYTHONPATH"] = str(options.packages.resolve())
                subprocess.run(
                    [sys.executable, "-m", *command],
                    check=True,
                    cwd=ROOT,
                    env=environment,
                    stdout=subprocess.DEVNULL,
                    timeout=_TIMEOUT_SECONDS,  # their script waits forever for a crashed process
                )
                wall, processor = time.perf_counter() - began, _children_seconds() - used
                count = sum(map(_successes, Path(folder).rglob("*.json")))
                for file in Path(folder).rglob("*.json"):
                    file.unlink()
                rates[side] = 3600 * count / wall
                yield f"| {env_id} | {side} | {count} | {wall:.0f} | {rates[side]:.0f} | {processor / count:.1f} |"
        if env_id == KEPT_TASK:
            what = f"Planning {env_id}: demonstrations, against ManiSkill's motion-planning script"
            kept.append(
                Row(what, rates["solve"], rates["motion planning"], "successes/h", "more", "solve.py")
            )


def _successes(file: Path) -> int:
    return sum(bool(episode.get("success")) for episode in json.loads(file.read_text())["episodes"])


def _children_seconds() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def main(options: Options) -> None:
    torch.set_num_threads(1)
    kept: list[Row] = []
    for line in (demonstration_table if options.demonstrations else table)(options, kept):
        print(line, flush=True)
    if options.write:
        keep(kept)


if __name__ == "__main__":
    main(tyro.cli(Options))
