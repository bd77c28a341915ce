"""The cost of recording, compared with ManiSkill's own RecordEpisode: python tests/benchmarks/recording.py [--write]

The same env with the same seed and actions runs inside RecordEpisode and inside `workbench.Recorder`, alternately, for several
rounds. Both recorders store actions, rewards, flags, state observations and env states. With a camera, both store the base
camera's colour, depth and segmentation, which the env observes. Ours also stores every pose, the results of ``evaluate`` and the
meshes in a second file, the .rrd, which RecordEpisode does not have and which holds our pictures. So bytes and CPU time are
compared twice: for the same content (without a camera all but the .rrd, with one everything), and for everything.

*Stepping* is the time of a step beyond the env's own time, which is measured within the same step, because on a busy machine two
runs differ by more than the recorder's cost. *The whole run* is several episodes in sequence, until the files of the last one
exist, without the env's own time. RecordEpisode writes the files of an episode when the next one begins; ours are written during
the next episode, in a subprocess if there are many envs, else on another thread. Their CPU time, with the start of the subprocess,
is a separate row, and so is the whole run with the env, which shows how long the env waited. With a subprocess, a run without one
is shown too; it gives the CPU time of the same content. Times are medians of the rounds. Bytes per step are the difference of two
lengths, so the fixed parts (the scene's meshes, the source texts) do not count.
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
from workbench.record import gym_wrapper as recorder_module

SIDES = ("RecordEpisode", "Recorder")
THREAD = "on a thread"
"""`Recorder` without its subprocess."""


@dataclass
class Options:
    task: str = "PickCube-v1"
    num_envs: tuple[int, ...] = (1, 16)
    steps: int = 200
    """Steps per episode."""
    episodes: int = 3
    """Episodes per run."""
    rounds: int = 5
    """Rounds without a camera; 0 skips them."""
    camera_steps: tuple[int, ...] = (50, 16)
    """Steps with a camera, for each of `num_envs`: rendering takes a second per step. PickCube's own episode has 50. RecordEpisode
    copies all of its data at every step, so its steps become slower during the episode."""
    camera_rounds: tuple[int, ...] = (3, 1)
    """Rounds with a camera, for each of `num_envs`; 0 skips them."""
    write: bool = False
    """Write rows of the table of benchmarks, for the largest number of envs without a camera."""


class Timed(gym.Wrapper):
    """Sums up the time of its env."""

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
    """Replaces `threading.Thread`; threads of the recorder add their CPU time to `ended` when they end."""

    ended = 0.0

    def run(self) -> None:
        try:
            super().run()
        finally:
            if self.name.startswith("episode-"):
                RecordersThread.ended += time.thread_time()


threading.Thread = RecordersThread  # type: ignore[misc]


def on_threads() -> float:
    """CPU seconds of the recorder's own threads; the process's total would include the threads of the env."""
    ours = [t for t in threading.enumerate() if t.name.startswith("episode-") and t.ident is not None]
    alive = sum(time.clock_gettime(time.pthread_getcpuclockid(t.ident)) for t in ours if t.ident)
    return alive + RecordersThread.ended


def in_processes() -> float:
    """CPU seconds of child processes that have ended."""
    ended = resource.getrusage(resource.RUSAGE_CHILDREN)
    return ended.ru_utime + ended.ru_stime


@dataclass(frozen=True)
class Run:
    """Seconds of all episodes of a run."""

    bare: float
    """The env's own steps."""
    stepping: float
    """The recorder's time while stepping."""
    whole: float
    """The recorder's time until the files existed."""
    env_and_all: float
    """The whole run with the env: its own steps are slower while another thread holds the interpreter."""
    processor: float
    """CPU time of the whole run: all threads of the recorder, and its subprocess."""
    rrd: float
    """The part of `processor` for the .rrd; 0 if a subprocess wrote it."""
    size: dict[str, int]
    """Bytes by suffix."""

    @property
    def without_rrd(self) -> float:
        return self.processor - self.rrd


class _Rrd:
    """Sums up the CPU time of writing .rrd files, which are written one by one."""

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
    """Close the files but not the env, which the next run uses."""
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
        ("ms per step: stepping", lambda side: took(side, "stepping")),
        ("ms per step: the whole run", lambda side: took(side, "whole")),
        ("ms per step: the whole run, with the env", lambda side: took(side, "env_and_all")),
        (
            "ms per step: CPU, same content",
            lambda side: took(sides[-1] if side == "Recorder" else side, processor),
        ),
        ("ms per step: CPU, everything", lambda side: took(side, "processor")),
        ("bytes per step and env: same content", lambda side: weighs(side, *same)),
        ("bytes per step and env: everything", lambda side: weighs(side, *whole)),
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
