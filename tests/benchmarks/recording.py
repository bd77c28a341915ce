"""What recording costs, beside ManiSkill's own RecordEpisode: python tests/benchmarks/recording.py

The same env, the same seed, the same actions: inside RecordEpisode, inside `workbench.Recorder`, in turn, several rounds. Both
recorders keep actions, rewards, flags, state observations and env states; ours also every pose, what ``evaluate`` returned, and
a second file, the .rrd. With a camera, both keep the base camera's colour, depth and segmentation, which the env observes.

What a recorder takes is what a step takes beyond the env's own, which is measured within the same step: on a machine that others use
too, two runs differ by more than a recorder takes. Prints for each of one env and sixteen the milliseconds a step, by the clock and of
the processor (the median of the rounds), and what making the files takes at the end of the episodes; and the bytes that a step of one env adds to the files, which is a difference of two lengths, so that neither
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

import gymnasium as gym
import numpy as np
import torch
import tyro

sys.path.insert(0, str(Path(__file__).parents[2]))
from mani_skill.utils.wrappers.record import RecordEpisode

import workbench

SIDES = ("RecordEpisode", "Recorder")


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


class Timed(gym.Wrapper):
    """Sums up what its env takes."""

    clock = processor = 0.0

    def step(self, action: Any) -> Any:
        clock, processor = time.perf_counter(), time.process_time()
        given = self.env.step(action)
        self.clock += time.perf_counter() - clock
        self.processor += time.process_time() - processor
        return given


@dataclass(frozen=True)
class Run:
    bare: float
    """Seconds of the env's own steps."""
    clock: float
    """Seconds that the recorder took while stepping."""
    processor: float
    """The same, of the processor, all threads."""
    files: float
    """Seconds of the processor for making the files."""
    size: dict[str, int]
    """Bytes by suffix."""


def run(side: str, env: Any, actions: list[torch.Tensor], camera: bool) -> Run:
    folder = Path(tempfile.mkdtemp(prefix="recording-"))
    timed = Timed(env)
    if side == "RecordEpisode":
        recorder: Any = RecordEpisode(timed, str(folder), save_video=False, trajectory_name="run")  # type: ignore[arg-type]
    else:
        recorder = workbench.Recorder(timed, folder, pictures=("base_camera",) if camera else False)
    recorder.reset(seed=0)
    clock, processor = time.perf_counter(), time.process_time()
    for action in actions:
        recorder.step(action)
    clock, processor = time.perf_counter() - clock, time.process_time() - processor
    began = time.process_time()
    finish(side, recorder)
    files = time.process_time() - began
    size = {
        suffix: sum(p.stat().st_size for p in folder.glob(f"*{suffix}"))
        for suffix in (".h5", ".json", ".rrd")
    }
    shutil.rmtree(folder)
    return Run(timed.clock, clock - timed.clock, processor - timed.processor, files, size)


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
    for side in SIDES:
        half = run(side, env, actions[: steps // 2], camera).size
        whole = runs[side][-1].size
        rest = (steps - steps // 2) * num_envs
        sizes[side] = {suffix: (whole[suffix] - half[suffix]) / rest for suffix in whole}
    env.close()

    def took(side: str, what: str) -> float:
        return statistics.median(1000 * getattr(r, what) / steps for r in runs[side])

    about = f"{options.task}, {num_envs} env{'s' if num_envs > 1 else ''}, {'with a camera' if camera else 'states'}"
    print(f"{about}; {steps} steps of {took('Recorder', 'bare'):.2f} ms without recording")
    for side in SIDES:
        size = sizes[side]
        print(
            f"  {side:14s} {took(side, 'clock'):7.3f} ms a step, {took(side, 'processor'):7.3f} of the processor; files "
            f"{took(side, 'files') * steps / num_envs:6.1f} ms an episode; bytes a step and env: "
            f"{size['.h5'] + size['.json']:6.0f} in .h5 and .json, {size['.rrd']:6.0f} in .rrd"
        )
    theirs, ours = sizes["RecordEpisode"], sizes["Recorder"]
    print(
        f"  ratio of times {took('Recorder', 'clock') / took('RecordEpisode', 'clock'):.2f} by the clock, "
        f"{took('Recorder', 'processor') / took('RecordEpisode', 'processor'):.2f} of the processor; of bytes "
        f"{ours['.h5'] / theirs['.h5']:.2f} .h5 to .h5, {sum(ours.values()) / sum(theirs.values()):.2f} all files"
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
