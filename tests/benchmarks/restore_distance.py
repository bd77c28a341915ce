"""Deviation of a run after a restore, by kind of task: python tests/benchmarks/restore_distance.py

One run of each task is recorded. Then some of its moments are restored in several ways, and the run continues with its
recorded actions. Printed is the largest difference from the uninterrupted run over all envs and moments: of any number of
the state (velocities included), and of any joint (rad; m for prismatic joints).

    put there       `TaskEnv.restore`: a new PhysX scene, and the state of the moment
    quick           the same with ``fresh_physics=False``
    warmed          an earlier moment put there, the steps from it repeated, then a quick restore of the moment
    lived through   the run's first moment put there, and every action up to the moment repeated

The run begins like a live page's: with a reset that can be restored exactly (`envs.snapshots.snapshot.begin_anew`). A page goes
back in the last way (`live.worker.go_back`), and in the first way if that is not exact to the byte, takes too long, or begins
before the kept history.
"""

# ManiSkill annotates an env's members with the widest types of all tasks.
# pyright: reportAttributeAccessIssue=false, reportOptionalMemberAccess=false, reportArgumentType=false

from __future__ import annotations

import sys
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mani_skill.envs  # noqa: F401  registers the ids
import numpy as np
import torch
import tyro
from mani_skill.utils.registration import REGISTERED_ENVS
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).parents[2]))
from workbench.envs import action_vector as actions
from workbench.envs.snapshots.snapshot import Snapshot, begin_anew
from workbench.envs.task_env import EnvOptions, TaskEnv, make_env

AFTER_STEPS = (1, 5, 20)
"""Control steps after which the runs are compared."""
WARMING_STEPS = 4
"""Control steps that the way "warmed" repeats."""
Put = Callable[[TaskEnv], None]


@dataclass(frozen=True)
class Kind:
    """A kind of task: a ManiSkill task and its robot's motion."""

    name: str
    env_id: str
    held: str | None = None
    """The actor placed in the gripper, which stays closed; without one all joints move at random."""


KINDS = (
    Kind("free motion", "PickCube-v1"),
    Kind("a cube pushed", "PushCube-v1"),
    Kind("a cube held", "PickCube-v1", "cube"),
    Kind("a peg held", "PegInsertionSide-v1", "peg"),
    Kind("a ball and a bin", "PlaceSphere-v1"),
    Kind("a tee pushed", "PushT-v1"),
    Kind("a cart-pole", "MS-CartpoleBalance-v1"),
    Kind("a hopper", "MS-HopperHop-v1"),
    Kind("an ant", "MS-AntWalk-v1"),
    Kind("a humanoid", "MS-HumanoidStand-v1"),
    Kind("three fingers and a cube", "TriFingerRotateCubeLevel0-v1"),
    Kind("a drawer", "OpenCabinetDrawer-v1"),
)


@dataclass(frozen=True)
class Options:
    kinds: tuple[str, ...] = ()
    """Names from `KINDS`; all if empty."""
    num_envs: int = 4
    moments: tuple[int, ...] = (8, 16, 24, 32)
    """Control steps of the run to restore."""


@dataclass(frozen=True)
class Run:
    """A recorded run by moment; moment 0 is the reset."""

    snapshots: list[Snapshot]
    actions: list[NDArray[np.float32]]
    states: list[NDArray[np.float32]]
    qpos: list[NDArray[np.float32]]


def state_of(task: TaskEnv) -> NDArray[np.float32]:
    return task.env.get_state().numpy().copy()


def qpos_of(task: TaskEnv) -> NDArray[np.float32]:
    return np.asarray(task.env.scene.px.cuda_articulation_qpos.torch()).copy()


def make_run(task: TaskEnv, kind: Kind, steps: int) -> Run:
    env, rng = task.env, np.random.default_rng(0)
    task.reset(seed=0)
    if kind.held is not None:
        held, hand = getattr(env, kind.held), env.agent.tcp.pose.raw_pose.clone()
        pose = held.pose.raw_pose.clone()
        pose[:, :3] = hand[:, :3]
        held.set_pose(pose)
        env.scene._gpu_apply_all()
        env.scene._gpu_fetch_all()
    begin_anew(env, list(range(task.num_envs)))
    run = Run([task.snapshot()], [], [state_of(task)], [qpos_of(task)])
    for _ in range(steps):
        action = actions.random_action(task.parts, task.num_envs, rng)
        if kind.held is not None:
            action[:, :-1] *= 0.3
            action[:, -1] = -1.0
        task.step(action)
        run.actions.append(action)
        run.snapshots.append(task.snapshot())
        run.states.append(state_of(task))
        run.qpos.append(qpos_of(task))
    return run


def ways(run: Run, moment: int) -> Iterator[tuple[str, Put]]:
    def put_there(task: TaskEnv) -> None:
        task.restore(run.snapshots[moment])

    def quick(task: TaskEnv) -> None:
        task.restore(run.snapshots[moment], fresh_physics=False)

    def warmed(task: TaskEnv) -> None:
        begin = max(0, moment - WARMING_STEPS)
        task.restore(run.snapshots[begin])
        for action in run.actions[begin:moment]:
            task.step(action)
        task.restore(run.snapshots[moment], fresh_physics=False)

    def replayed(task: TaskEnv) -> None:
        task.restore(run.snapshots[0])
        for action in run.actions[:moment]:
            task.step(action)

    yield "put there", put_there
    yield "quick", quick
    yield "warmed", warmed
    yield "lived through", replayed


def measure(kind: Kind, options: Options) -> Iterator[str]:
    torch.manual_seed(0)
    spec = REGISTERED_ENVS[kind.env_id]
    made = EnvOptions(options.num_envs, "cpu", render=kind.env_id == "PushT-v1", rules="off")
    task = TaskEnv(make_env(spec.cls, made, asset_ids=spec.asset_download_ids or ()))
    run = make_run(task, kind, max(options.moments) + max(AFTER_STEPS))
    found: dict[str, dict[int, tuple[float, float]]] = {}
    seconds: dict[str, float] = {}
    for moment in options.moments:
        for way, put in ways(run, moment):
            began = time.perf_counter()
            put(task)
            seconds[way] = max(seconds.get(way, 0.0), time.perf_counter() - began)
            for done in range(1, max(AFTER_STEPS) + 1):
                task.step(run.actions[moment + done - 1])
                if done in AFTER_STEPS:
                    state = worst(state_of(task), run.states[moment + done])
                    qpos = worst(qpos_of(task), run.qpos[moment + done])
                    before = found.setdefault(way, {}).get(done, (0.0, 0.0))
                    found[way][done] = max(before[0], state), max(before[1], qpos)
    task.close()
    for way, distances in found.items():
        cells = [f"{state:.1e} / {qpos:.1e}" for state, qpos in distances.values()]
        yield (
            f"| {kind.name} | {kind.env_id} | {way} | " + " | ".join(cells) + f" | {1e3 * seconds[way]:.0f} |"
        )


def worst(a: NDArray[Any], b: NDArray[Any]) -> float:
    return float(np.abs(a.astype(np.float64) - b).max(initial=0.0))


def main(options: Options) -> None:
    warnings.filterwarnings("ignore")
    chosen = [kind for kind in KINDS if not options.kinds or kind.name in options.kinds]
    print("| kind | task | way | " + " | ".join(f"after {n}: state / qpos" for n in AFTER_STEPS) + " | ms |")
    print("|" + "---|" * (4 + len(AFTER_STEPS)))
    for kind in chosen:
        try:
            for line in measure(kind, options):
                print(line, flush=True)
        except Exception as error:  # for example a missing download
            print(f"| {kind.name} | {kind.env_id} | {type(error).__name__}: {error} |", flush=True)


if __name__ == "__main__":
    main(tyro.cli(Options))
