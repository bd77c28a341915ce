"""What recording costs, beside ManiSkill's own RecordEpisode: python tests/benchmarks/recording.py

The same env, the same seed, the same actions: bare, inside RecordEpisode, inside `workbench.Recorder`, in turn, several rounds. Both
recorders keep actions, rewards, flags, state observations and env states; ours also every pose, what ``evaluate`` returned, and
a second file, the .rrd. With a camera, both keep the base camera's colour, depth and segmentation, which the env observes.

Prints for each of one env and sixteen: the milliseconds that a step takes more than bare (median of the rounds), until the files are
closed; and the bytes that a step of one env adds to the files, which is a difference of two lengths, so that neither
side's fixed parts (the scene's meshes, the sources' texts) count.
"""

from __future__ import annotations

import shutil
import statistics
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro

sys.path.insert(0, str(Path(__file__).parents[2]))
from mani_skill.utils.wrappers.record import RecordEpisode

import workbench

SIDES = ("bare", "RecordEpisode", "Recorder")


@dataclass
class Options:
    task: str = "PickCube-v1"
    num_envs: tuple[int, ...] = (1, 16)
    steps: int = 200
    """Of an episode."""
    rounds: int = 5
    camera_steps: int = 20
    camera_rounds: int = 3
    """With a camera; 0 leaves it out."""


@dataclass(frozen=True)
class Run:
    seconds: float
    """Of stepping and of closing, that is until all files are there."""
    stepping: float
    """Of stepping alone."""
    size: dict[str, int]
    """Bytes by suffix."""


def run(side: str, env: Any, base_actions: list[torch.Tensor], camera: bool) -> Run:
    folder = Path(tempfile.mkdtemp(prefix="recording-"))
    wrapped = env
    if side == "RecordEpisode":
        wrapped = RecordEpisode(env, str(folder), save_video=False, trajectory_name="run")
    elif side == "Recorder":
        wrapped = workbench.Recorder(env, folder, pictures=("base_camera",) if camera else False)
    wrapped.reset(seed=0)
    began = time.perf_counter()
    for action in base_actions:
        wrapped.step(action)
    stepped = time.perf_counter()
    finish(side, wrapped)
    ended = time.perf_counter()
    size = {
        suffix: sum(p.stat().st_size for p in folder.glob(f"*{suffix}"))
        for suffix in (".h5", ".json", ".rrd")
    }
    shutil.rmtree(folder)
    return Run(ended - began, stepped - began, size)


def finish(side: str, wrapped: Any) -> None:
    """Close the files, and not the env, which the next run goes on with."""
    if side == "RecordEpisode":
        wrapped.flush_trajectory()
        wrapped._h5_file.close()
    elif side == "Recorder":
        wrapped.finish()


def measure(options: Options, num_envs: int, camera: bool) -> None:
    steps = options.camera_steps if camera else options.steps
    rounds = options.camera_rounds if camera else options.rounds
    mode: dict[str, Any] = {"obs_mode": "state", "render_backend": "none"}
    if camera:
        mode = {"obs_mode": "state+rgb+depth+segmentation", "render_backend": "cpu"}
    env = workbench.make(options.task, num_envs, backend="cpu", max_episode_steps=-1, **mode)
    rng = np.random.default_rng(0)
    shape = (steps, num_envs, env.action_space.shape[-1])  # type: ignore[index]
    actions = list(torch.from_numpy(rng.uniform(-1, 1, shape).astype(np.float32)))
    runs: dict[str, list[Run]] = {side: [] for side in SIDES}
    for side in SIDES:
        run(side, env, actions[:3], camera)  # first imports, first shaders
    for number in range(rounds):
        for side in SIDES if number % 2 else SIDES[::-1]:
            runs[side].append(run(side, env, actions, camera))
    sizes = {}
    for side in SIDES[1:]:
        half = run(side, env, actions[: steps // 2], camera).size
        whole = runs[side][-1].size
        rest = (steps - steps // 2) * num_envs
        sizes[side] = {suffix: (whole[suffix] - half[suffix]) / rest for suffix in whole}
    env.close()

    def more(side: str, what: str) -> float:
        pairs = zip(runs[side], runs["bare"], strict=True)
        return statistics.median(1000 * (getattr(a, what) - getattr(b, what)) / steps for a, b in pairs)

    bare = statistics.median(1000 * r.seconds / steps for r in runs["bare"])
    print(
        f"{options.task}, {num_envs} env(s), {'with a camera' if camera else 'states'}; a bare step {bare:.2f} ms"
    )
    for side in SIDES[1:]:
        size = sizes[side]
        h5, rrd = size[".h5"] + size[".json"], size[".rrd"]
        print(
            f"  {side:14s} + {more(side, 'stepping'):6.3f} ms while stepping, + {more(side, 'seconds'):6.3f} ms with the files;"
            f" a step of an env {h5:7.0f} bytes in .h5 and .json, {rrd:7.0f} in .rrd"
        )
    theirs, ours = more("RecordEpisode", "seconds"), more("Recorder", "seconds")
    stepping = more("Recorder", "stepping") / more("RecordEpisode", "stepping")
    total = {side: sum(size.values()) for side, size in sizes.items()}
    print(
        f"  ratio of times {stepping:.2f} while stepping, {ours / theirs:.2f} with the files; of bytes "
        f"{sizes['Recorder']['.h5'] / sizes['RecordEpisode']['.h5']:.2f} (.h5), "
        f"{total['Recorder'] / total['RecordEpisode']:.2f} (all files)"
    )


def main(options: Options) -> None:
    torch.set_num_threads(1)
    for num_envs in options.num_envs:
        measure(options, num_envs, camera=False)
    if options.camera_rounds:
        for num_envs in options.num_envs:
            measure(options, num_envs, camera=True)


if __name__ == "__main__":
    main(tyro.cli(Options))
