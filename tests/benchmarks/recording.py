"""What recording costs, beside ManiSkill's own RecordEpisode: python tests/benchmarks/recording.py [--write]

The same env, the same seed, the same actions: inside RecordEpisode, inside `workbench.Recorder`, in turn, several rounds. Both
recorders keep actions, rewards, flags, state observations and env states. With a camera, both keep the base camera's colour, depth and
segmentation, which the env observes. Ours keeps more: every pose, what ``evaluate`` returned, the meshes, all in a second file, the
.rrd, which RecordEpisode does not have, and which holds our pictures. So there are two verdicts on bytes and on the processor: of the same
content, which is all but the .rrd without a camera and everything with one, and of everything.

What a recorder takes is what a step takes beyond the env's own, which is measured within the same step: on a machine that others use
too, two runs differ by more than a recorder takes. Stepping is that. The whole run is some episodes, one after the other, until the files
of the last are there, without what the env took of it. RecordEpisode makes the files of an episode when the next one begins, ours while it
happens, in a process where there are many envs, else on another thread; what that takes of the processor, the process's start with it,
is a row of its own, as the env may have wanted it, and so is the whole run with the env, which shows what it waited. Where there is
a process, a run without one is beside it, which also gives the processor time of the same content. Times are medians of the rounds. Bytes a step are a difference of two lengths, so that neither side's fixed parts (the scene's meshes, the sources' texts) count.
"""

from __future__ import annotations

import resource
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

from tests.drive.render_device import RENDER_BACKEND

sys.path.insert(0, str(Path(__file__).parents[2]))
from mani_skill.utils.wrappers.record import RecordEpisode

import workbench
from tests.benchmarks.table import Row, keep
from workbench.episodes.writing import finish_or_recover as make_files
from workbench.record import recorder as recorder_module

SIDES = ("RecordEpisode", "Recorder")
THREAD = "on a thread"
"""`Recorder` without its process."""


@dataclass
class Options:
    task: str = "PickCube-v1"
    num_envs: tuple[int, ...] = (1, 16)
    steps: int = 200
    """Of an episode."""
    episodes: int = 3
    """Of a run."""
    rounds: int = 5
    """Without a camera; 0 leaves it out."""
    camera_steps: tuple[int, ...] = (50, 16)
    """With a camera, for each of `num_envs`: drawing them takes a second a step. PickCube's own episode has 50. RecordEpisode copies
    all that it has at every step, so its steps grow slower with the episode."""
    camera_rounds: tuple[int, ...] = (3, 1)
    """With a camera, for each of `num_envs`; 0 leaves it out."""
    write: bool = False
    """Keep rows in the table of benchmarks, of the most envs without a camera."""


class Timed(gym.Wrapper):
    """Sums up what its env takes."""

    steps = resets = processor = 0.0

    def step(self, action: Any) -> Any:
        clock, processor = time.perf_counter(), time.thread_time()
        given = self.env.step(action)
        self.steps += time.perf_counter() - clock
        self.processor += time.thread_time() - processor
        return given

    def reset(self, **asked: Any) -> Any:
        clock, processor = time.perf_counter(), time.thread_time()
        given = self.env.reset(**asked)
        self.resets += time.perf_counter() - clock
        self.processor += time.thread_time() - processor
        return given


class RecordersThread(threading.Thread):
    """Every thread of this process: those of the recorder leave what they had of the processor."""

    ended = 0.0

    def run(self) -> None:
        try:
            super().run()
        finally:
            if self.name.startswith("episode-"):
                RecordersThread.ended += time.thread_time()


threading.Thread = RecordersThread  # type: ignore[misc]


def on_threads() -> float:
    """Seconds of the processor that the recorder's own threads have had; those of the env would hide them in its step."""
    ours = [t for t in threading.enumerate() if t.name.startswith("episode-") and t.ident is not None]
    alive = sum(time.clock_gettime(time.pthread_getcpuclockid(t.ident)) for t in ours if t.ident)
    return alive + RecordersThread.ended


def in_processes() -> float:
    """The same, of processes that have ended."""
    ended = resource.getrusage(resource.RUSAGE_CHILDREN)
    return ended.ru_utime + ended.ru_stime


@dataclass(frozen=True)
class Run:
    """Seconds of all its episodes."""

    bare: float
    """Of the env's own steps."""
    stepping: float
    """That the recorder took while stepping."""
    whole: float
    """That it took until the files were there."""
    env_and_all: float
    """All that the run took: the env's own steps are slower where another thread wants the interpreter meanwhile."""
    processor: float
    """The whole, of the processor, all threads of the recorder, and its process."""
    rrd: float
    """Of `processor`, what the .rrd took; not where a process made it."""
    size: dict[str, int]
    """Bytes by suffix."""

    @property
    def without_rrd(self) -> float:
        return self.processor - self.rrd


class _Rrd:
    """Sums up what the .rrd files take; they are made one after the other."""

    taken = 0.0

    def __init__(self) -> None:
        write = make_files.write_rrd

        def write_rrd(episode: Any, path: Path) -> None:
            began = time.thread_time()
            try:
                write(episode, path)
            finally:
                self.taken += time.thread_time() - began

        make_files.write_rrd = write_rrd


rrd = _Rrd()
many_envs = recorder_module._SUBPROCESS_ENVS


def run(side: str, env: Any, actions: list[torch.Tensor], camera: bool, episodes: int = 1) -> Run:
    folder = Path(tempfile.mkdtemp(prefix="recording-"))
    timed = Timed(env)
    began, at_first = time.perf_counter(), time.thread_time() + on_threads() + in_processes()
    if side == "RecordEpisode":
        recorder: Any = RecordEpisode(timed, str(folder), save_video=False, trajectory_name="run")  # type: ignore[arg-type]
    else:
        recorder_module._SUBPROCESS_ENVS = 10**9 if side == THREAD else many_envs
        recorder = workbench.Recorder(timed, folder, pictures=("base_camera",) if camera else False)
    rrd.taken = 0.0
    stepping = 0.0
    for episode in range(episodes):
        recorder.reset(seed=episode)
        clock = time.perf_counter()
        for action in actions:
            recorder.step(action)
        stepping += time.perf_counter() - clock
    finish(side, recorder)
    whole = time.perf_counter() - began
    processor = time.thread_time() + on_threads() + in_processes() - at_first
    size = {
        suffix: sum(p.stat().st_size for p in folder.glob(f"*{suffix}"))
        for suffix in (".h5", ".json", ".rrd")
    }
    shutil.rmtree(folder)
    return Run(
        timed.steps,
        stepping - timed.steps,
        whole - timed.steps - timed.resets,
        whole,
        processor - timed.processor,
        rrd.taken,
        size,
    )


def finish(side: str, wrapped: Any) -> None:
    """Close the files, and not the env, which the next run goes on with."""
    if side == "RecordEpisode":
        wrapped.flush_trajectory()
        wrapped._h5_file.close()
    else:
        wrapped.finish()


def measure(options: Options, num_envs: int, camera: bool, steps: int, rounds: int) -> None:
    mode: dict[str, Any] = {"obs_mode": "state", "render_backend": "none"}
    if camera:
        mode = {"obs_mode": "state+rgb+depth+segmentation", "render_backend": RENDER_BACKEND}
    env = workbench.make(options.task, num_envs, backend="cpu", max_episode_steps=-1, **mode)
    rng = np.random.default_rng(0)
    shape = (steps, num_envs, env.action_space.shape[-1])  # type: ignore[index]
    actions = list(torch.from_numpy(rng.uniform(-1, 1, shape).astype(np.float32)))
    sides = SIDES if camera or num_envs < many_envs else (*SIDES, THREAD)
    runs: dict[str, list[Run]] = {side: [] for side in sides}
    for side in sides:
        run(side, env, actions[:3], camera)  # first imports, first shaders
    for number in range(rounds):
        for side in sides if number % 2 else sides[::-1]:
            runs[side].append(run(side, env, actions, camera, options.episodes))
    sizes = {}
    for side in sides:
        half, whole = (run(side, env, some, camera).size for some in (actions[: steps // 2], actions))
        rest = (steps - steps // 2) * num_envs
        sizes[side] = {suffix: (whole[suffix] - half[suffix]) / rest for suffix in whole}
    env.close()

    def took(side: str, what: str) -> float:
        return 1000 * statistics.median(getattr(r, what) for r in runs[side]) / steps / options.episodes

    def weighs(side: str, *suffixes: str) -> float:
        return sum(sizes[side][suffix] for suffix in suffixes)

    about = f"{num_envs} env{'s' if num_envs > 1 else ''}, {'with a camera' if camera else 'states'}"
    print(
        f"{options.task}, {about}; {options.episodes} episodes of {steps} steps of {took('Recorder', 'bare'):.2f} ms without recording"
    )
    whole = (".h5", ".json", ".rrd")
    same, processor = (whole, "processor") if camera else (whole[:2], "without_rrd")
    rows = [
        ("ms a step: stepping", lambda side: took(side, "stepping")),
        ("ms a step: the whole run", lambda side: took(side, "whole")),
        ("ms a step: the whole run, with the env", lambda side: took(side, "env_and_all")),
        (
            "ms a step: processor, same content",
            lambda side: took(sides[-1] if side == "Recorder" else side, processor),
        ),
        ("ms a step: processor, everything", lambda side: took(side, "processor")),
        ("bytes a step and env: same content", lambda side: weighs(side, *same)),
        ("bytes a step and env: everything", lambda side: weighs(side, *whole)),
    ]
    print(
        f"  {'':38s} {'Recorder':>14s} {'RecordEpisode':>14s} {'ratio':>6s}"
        + f" {THREAD:>14s} {'ratio':>6s}" * (len(sides) > 2)
    )
    for name, of in rows:
        theirs = of("RecordEpisode")
        ours = [of(side) for side in sides[1:]]
        print(
            f"  {name:38s} {ours[0]:14.3f} {theirs:14.3f} {ours[0] / theirs:6.2f}"
            + "".join(f" {one:14.3f} {one / theirs:6.2f}" for one in ours[1:]),
            flush=True,
        )
    if options.write and not camera and num_envs == max(options.num_envs):
        about = f"Recording {num_envs} envs of {options.task}, states: a step"
        keep(
            [
                Row(what, took("Recorder", part), took("RecordEpisode", part), "ms", "less", "recording.py")
                for what, part in (
                    (f"{about} beyond the env's own, against RecordEpisode", "stepping"),
                    (
                        f"{about} of the whole run beyond the env's own, with all files, against RecordEpisode, "
                        "which writes no `.rrd`",
                        "whole",
                    ),
                )
            ]
        )


def main(options: Options) -> None:
    torch.set_num_threads(1)
    if options.rounds:
        for num_envs in options.num_envs:
            measure(options, num_envs, False, options.steps, options.rounds)
    for num_envs, steps, rounds in zip(options.num_envs, options.camera_steps, options.camera_rounds):
        if rounds:
            measure(options, num_envs, True, steps, rounds)


if __name__ == "__main__":
    main(tyro.cli(Options))
