"""The sides that ``core.py`` compares: one function each, run in a new process.

Every function takes plain arguments and returns plain numbers. All use one torch thread, which for tensors of this
size is up to 2.8 times faster than torch's default, on both sides.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from tests.drive.render_device import RENDER_BACKEND


def steps_per_second(step: Callable[[], object], seconds: float) -> float:
    for _ in range(10):
        step()
    count, start = 0, time.perf_counter()
    while time.perf_counter() - start < seconds:
        step()
        count += 1
    return count / (time.perf_counter() - start)


def make_batched(env_id: str, num_envs: int, **kwargs: Any) -> Any:
    """The unwrapped batched env."""
    import torch
    from mani_skill.utils.registration import REGISTERED_ENVS

    from workbench.envs.task_env import EnvOptions, make_env

    torch.set_num_threads(1)
    import mani_skill.envs  # noqa: F401

    render, threads = kwargs.pop("render", False), kwargs.pop("threads", None)
    kwargs = {"obs_mode": "state", **kwargs}
    options = EnvOptions(num_envs, "cpu", render=render, threads=threads, kwargs=kwargs)
    return make_env(REGISTERED_ENVS[env_id].cls, options)


def make_stock(env_id: str, **kwargs: Any) -> Any:
    """ManiSkill's single CPU env, unwrapped."""
    import gymnasium as gym
    import mani_skill.envs  # noqa: F401
    import torch

    torch.set_num_threads(1)
    settings = {"obs_mode": "state", "sim_backend": "physx_cpu", "render_backend": "none", **kwargs}
    return gym.make(env_id, **settings).unwrapped


def random_stepper(env: Any, episode: int = 50) -> Callable[[], None]:
    """A function that steps with uniform random actions, which keep every body awake, and resets every `episode` steps."""
    import torch

    low, high = env.single_action_space.low, env.single_action_space.high
    low, high = np.where(np.isfinite(low), low, -1), np.where(np.isfinite(high), high, 1)
    shape = (episode, env.num_envs, len(low))
    actions = torch.from_numpy(np.random.default_rng(0).uniform(low, high, shape).astype(np.float32))
    env.reset(seed=0)
    taken = 0

    def step() -> None:
        nonlocal taken
        env.step(actions[taken % episode])
        taken += 1
        if taken % episode == 0:
            env.reset()

    return step


def batched_rate(env_id: str, num_envs: int, threads: int | None, seconds: float) -> float:
    """Env-steps per second of the batched core."""
    env = make_batched(env_id, num_envs, threads=threads)
    return num_envs * steps_per_second(random_stepper(env), seconds)


def physics_share(env_id: str, num_envs: int, control_steps: int = 100) -> dict[str, float]:
    """The share of PhysX's own ``step()`` in a control step.

    Returns:
        wall: share of the wall time during which at least one env was inside ``step()``.
        cores: share of the total time of all threads that was spent inside ``step()``.
    """
    env = make_batched(env_id, num_envs)
    stepper = env.scene.px.stepper
    intervals: list[tuple[float, float]] = []

    def timed(step: Callable[[], None]) -> Callable[[], None]:
        def call() -> None:
            start = time.perf_counter()
            step()
            intervals.append((start, time.perf_counter()))

        return call

    stepper.step_once[:] = [timed(step) for step in stepper.step_once]
    step = random_stepper(env)
    for _ in range(10):
        step()
    intervals.clear()
    start = time.perf_counter()
    for _ in range(control_steps):
        step()
    wall = time.perf_counter() - start
    inside, until = 0.0, 0.0
    for begun, ended in sorted(intervals):
        inside += max(0.0, ended - max(begun, until))
        until = max(until, ended)
    spent = sum(ended - begun for begun, ended in intervals)
    return {"wall": inside / wall, "cores": spent / (wall * min(stepper.threads, num_envs))}


def stock_rate(env_id: str, seconds: float) -> float:
    """Env-steps per second of ManiSkill's own single CPU env."""
    return steps_per_second(random_stepper(make_stock(env_id)), seconds)


def async_rate(env_id: str, num_envs: int, seconds: float) -> float:
    """Env-steps per second of gymnasium's AsyncVectorEnv over ManiSkill's CPUGymWrapper.

    Its processes are forked, gymnasium's default on Linux: spawning 64 takes minutes of imports on two cores.
    """
    import gymnasium as gym
    import mani_skill.envs  # noqa: F401  once, before the fork
    import torch
    from mani_skill.utils.wrappers.gymnasium import CPUGymWrapper

    torch.set_num_threads(1)

    def make() -> gym.Env:
        env = gym.make(env_id, obs_mode="state", sim_backend="physx_cpu", render_backend="none")
        return CPUGymWrapper(env)

    envs = gym.vector.AsyncVectorEnv([make] * num_envs, context="fork")
    envs.reset(seed=0)
    envs.action_space.seed(0)
    rate = num_envs * steps_per_second(lambda: envs.step(envs.action_space.sample()), seconds)
    envs.close()
    return rate


def picture_seconds(env_id: str, num_envs: int, seconds: float) -> dict[str, float]:
    """Seconds per 128 x 128 rgb picture: batched, stock, and SAPIEN's bare calls, measured alternately.

    The scene is rendered as after a step: poses are passed to the renderer, then each env's camera renders.
    """
    small = {"sensor_configs": {"width": 128, "height": 128}, "obs_mode": "rgb"}
    batched = make_batched(env_id, num_envs, render=True, **small)
    stock = make_stock(env_id, render_backend=RENDER_BACKEND, **small)
    stock.reset(seed=0)
    batched.reset(seed=0)
    cameras = [s.camera._render_cameras for s in batched._sensors.values()]
    pictures = num_envs * len(cameras)

    def of_batch() -> None:
        batched.get_obs()

    def of_stock() -> None:
        stock.get_obs()

    def bare() -> None:
        for scene in batched.scene.sub_scenes:
            scene.update_render()
        for components in cameras:
            for component in components:
                component.take_picture()
        for components in cameras:
            for component in components:
                component.get_picture("Color")

    counted = {"batched": (of_batch, pictures), "stock": (of_stock, len(cameras)), "bare": (bare, pictures)}
    spent = dict.fromkeys(counted, 0.0)
    taken = dict.fromkeys(counted, 0)
    for call, _ in counted.values():
        call()
    while sum(spent.values()) < seconds:
        for side, (call, count) in counted.items():
            start = time.perf_counter()
            call()
            spent[side] += time.perf_counter() - start
            taken[side] += count
    return {side: spent[side] / taken[side] for side in counted}


def snapshot_seconds(env_id: str, num_envs: int, rounds: int = 60) -> dict[str, float]:
    """Median seconds of a control step, of a snapshot of all envs after it, and of its two kinds of restore."""
    from workbench.envs.snapshots.snapshot import restore_snapshot, take_snapshot

    env = make_batched(env_id, num_envs)
    step = random_stepper(env)
    for _ in range(10):
        step()
    times: dict[str, list[float]] = {"step": [], "snapshot": [], "exact": [], "quick": []}

    def timed(name: str, call: Callable[[], Any]) -> Any:
        start = time.perf_counter()
        result = call()
        times[name].append(time.perf_counter() - start)
        return result

    for _ in range(rounds):
        timed("step", step)
        kept = timed("snapshot", lambda: take_snapshot(env))
        step()
        timed("exact", lambda kept=kept: restore_snapshot(env, kept))
        step()
        timed("quick", lambda kept=kept: restore_snapshot(env, kept, fresh_physics=False))
        step()
    return {name: float(np.median(values)) for name, values in times.items()}


def resident_bytes() -> int:
    import psutil

    return psutil.Process().memory_info().rss


def memory_of(env_id: str, num_envs: int) -> int:
    """Resident bytes of this process with `num_envs` envs, after a reset and some steps."""
    step = random_stepper(make_batched(env_id, num_envs))
    for _ in range(60):
        step()
    return resident_bytes()


def memory_over_resets(env_id: str, num_envs: int, resets: int) -> list[int]:
    """Resident bytes after each tenth of `resets` full resets, each followed by a step."""
    env = make_batched(env_id, num_envs)
    step = random_stepper(env)
    held = []
    for i in range(resets):
        env.reset(seed=i)
        step()
        if (i + 1) % max(resets // 10, 1) == 0:
            held.append(resident_bytes())
    return held


def memory_over_rebuilds(env_id: str, num_envs: int, rebuilds: int) -> list[int]:
    """Resident bytes after each tenth of `rebuilds` cycles of making, resetting, stepping and closing an env."""
    import gc

    held = []
    for i in range(rebuilds):
        env = make_batched(env_id, num_envs)
        random_stepper(env)()
        env.close()
        del env
        if (i + 1) % max(rebuilds // 10, 1) == 0:
            gc.collect()
            held.append(resident_bytes())
    return held
