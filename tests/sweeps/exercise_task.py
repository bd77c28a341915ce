"""Check on one built-in task what the core guarantees for every task, with cameras on.

With four envs: seeded resets, random actions, a partial reset of two envs that must not change a bit of the other two,
a snapshot whose restores are reproducible, and pictures that are not blank. The task's own faults (`upstream_faults`)
are recorded, and the remaining stages still run.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import Any

import mani_skill.envs  # noqa: F401  registers the ids
import numpy as np
import torch
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.utils.registration import REGISTERED_ENVS
from torch.utils import _pytree as pytree

from tests.sweeps.upstream_faults import Fault, faults_of, where_it_fails
from workbench.envs import action_vector as actions
from workbench.envs.assets import MissingAssets, robots_of
from workbench.envs.evaluate_entries import wrong_evaluate
from workbench.envs.snapshots.snapshot import restore_snapshot, take_snapshot
from workbench.envs.task_env import EnvOptions, TaskEnv, make_env
from workbench.pictures.render import Request, list_cameras, take_pictures

NUM_ENVS = 4
SEEDS = [11, 12, 13, 14]
ACTIONS = 6
RESET, KEPT = [1, 3], [0, 2]
STEPS_AGAIN = 5
ROUNDING = 1e-6
"""Absolute. PhysX stores a root pose at its centre of mass, so a restore may change the last bit."""
OBS_MODES = ("rgb+depth+segmentation", "rgb+segmentation", "sensor_data")


@dataclass
class Row:
    """Result for one id; plain values, since a pipe carries it as JSON."""

    env_id: str
    robot: str = ""
    outcome: str = ""
    """``passed``, ``upstream`` (passed except for the task's own faults), ``download`` or ``failed``."""
    seconds: float = 0.0
    cameras: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    after_restore: list[float] = field(default_factory=list)
    """Largest difference of any number of the state, `STEPS_AGAIN` steps after a restore: from the uninterrupted run, and
    from the run after a second restore."""

    def as_dict(self) -> dict[str, Any]:
        return asdict(self)


def exercise(env_id: str) -> Row:
    """Run all stages and return the row; an exception becomes a ``failed`` row that names its stage."""
    row = Row(env_id, _default_robots(env_id))
    begun = time.perf_counter()
    stage = ["make"]
    env = None
    try:
        env = _made(env_id)
        row.robot = _robots_in(env.env) or "none"
        _all_stages(env, row, stage)
        row.outcome = row.outcome or "passed"
    except MissingAssets as missing:
        row.outcome, row.notes = "download", list(missing.names) or [str(missing)]
    except Exception as error:
        row.outcome = "failed"
        row.notes.append(f"{stage[0]}: {type(error).__name__}: {error}")
    finally:
        if env is not None:
            env.close()
    row.seconds = round(time.perf_counter() - begun, 1)
    return row


def _made(env_id: str) -> TaskEnv:
    spec = REGISTERED_ENVS[env_id]
    kwargs = {"obs_mode": obs_mode_of(spec.cls), "render_mode": "rgb_array"}
    options = EnvOptions(NUM_ENVS, "cpu", render=True, rules="off", kwargs=kwargs)
    env = make_env(
        spec.cls, options, asset_ids=spec.asset_download_ids or (), default_kwargs=spec.default_kwargs
    )
    return TaskEnv(env, spec.max_episode_steps)


def obs_mode_of(task: type[BaseEnv]) -> str:
    """Return the task's observation mode with the most picture types."""
    supported = task.SUPPORTED_OBS_MODES
    return next(m for m in OBS_MODES if m in supported or (m == OBS_MODES[0] and "any_textures" in supported))


def _all_stages(env: TaskEnv, row: Row, stage: list[str]) -> None:
    faults = faults_of(row.env_id)
    rng = np.random.default_rng(0)

    stage[0] = "reset"
    _check_start(env.reset(seed=SEEDS).elapsed_steps, env)
    first = _states(env)
    env.reset(seed=SEEDS)
    assert _states(env) == first, "the same seeds gave different initial states"
    _check_observed(env.obs, row)

    stage[0] = "step"
    for _ in range(ACTIONS):
        step = env.step(_action(env, rng))
        assert np.isfinite(step.reward).all() and np.isfinite(step.poses[:, :, 0]).any(), "NaN"
    assert env.env.elapsed_steps.tolist() == [ACTIONS] * NUM_ENVS
    _check_observed(env.obs, row)
    wrong = wrong_evaluate(env.env.evaluate(), NUM_ENVS)
    if wrong is not None:
        row.notes.append(f"evaluate() {wrong}")

    stage[0] = "get_state"
    _or_its_fault(faults.get(stage[0]), env.env.get_state, row)

    stage[0] = "partial reset"
    before, kept_controllers = _states(env), _controllers(env)

    def partial_reset() -> None:
        result = env.reset(seed=77, env_idx=RESET)
        assert result.elapsed_steps.tolist() == [ACTIONS, 0, ACTIONS, 0]
        after = _states(env)
        assert all(after[i] == before[i] for i in KEPT), "an env that was not reset changed"
        assert any(after[i] != before[i] for i in RESET), "nothing was reset"
        assert torch.equal(_controllers(env), kept_controllers), "a neighbour's controller was reset, too"

    if not _or_its_fault(faults.get(stage[0]), partial_reset, row):
        env.reset(seed=SEEDS)
        env.step(_action(env, rng))

    stage[0] = "snapshot"
    again = [_action(env, rng) for _ in range(STEPS_AGAIN)]
    snapshot = take_snapshot(env.env)
    at = _states(env)
    uninterrupted = _run(env, again)
    restore_snapshot(env.env, snapshot)
    assert _largest_difference(_states(env), at) <= ROUNDING, "the restored state differs"
    once = _run(env, again)
    restore_snapshot(env.env, snapshot)
    twice = _run(env, again)
    row.after_restore = [
        _largest_difference(a, b) for a, b in ((uninterrupted[-1], once[-1]), (once[-1], twice[-1]))
    ]

    stage[0] = "pictures"
    _check_pictures(env, row)


def _or_its_fault(fault: Fault | None, attempt: Callable[[], Any], row: Row) -> bool:
    """Return True if `attempt` worked, False if it failed at the line of `fault`; raise other errors."""
    try:
        attempt()
    except AssertionError:
        raise
    except Exception as error:
        where = None if fault is None else where_it_fails(fault, error)
        if fault is None or where is None:
            raise
        row.outcome = "upstream"
        row.notes.append(f"{fault.stage}: {where}: {fault.why} (upstream: {fault.upstream})")
        return False
    if fault is not None:
        raise RuntimeError(
            f"{fault.stage} works: upstream fixed {fault.file}; remove it from upstream_faults"
        )
    return True


def _states(env: TaskEnv) -> list[bytes]:
    px: Any = env.env.scene.px
    return [system.pack() for system in px.systems]


def _largest_difference(some: list[bytes], others: list[bytes]) -> float:
    """Return the largest difference between two lists of packed states."""
    largest = 0.0
    for state, other in zip(some, others, strict=True):
        a, b = (np.frombuffer(packed, np.float32).astype(np.float64) for packed in (state, other))
        largest = max(largest, float(np.abs(a - b).max(initial=0.0)))
    return largest


def _controllers(env: TaskEnv) -> torch.Tensor:
    """Return the controller state of the envs that are not reset, (len(KEPT), K)."""
    agent: Any = env.env.agent
    state = {} if agent is None else agent.get_controller_state()
    leaves = [leaf[KEPT].reshape(len(KEPT), -1) for leaf in pytree.tree_leaves(state)]
    return torch.cat(leaves, dim=1) if leaves else torch.zeros(len(KEPT), 0)


def _action(env: TaskEnv, rng: np.random.Generator) -> Any:
    return actions.random_action(env.parts, NUM_ENVS, rng) if env.parts else None


def _run(env: TaskEnv, chosen: list[Any]) -> list[list[bytes]]:
    states = []
    for action in chosen:
        env.step(action)
        states.append(_states(env))
    return states


def _check_start(elapsed: np.ndarray, env: TaskEnv) -> None:
    assert elapsed.tolist() == [0] * NUM_ENVS
    assert env.episode_seeds.tolist() == SEEDS


def _check_observed(obs: Any, row: Row) -> None:
    """Assert that ManiSkill's observation has a picture of every env and that none is blank."""
    for camera, textures in obs.get("sensor_data", {}).items():
        for name, values in textures.items():
            assert values.shape[0] == NUM_ENVS and values.ndim == 4, f"{camera} {name}: {tuple(values.shape)}"
            blank = [i for i in range(NUM_ENVS) if bool((values[i] == values[i, :1, :1]).all())]
            assert not blank, f"{camera} {name}: one value all over in envs {blank}"
    row.cameras = sorted(obs.get("sensor_data", {}))


def _check_pictures(env: TaskEnv, row: Row) -> None:
    frames = env.env.render()
    assert isinstance(frames, torch.Tensor) and frames.shape[0] == NUM_ENVS and frames.shape[-1] == 3, (
        "render()"
    )
    assert frames.dtype == torch.uint8 and all(len(frame.unique()) > 1 for frame in frames), (
        "render() is blank"
    )
    wanted: list[Request] = [(camera.name, camera.kind, ["rgb"]) for camera in list_cameras(env.env)]
    for picture in take_pictures(env.env, RESET[0], wanted):
        assert picture.rgb is not None and len(np.unique(picture.rgb)) > 1, f"{picture.camera} is blank"
    row.cameras = [name for name, _, _ in wanted]


def _default_robots(env_id: str) -> str:
    """Return the class's default robots, for a task that could not be made."""
    spec = REGISTERED_ENVS[env_id]
    robots = robots_of(spec.cls, spec.default_kwargs)
    several = robots if isinstance(robots, (tuple, list)) else [robots]
    return ", ".join(robot if isinstance(robot, str) else getattr(robot, "uid", "") for robot in several)


def _robots_in(env: BaseEnv) -> str:
    agent: Any = env.agent
    return "" if agent is None else ", ".join(robot.uid for robot in getattr(agent, "agents", [agent]))
