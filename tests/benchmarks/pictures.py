"""Fast pictures against exact ones and bare SAPIEN: CPU time and differences, as markdown.

    python tests/benchmarks/pictures.py                                   # everything, about 15 minutes on two cores
    python tests/benchmarks/pictures.py --tasks PickCube-v1 --sizes 128   # some parts
    python tests/benchmarks/pictures.py --parts steps
    python tests/benchmarks/pictures.py --write                           # also writes rows of the table of benchmarks

All sides of a task run alternately in one process. Milliseconds are CPU time of all threads, which is meaningful even on a
busy machine, of the best turn. `bare` are SAPIEN's own calls for the same cameras; `fast` includes ManiSkill's conversions.
"""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import numpy as np
import psutil
import tyro
from core import in_own_process, table
from core_sides import make_batched, random_stepper
from numpy.typing import NDArray

from tests.benchmarks.table import Row, keep  # `core` puts the repository on the path
from tests.drive.render_device import RENDER_BACKEND

Part = Literal["pictures", "steps"]
TABLETOP = (
    "PickCube-v1", "PushCube-v1", "PullCube-v1", "StackCube-v1", "StackPyramid-v1", "LiftPegUpright-v1", "PokeCube-v1",
    "RollBall-v1", "PlaceSphere-v1", "PegInsertionSide-v1", "PlugCharger-v1", "PushT-v1", "TwoRobotPickCube-v1",
)  # fmt: skip
OFF_BY = 10
"""A pixel that differs by more than this in a colour (of 255), or in depth (millimetres), counts as off."""
KEPT_SIZE_PIXELS = 128
"""Width and height in pixels for the rows in the table of benchmarks."""


@dataclass(frozen=True)
class Options:
    parts: tuple[Part, ...] = ("pictures", "steps")
    tasks: tuple[str, ...] = TABLETOP
    sizes: tuple[int, ...] = (128, 512)
    num_envs: int = 2
    steps: int = 6
    """Random steps before pictures are compared."""
    turns: int = 3
    step_envs: int = 16
    """Number of envs in the part on steps."""
    seconds: float = 10.0
    """Time per side in the part on steps."""
    write: bool = False
    """Write rows of the table of benchmarks."""


def compare(task: str, size: int, num_envs: int, steps: int, turns: int) -> dict[str, float]:
    """Milliseconds per picture of each side (wall and CPU time), and the differences."""
    env = make_batched(
        task,
        num_envs,
        render=True,
        obs_mode="rgb+depth+segmentation",
        sensor_configs={"width": size, "height": size},
    )
    if hasattr(env.single_action_space, "low"):
        step = random_stepper(env, episode=10**6)
    else:
        # In a task with several robots, they stand still.
        env.reset(seed=0)
        step = partial(env.step, None)
    env.scene.pictures = "fast"  # otherwise the steps would render exact pictures
    for _ in range(steps):
        step()
    env.scene.forget_fast_shapes()
    cameras = [s.camera._render_cameras for s in env._sensors.values()]
    count = num_envs * len(cameras)

    def observe(degree: str, deep: bool) -> Callable[[], Any]:
        def call() -> Any:
            env.scene.pictures = degree
            for sensor in env._sensors.values():
                if sensor.camera.camera_group is not None:
                    sensor.camera.camera_group.textures = {
                        "Color",
                        *(["PositionSegmentation"] if deep else []),
                    }
            try:
                env.scene.update_render(update_human_render_cameras=False)
                for sensor in env._sensors.values():
                    sensor.capture()
                asked = {"rgb": True, "depth": deep, "position": False, "segmentation": deep}
                return {name: sensor.get_obs(**asked) for name, sensor in env._sensors.items()}
            finally:
                env.scene.pictures = "exact"

        return call

    def bare(*textures: str) -> Callable[[], Any]:
        def call() -> None:
            for scene in env.scene.sub_scenes:
                scene.update_render()
            for components in cameras:
                for component in components:
                    component.take_picture()
            for components in cameras:
                for component in components:
                    for texture in textures:
                        component.get_picture(texture)

        return call

    sides = {
        "bare": bare("Color"),
        "exact": observe("exact", False),
        "fast": observe("fast", False),
        "bare, all": bare("Color", "PositionSegmentation"),
        "fast, all": observe("fast", True),
    }
    times: dict[str, list[tuple[float, float]]] = {side: [] for side in sides}
    exact, fast = observe("exact", True)(), sides["fast, all"]()
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
    """Mean and worst differences over all pictures: colours in parts of 255, depth in millimetres, pixels in percent.

    *Inside* are pixels without another body within one pixel.
    """
    each: dict[str, list[float]] = {}
    for name, of_camera in exact.items():
        other = fast[name]
        colours = np.abs(of_camera["rgb"].numpy().astype(int) - other["rgb"].numpy())
        millimetres = np.abs(of_camera["depth"].numpy().astype(int) - other["depth"].numpy())[..., 0]
        ids = of_camera["segmentation"].numpy()[..., 0]
        another, inside = ids != other["segmentation"].numpy()[..., 0], ~_at_silhouettes(ids)
        of_pictures = {
            "error": colours.mean(axis=(1, 2, 3)),
            "off": 100 * (colours.max(axis=-1) > OFF_BY).mean(axis=(1, 2)),
            "depth": millimetres.mean(axis=(1, 2)),
            "depth off": 100 * (millimetres > OFF_BY).mean(axis=(1, 2)),
            "depth off inside": 100 * ((millimetres > OFF_BY) & inside).mean(axis=(1, 2)),
            "segmentation": 100 * another.mean(axis=(1, 2)),
            "segmentation inside": 100 * (another & inside).mean(axis=(1, 2)),
        }
        for what, values in of_pictures.items():
            each.setdefault(what, []).extend(values)
    worst = {f"worst {what}": float(np.max(values)) for what, values in each.items()}
    return {what: float(np.mean(values)) for what, values in each.items()} | worst


def _at_silhouettes(ids: NDArray) -> NDArray[np.bool_]:
    """(N, H, W): whether one of the eight neighbour pixels shows another body."""
    around = np.pad(ids, ((0, 0), (1, 1), (1, 1)), mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(around, (3, 3), axis=(1, 2))
    return (windows != ids[..., None, None]).any(axis=(-1, -2))


def compare_sizes(
    task: str, sizes: tuple[int, ...], num_envs: int, steps: int, turns: int
) -> list[dict[str, float]]:
    return [compare(task, size, num_envs, steps, turns) for size in sizes]


def pictures(options: Options, kept: list[Row]) -> Iterator[str]:
    found: dict[str, list[dict[str, float]]] = {}
    for task in options.tasks:
        found[task] = in_own_process(
            compare_sizes, task, options.sizes, options.num_envs, options.steps, options.turns
        )
        print(task, found[task], file=sys.stderr, flush=True)
    for number, size in enumerate(options.sizes):
        rows = [_row(task, of_sizes[number]) for task, of_sizes in found.items()]
        every = [of_sizes[number] for of_sizes in found.values()]
        mean = {what: statistics.fmean(got[what] for got in every) for what in every[0]}
        mean |= {what: max(got[what] for got in every) for what in mean if what.startswith("worst")}
        rows.append(_row("mean (worst of all)", mean))
        if size == KEPT_SIZE_PIXELS:
            kept.extend(_kept(mean, len(every)))
        yield f"### {size} x {size}"
        yield ""
        head = [
            "task",
            "bare, ms",
            "exact",
            "fast",
            "bare / fast",
            "bare / fast, with depth and segmentation",
        ]
        head += ["error of 255 (worst picture)", "off", "depth: mm; off by > 10 mm, of these inside"]
        head += ["segmentation: off, of these inside"]
        yield from table(head, rows)
        yield ""


def _kept(mean: dict[str, float], tasks: int) -> list[Row]:
    what = f'Pictures, `pictures="fast"`, {KEPT_SIZE_PIXELS} x {KEPT_SIZE_PIXELS}'
    fast, bare = mean["fast processor"], mean["bare processor"]
    return [
        Row(
            f"{what}: mean of {tasks} tabletop tasks, against SAPIEN's own calls",
            fast,
            bare,
            "ms of CPU time",
            "less",
            "pictures.py",
        ),
        Row(
            f"{what}: pixels that differ from exact ones by more than {OFF_BY} of 255, mean of {tasks} tabletop tasks",
            mean["off"],
            None,
            "%",
            "less",
            "pictures.py",
        ),
    ]


def _row(task: str, got: dict[str, float]) -> list[str]:
    processor = [got[f"{side} processor"] for side in ("bare", "exact", "fast")]
    return [
        task,
        *(f"{milliseconds:.1f}" for milliseconds in processor),
        f"{processor[0] / processor[2]:.1f}",
        f"{got['bare, all processor'] / got['fast, all processor']:.1f}",
        f"{got['error']:.2f} ({got['worst error']:.2f})",
        f"{got['off']:.2f} % ({got['worst off']:.2f})",
        f"{got['depth']:.1f}; {got['depth off']:.2f} %, {got['depth off inside']:.2f}",
        f"{got['segmentation']:.2f} %, {got['segmentation inside']:.3f}",
    ]


# --- speed of env-steps -------------------------------------------------------------------------------


def rate(step: Callable[[], object], num_envs: int, seconds: float) -> tuple[float, float]:
    """Env-steps per second, and CPU milliseconds per env-step over all processes."""
    step()
    count, start, before = 0, time.perf_counter(), _processor()
    while time.perf_counter() - start < seconds or count < 3:
        step()
        count += 1
    done = num_envs * count
    return done / (time.perf_counter() - start), 1e3 * (_processor() - before) / done


def _processor() -> float:
    """CPU seconds of this process and its children."""
    this = psutil.Process()
    every = (process.cpu_times() for process in (this, *this.children(recursive=True)))
    return sum(times.user + times.system for times in every)


def made_rate(num_envs: int, degree: Literal["exact", "fast"], seconds: float) -> tuple[float, float]:
    import torch

    import workbench

    torch.set_num_threads(1)
    env = workbench.make("PushCube-v1", num_envs, obs_mode="rgb", pictures=degree)
    env.reset(seed=0)
    return rate(lambda: env.step(env.action_space.sample()), num_envs, seconds)


def async_rate(num_envs: int, seconds: float) -> tuple[float, float]:
    import gymnasium as gym
    import mani_skill.envs  # noqa: F401
    import torch
    from mani_skill.utils.wrappers.gymnasium import CPUGymWrapper

    torch.set_num_threads(1)

    def make() -> gym.Env:
        return CPUGymWrapper(
            gym.make("PushCube-v1", obs_mode="rgb", sim_backend="physx_cpu", render_backend=RENDER_BACKEND)
        )

    envs = gym.vector.AsyncVectorEnv([make] * num_envs, context="spawn")
    envs.reset(seed=0)
    found = rate(lambda: envs.step(envs.action_space.sample()), num_envs, seconds)
    envs.close()
    return found


def steps(options: Options, kept: list[Row]) -> Iterator[str]:
    n, seconds = options.step_envs, options.seconds
    fast = in_own_process(made_rate, n, "fast", seconds)
    exact = in_own_process(made_rate, n, "exact", seconds)
    stock = in_own_process(async_rate, n, seconds)
    what = f'Pictures, `pictures="fast"`, 128 x 128: an env-step of {n} envs of PushCube-v1 with `obs_mode="rgb"`'
    what += f", against AsyncVectorEnv of {n}"
    kept.append(Row(what, fast[1], stock[1], "ms of CPU time", "less", "pictures.py"))
    yield f'## `make("PushCube-v1", {n}, obs_mode="rgb", pictures=...)`, 128 x 128'
    yield ""
    sides = {"fast": fast, "exact": exact, f"stock AsyncVectorEnv of {n}": stock}
    rows = [
        [name, f"{a_second:.0f}", f"{took:.1f}", f"{stock[1] / took:.1f}"]
        for name, (a_second, took) in sides.items()
    ]
    yield from table(["", "env-steps per second", "CPU ms per env-step", "stock / this"], rows)


def main(options: Options) -> None:
    for part in options.parts:
        kept: list[Row] = []
        for line in {"pictures": pictures, "steps": steps}[part](options, kept):
            print(line, flush=True)
        if options.write:
            keep(kept)


if __name__ == "__main__":
    main(tyro.cli(Options))
