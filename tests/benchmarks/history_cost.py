"""The cost of keeping every step in the history: python tests/benchmarks/history_cost.py [--task PushCube-v1] [--processor]

Plays a task in this process as the worker does, packs a snapshot of every step, pickles it as the pipe would, and stores it
in a `History` as the server does. Prints medians: milliseconds of the step, the snapshot, its division into parts and the
message; bytes of the message, and bytes that the history holds per step.
"""

from __future__ import annotations

import pickle
import statistics
import sys
import time
import tracemalloc
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Literal

import numpy as np
import torch
import tyro

sys.path.insert(0, str(Path(__file__).parents[2]))
from mani_skill.envs.tasks.tabletop.pick_cube import PickCubeEnv
from mani_skill.envs.tasks.tabletop.push_cube import PushCubeEnv

from workbench.envs import action_vector as actions
from workbench.envs.scene.read_scene import read_geometry
from workbench.envs.snapshots.packing import SnapshotPacker
from workbench.envs.task_env import EnvOptions, TaskEnv, make_env
from workbench.live.history.env_table import EnvTable
from workbench.live.history.moments import History
from workbench.task.description import Stepped

TASKS = {"PickCube-v1": PickCubeEnv, "PushCube-v1": PushCubeEnv}
"""PickCube queries contacts, PushCube does not."""


@dataclass
class Options:
    num_envs: tuple[int, ...] = (16, 64)
    steps: int = 150
    """Control steps to play; every episode has 50."""
    task: Literal["PickCube-v1", "PushCube-v1"] = "PickCube-v1"
    processor: bool = False
    """Measure the CPU time of all threads instead of the wall time, which is meaningless on a busy machine."""


def measure(num_envs: int, options: Options) -> str:
    steps, clock = options.steps, time.process_time if options.processor else time.perf_counter
    env = make_env(TASKS[options.task], EnvOptions(num_envs=num_envs, backend="cpu", render=False))
    task = TaskEnv(env, 50)
    rng = np.random.default_rng(0)
    table = EnvTable(read_geometry(task.env), task.reset(seed=0), task.control_dt, task.env.reward_mode, {})
    packer, history = SnapshotPacker(), History(table, 2**40)
    laps: dict[str, list[float]] = {"step": [], "snapshot": [], "parts": [], "message": [], "keep": []}
    sizes: list[int] = []
    base, held = 0, 0
    for number in range(steps):
        times = [clock()]
        step = task.step(actions.random_action(task.parts, num_envs, rng))
        times.append(clock())
        snapshot = task.snapshot()
        times.append(clock())
        packed = packer.pack(snapshot)
        times.append(clock())
        none = np.zeros(num_envs, bool)
        event = Stepped(step, none, (), None, packed.body, packed.keys, packed.new_parts, number)
        message = pickle.dumps(event)
        times.append(clock())
        if number % 2:
            tracemalloc.start()  # odd steps measure bytes, even steps time
        history.add(pickle.loads(message))
        times.append(clock())
        if number % 2:
            held += tracemalloc.get_traced_memory()[0]
            tracemalloc.stop()
        sizes.append(len(message))
        if number == 20:
            base, held = history.used, 0
        for lap, (a, b) in zip(laps, pairwise(times), strict=True):
            if number % 2 == 0:
                laps[lap].append(1000 * (b - a))
        if number % 50 == 49:
            task.reset()
    task.close()
    counted = (history.used - base) / (steps - 21)
    shown = ", ".join(f"{lap} {statistics.median(values):.2f}" for lap, values in laps.items())
    return (
        f"{options.task}, {num_envs} envs: ms {shown}; message {statistics.median(sizes) / 1000:.1f} KB; "
        f"history counts {counted / 1000:.1f} KB per step and takes {2 * held / (steps - 21) / 1000:.1f}"
    )


def main(options: Options) -> None:
    torch.set_num_threads(1)
    for count in options.num_envs:
        print(measure(count, options), flush=True)


if __name__ == "__main__":
    main(tyro.cli(Options))
