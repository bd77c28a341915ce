"""Env-steps per second: the batched CPU core against what ManiSkill recommends on a CPU.

    python tests/benchmarks/core_throughput.py [--env-id PickCube-v1] [--num-envs 16] [--seconds 5]

Both sides run the same task, state observations, uniform random actions and resets at the time limit,
in turns in one run, each turn in a process of its own with one torch thread a process. The other side
is gymnasium's AsyncVectorEnv over ManiSkill's CPUGymWrapper, one process an env. Take the ratio; the
absolute numbers are those of the machine.
"""

from __future__ import annotations

import multiprocessing
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass

import tyro


@dataclass(frozen=True)
class Options:
    env_id: str = "PickCube-v1"
    num_envs: int = 16
    seconds: float = 5.0
    """Of stepping, a turn."""
    turns: int = 3


def batched(options: Options) -> float:
    """Env-steps per second of the batched core; bodies are kept awake by random actions."""
    import mani_skill.envs  # noqa: F401
    import numpy as np
    import torch
    from mani_skill.utils.registration import REGISTERED_ENVS

    from workbench.core import actions
    from workbench.core.task_env import EnvOptions, TaskEnv, make_env

    torch.set_num_threads(1)
    spec = REGISTERED_ENVS[options.env_id]
    made = EnvOptions(options.num_envs, "cpu", render=False, kwargs={"obs_mode": "state"})
    env = TaskEnv(make_env(spec.cls, made), spec.max_episode_steps)
    rng = np.random.default_rng(0)
    env.reset(seed=0)

    def step() -> None:
        result = env.step(actions.random_action(env.parts, env.num_envs, rng))
        over = (result.terminated | result.truncated).nonzero()[0]
        if len(over):
            env.reset(env_idx=over.tolist())

    return options.num_envs * _steps_per_second(step, options.seconds)


def asynchronous(options: Options) -> float:
    """Env-steps per second of AsyncVectorEnv(CPUGymWrapper)."""
    import gymnasium as gym

    def make() -> gym.Env:
        import mani_skill.envs  # noqa: F401
        import torch
        from mani_skill.utils.wrappers.gymnasium import CPUGymWrapper

        torch.set_num_threads(1)
        env = gym.make(options.env_id, obs_mode="state", sim_backend="physx_cpu", render_backend="none")
        return CPUGymWrapper(env)

    envs = gym.vector.AsyncVectorEnv([make] * options.num_envs, context="spawn")
    envs.reset(seed=0)
    envs.action_space.seed(0)
    rate = options.num_envs * _steps_per_second(
        lambda: envs.step(envs.action_space.sample()), options.seconds
    )
    envs.close()
    return rate


def _steps_per_second(step: Callable[[], object], seconds: float) -> float:
    for _ in range(10):
        step()
    count, start = 0, time.perf_counter()
    while time.perf_counter() - start < seconds:
        step()
        count += 1
    return count / (time.perf_counter() - start)


def _turn(side: Callable[[Options], float], options: Options, results: multiprocessing.Queue) -> None:
    results.put(side(options))


def in_own_process(side: Callable[[Options], float], options: Options) -> float:
    """Run one turn in a fresh process, so that neither side inherits threads or caches."""
    context = multiprocessing.get_context("spawn")
    results = context.Queue()
    process = context.Process(target=_turn, args=(side, options, results))
    process.start()
    rate = results.get(timeout=300)
    process.join()
    return rate


def main(options: Options) -> None:
    rates: dict[str, list[float]] = {"batched core": [], "AsyncVectorEnv": []}
    for _ in range(options.turns):
        rates["batched core"].append(in_own_process(batched, options))
        rates["AsyncVectorEnv"].append(in_own_process(asynchronous, options))
    print(f"{options.env_id}, state obs, {options.num_envs} envs, median of {options.turns} turns")
    print("| side | env-steps/s | lowest | highest |")
    print("|---|---|---|---|")
    for side, values in rates.items():
        print(f"| {side} | {statistics.median(values):.0f} | {min(values):.0f} | {max(values):.0f} |")
    ratio = statistics.median(rates["batched core"]) / statistics.median(rates["AsyncVectorEnv"])
    print(f"ratio: {ratio:.2f}")


if __name__ == "__main__":
    main(tyro.cli(Options))
