"""Fast pictures against exact ones and bare SAPIEN: pictures a second, and how much they differ; as markdown.

    python tests/benchmarks/pictures.py                                   # all, some 15 minutes on two cores
    python tests/benchmarks/pictures.py --tasks PickCube-v1 --sizes 128   # some of it
    python tests/benchmarks/pictures.py --parts steps

All sides of a task run in one process, in turns. Wall time is that of the machine, which should do nothing else; the
processor's time, of all threads, counts also on a busy one.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import tyro
from core import in_own_process, table
from core_sides import make_batched, random_stepper

Part = Literal["pictures", "steps"]
TABLETOP = (
    "PickCube-v1", "PushCube-v1", "PullCube-v1", "StackCube-v1", "StackPyramid-v1", "LiftPegUpright-v1", "PokeCube-v1",
    "RollBall-v1", "PlaceSphere-v1", "PegInsertionSide-v1", "PlugCharger-v1", "PushT-v1", "TwoRobotPickCube-v1",
)  # fmt: skip
OFF = 10
"""Of 255: a pixel that differs by more in a colour counts as off."""


@dataclass(frozen=True)
class Options:
    parts: tuple[Part, ...] = ("pictures", "steps")
    tasks: tuple[str, ...] = TABLETOP
    sizes: tuple[int, ...] = (128, 512)
    num_envs: int = 4
    steps: int = 10
    """Random ones, before pictures are compared."""
    turns: int = 5
    step_envs: int = 16
    """Of the part on steps."""
    seconds: float = 10.0
    """A side, of the part on steps."""


def compare(task: str, size: int, num_envs: int, steps: int, turns: int) -> dict[str, float]:
    """Milliseconds a picture of each side (wall and processor), and the differences."""
    env = make_batched(
        task,
        num_envs,
        render=True,
        obs_mode="rgb+depth+segmentation",
        sensor_configs={"width": size, "height": size},
    )
    step = random_stepper(env, episode=10**6)
    for _ in range(steps):
        step()
    cameras = [s.camera._render_cameras for s in env._sensors.values()]
    count = num_envs * len(cameras)

    def observe(degree: str) -> Callable[[], Any]:
        def call() -> Any:
            env.scene.pictures = degree
            try:
                env.scene.update_render(update_human_render_cameras=False)
                for sensor in env._sensors.values():
                    sensor.capture()
                return {name: sensor.get_obs(position=False) for name, sensor in env._sensors.items()}
            finally:
                env.scene.pictures = "exact"

        return call

    def bare() -> None:
        for scene in env.scene.sub_scenes:
            scene.update_render()
        for components in cameras:
            for component in components:
                component.take_picture()
        for components in cameras:
            for component in components:
                component.get_picture("Color")

    sides = {"bare": bare, "exact": observe("exact"), "fast": observe("fast")}
    exact, fast = sides["exact"](), sides["fast"]()
    times: dict[str, list[tuple[float, float]]] = {side: [] for side in sides}
    for call in sides.values():
        call()
    for _ in range(turns):
        for side, call in sides.items():
            wall, processor = time.perf_counter(), time.process_time()
            call()
            spent = time.perf_counter() - wall, time.process_time() - processor
            times[side].append((1e3 * spent[0] / count, 1e3 * spent[1] / count))
    found = differences(exact, fast)
    for side, taken in times.items():
        found[f"{side} wall"] = statistics.median(wall for wall, _ in taken)
        found[f"{side} processor"] = min(processor for _, processor in taken)
    env.close()
    return found


def differences(exact: dict[str, Any], fast: dict[str, Any]) -> dict[str, float]:
    """Over all pictures of all cameras: of colours in parts of 255, of depth in millimetres, of pixels in percent."""
    error, off, depth, deep, ids = [], [], [], [], []
    for name, of_camera in exact.items():
        other = fast[name]
        colours = np.abs(of_camera["rgb"].numpy().astype(int) - other["rgb"].numpy())
        millimetres = np.abs(of_camera["depth"].numpy().astype(int) - other["depth"].numpy())
        error += list(colours.mean(axis=(1, 2, 3)))
        off += list((colours.max(axis=-1) > OFF).mean(axis=(1, 2)))
        depth += list(millimetres.mean(axis=(1, 2, 3)))
        deep += list((millimetres > 10).mean(axis=(1, 2, 3)))
        ids += list((of_camera["segmentation"] != other["segmentation"]).float().mean(dim=(1, 2, 3)).numpy())
    return {
        "error": float(np.mean(error)),
        "worst error": float(np.max(error)),
        "off": 100 * float(np.mean(off)),
        "worst off": 100 * float(np.max(off)),
        "depth": float(np.mean(depth)),
        "depth off": 100 * float(np.mean(deep)),
        "segmentation": 100 * float(np.mean(ids)),
    }


def pictures(options: Options) -> Iterator[str]:
    for size in options.sizes:
        rows, ratios = [], []
        for task in options.tasks:
            got = in_own_process(compare, task, size, options.num_envs, options.steps, options.turns)
            ratios.append(got["bare processor"] / got["fast processor"])
            rows.append(
                [
                    task,
                    *(f"{1e3 / got[f'{side} wall']:.0f}" for side in ("bare", "exact", "fast")),
                    f"{got['bare wall'] / got['fast wall']:.1f}",
                    *(f"{got[f'{side} processor']:.1f}" for side in ("bare", "fast")),
                    f"{ratios[-1]:.1f}",
                    f"{got['error']:.2f} ({got['worst error']:.2f})",
                    f"{got['off']:.2f} % ({got['worst off']:.2f})",
                    f"{got['depth']:.1f} mm, {got['depth off']:.2f} %",
                    f"{got['segmentation']:.2f} %",
                ]
            )
            print(" | ".join(rows[-1]), flush=True)
        yield f"## Pictures of {size} x {size}"
        yield ""
        yield f"Median over the tasks: {statistics.median(ratios):.1f} times as many as bare SAPIEN for the same processor time."
        yield ""
        head = [
            "task",
            "bare, pictures/s",
            "exact",
            "fast",
            "fast / bare",
            "bare, processor ms",
            "fast",
            "bare / fast",
        ]
        head += ["mean error of 255 (worst picture)", f"pixels off by > {OFF} (worst picture)"]
        head += ["depth: mean, pixels > 10 mm off", "segmentation: other pixels"]
        yield from table(head, rows)


# --- what a learner gets ------------------------------------------------------------------------------


def rate(step: Callable[[], object], num_envs: int, seconds: float) -> float:
    """Env-steps a second."""
    step()
    count, start = 0, time.perf_counter()
    while time.perf_counter() - start < seconds or count < 3:
        step()
        count += 1
    return num_envs * count / (time.perf_counter() - start)


def made_rate(num_envs: int, degree: Literal["exact", "fast"], seconds: float) -> float:
    import torch

    import workbench

    torch.set_num_threads(1)
    env = workbench.make("PushCube-v1", num_envs, obs_mode="rgb", pictures=degree)
    env.reset(seed=0)
    return rate(lambda: env.step(env.action_space.sample()), num_envs, seconds)


def async_rate(num_envs: int, seconds: float) -> float:
    import gymnasium as gym
    import mani_skill.envs  # noqa: F401
    import torch
    from mani_skill.utils.wrappers.gymnasium import CPUGymWrapper

    torch.set_num_threads(1)

    def make() -> gym.Env:
        return CPUGymWrapper(
            gym.make("PushCube-v1", obs_mode="rgb", sim_backend="physx_cpu", render_backend="cpu")
        )

    envs = gym.vector.AsyncVectorEnv([make] * num_envs, context="spawn")
    envs.reset(seed=0)
    found = rate(lambda: envs.step(envs.action_space.sample()), num_envs, seconds)
    envs.close()
    return found


def steps(options: Options) -> Iterator[str]:
    n, seconds = options.step_envs, options.seconds
    fast = in_own_process(made_rate, n, "fast", seconds)
    exact = in_own_process(made_rate, n, "exact", seconds)
    stock = in_own_process(async_rate, n, seconds)
    yield f'## `make("PushCube-v1", {n}, obs_mode="rgb", pictures=...)`, 128 x 128'
    yield ""
    rows = [
        ["fast", f"{fast:.0f}", f"{fast / stock:.1f}"],
        ["exact", f"{exact:.0f}", f"{exact / stock:.1f}"],
        [f"stock AsyncVectorEnv of {n}", f"{stock:.0f}", "1"],
    ]
    yield from table(["", "env-steps a second", "to stock"], rows)


def main(options: Options) -> None:
    for part in options.parts:
        for line in {"pictures": pictures, "steps": steps}[part](options):
            print(line, flush=True)


if __name__ == "__main__":
    main(tyro.cli(Options))
