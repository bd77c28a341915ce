"""What recording costs, beside ManiSkill's own RecordEpisode: python tests/benchmarks/recording.py

The same env, the same seed, the same actions: inside RecordEpisode, inside `workbench.Recorder`, in turn, several rounds. Both
recorders keep actions, rewards, flags, state observations and env states. With a camera, both keep the base camera's colour, depth and
segmentation, which the env observes. Ours keeps more: every pose, what ``evaluate`` returned, the meshes, all in a second file, the
.rrd, which RecordEpisode does not have; its share is shown by itself.

What a recorder takes is what a step takes beyond the env's own, which is measured within the same step: on a machine that others use
too, two runs differ by more than a recorder takes. It is everything until the files are there, divided by the steps, in two
parts: while stepping, and when the files are made (RecordEpisode compresses its pictures then, ours while the next step is made, on
other threads, whose work is counted where the processor is). Each is the median of the rounds by the clock, and the median and the least by
the processor; the env's own threads are no part of either. Bytes a step are a difference of two lengths, so that neither
side's fixed parts (the scene's meshes, the sources' texts) count.
"""

from __future__ import annotations

import shutil
import statistics
import sys
import tempfile
import threading
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
from workbench.recording import make_files

SIDES = ("RecordEpisode", "Recorder")


@dataclass
class Options:
    task: str = "PickCube-v1"
    num_envs: tuple[int, ...] = (1, 16)
    steps: int = 200
    """Of an episode."""
    rounds: int = 5
    """Without a camera; 0 leaves it out."""
    camera_steps: int = 50
    """PickCube's own episode. RecordEpisode copies all that it has at every step, so its steps grow slower with the episode."""
    camera_rounds: int = 3
    """With a camera; 0 leaves it out."""


class Timed(gym.Wrapper):
    """Sums up what its env takes."""

    clock = processor = 0.0

    def step(self, action: Any) -> Any:
        clock, processor = time.perf_counter(), time.thread_time()
        given = self.env.step(action)
        self.clock += time.perf_counter() - clock
        self.processor += time.thread_time() - processor
        return given


def on_threads() -> float:
    """Seconds of the processor that the recorder's own threads have had; those of the env would hide them in its step."""
    ours = [t for t in threading.enumerate() if t.name.startswith("episode-") and t.ident is not None]
    return sum(time.clock_gettime(time.pthread_getcpuclockid(t.ident)) for t in ours if t.ident)


@dataclass(frozen=True)
class Run:
    """Seconds of an episode."""

    bare: float
    """Of the env's own steps."""
    clock: float
    """That the recorder took while stepping."""
    processor: float
    """The same, of the processor, all threads of the recorder."""
    files_clock: float
    """For making the files."""
    files_processor: float
    rrd: float
    """Of `files_processor`, what the .rrd took."""
    size: dict[str, int]
    """Bytes by suffix."""

    @property
    def whole_clock(self) -> float:
        return self.clock + self.files_clock

    @property
    def whole_processor(self) -> float:
        return self.processor + self.files_processor

    @property
    def same_processor(self) -> float:
        """Without the .rrd: what both sides make."""
        return self.whole_processor - self.rrd


class _Rrd:
    """Sums up what the .rrd files take; they are made one after the other."""

    taken = 0.0

    def __init__(self) -> None:
        def timed(call: Any) -> Any:
            def run(*args: Any) -> Any:
                began = time.process_time()
                try:
                    return call(*args)
                finally:
                    self.taken += time.process_time() - began

            return run

        writer = make_files.rrd_writer

        def rrd_writer(survey: Any, path: Path) -> Any:
            held = writer(survey, path)
            return _Timed(held, timed)

        make_files.rrd_writer = rrd_writer  # type: ignore[assignment]


class _Timed:
    """A context, and what it gives, timed."""

    def __init__(self, held: Any, timed: Any) -> None:
        self._held, self._timed = held, timed

    def __enter__(self) -> Any:
        given = self._timed(self._held.__enter__)()
        given.take = self._timed(given.take)
        return given

    def __exit__(self, *error: Any) -> Any:
        return self._timed(self._held.__exit__)(*error)


rrd = _Rrd()


def run(side: str, env: Any, actions: list[torch.Tensor], camera: bool) -> Run:
    folder = Path(tempfile.mkdtemp(prefix="recording-"))
    timed = Timed(env)
    if side == "RecordEpisode":
        recorder: Any = RecordEpisode(timed, str(folder), save_video=False, trajectory_name="run")  # type: ignore[arg-type]
    else:
        recorder = workbench.Recorder(timed, folder, pictures=("base_camera",) if camera else False)
    recorder.reset(seed=0)
    clock, processor = time.perf_counter(), time.thread_time() + on_threads()
    for action in actions:
        recorder.step(action)
    clock, processor = time.perf_counter() - clock, time.thread_time() + on_threads() - processor
    rrd.taken = 0.0
    began = time.perf_counter(), time.process_time()
    finish(side, recorder)
    files_clock, files_processor = time.perf_counter() - began[0], time.process_time() - began[1]
    size = {
        suffix: sum(p.stat().st_size for p in folder.glob(f"*{suffix}"))
        for suffix in (".h5", ".json", ".rrd")
    }
    shutil.rmtree(folder)
    return Run(
        timed.clock,
        clock - timed.clock,
        processor - timed.processor,
        files_clock,
        files_processor,
        rrd.taken,
        size,
    )


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

    def took(side: str, what: str, of: Any = statistics.median) -> float:
        return 1000 * of(getattr(r, what) for r in runs[side]) / steps

    about = f"{options.task}, {num_envs} env{'s' if num_envs > 1 else ''}, {'with a camera' if camera else 'states'}"
    print(
        f"{about}; {steps} steps of {took('Recorder', 'bare'):.2f} ms without recording; milliseconds a step:"
    )
    for side in SIDES:
        print(
            f"  {side:14s} stepping {took(side, 'clock'):7.3f}, files {took(side, 'files_clock'):7.3f} by the clock"
        )
        for word, of in (("median", statistics.median), ("least", min)):
            print(
                f"  {'':14s} stepping {took(side, 'processor', of):7.3f}, files {took(side, 'files_processor', of):7.3f}"
                f" (of it .rrd {took(side, 'rrd', of):7.3f}), sum {took(side, 'whole_processor', of):7.3f} of the"
                f" processor, {word}; without .rrd {took(side, 'same_processor', of):7.3f}"
            )
        size = sizes[side]
        print(
            f"  {'':14s} bytes a step and env: {size['.h5'] + size['.json']:6.0f} in .h5 and .json, {size['.rrd']:6.0f} in .rrd"
        )
    theirs, ours = sizes["RecordEpisode"], sizes["Recorder"]

    def ratio(what: str, of: Any = statistics.median) -> str:
        return f"{took('Recorder', what, of) / took('RecordEpisode', what, of):.2f}"

    print(
        f"  ratio: stepping {ratio('clock')} by the clock, {ratio('processor')} of the processor ({ratio('processor', min)} least);"
        f" with the files {ratio('whole_clock')} by the clock, {ratio('whole_processor')} of the processor,"
        f" {ratio('same_processor')} without the .rrd; bytes {ours['.h5'] / theirs['.h5']:.2f} .h5 to .h5,"
        f" {sum(ours.values()) / sum(theirs.values()):.2f} all files"
    )


def main(options: Options) -> None:
    torch.set_num_threads(1)
    if options.rounds:
        for num_envs in options.num_envs:
            measure(options, num_envs, camera=False)
    if options.camera_rounds:
        for num_envs in options.num_envs:
            measure(options, num_envs, camera=True)


if __name__ == "__main__":
    main(tyro.cli(Options))
