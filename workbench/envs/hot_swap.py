"""Exchanges the class or the cameras of a running env; its scene stays."""

from __future__ import annotations

from collections.abc import Callable, Collection
from contextlib import nullcontext
from typing import Any

import torch
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.utils import common

from workbench.envs import maniskill_private
from workbench.envs.cpu_scene import BatchedCpuMixin, batched_class
from workbench.envs.simulation.cpu_system import batched_system
from workbench.envs.snapshots.snapshot import in_this_state, restore_memory, restore_snapshot, take_snapshot
from workbench.envs.strict import StrictMixin


def put_class(env: BaseEnv, task: type[BaseEnv]) -> None:
    """Make `env` an env of `task`; state, scene and attributes stay. Takes a microsecond and moves no body.

    Args:
        env: an unwrapped env, batched on the CPU or on the GPU.
        task: the author's class. The caller ensures that this class builds the same scene
            (`workbench.task.reload_level`).
    """
    own: Any = type(env)
    if not issubclass(own, BatchedCpuMixin):
        env.__class__ = task
        return
    if issubclass(own, StrictMixin):
        put = batched_class(
            task, own._workbench_threads, own._rule_choice, own._on_finding, own._workbench_pictures
        )
    else:
        put = batched_class(task, own._workbench_threads, "off", pictures=own._workbench_pictures)
    env.__class__ = put


def can_exchange_cameras(env: BaseEnv) -> bool:
    """Whether `exchange_cameras` is possible.

    It is impossible in GPU simulation, whose camera groups cannot be undone; if a sensor is not an ordinary
    camera; and if ManiSkill lacks a private name that the exchange needs.
    """
    if maniskill_private.why_not(maniskill_private.EXCHANGING):
        return False
    plain = all(
        maniskill_private.camera_components(camera) for camera in maniskill_private.cameras(env).values()
    )
    return plain and batched_system(env.scene) is not None


def exchange_cameras(env: BaseEnv) -> None:
    """Replace the env's cameras by those that its class configures now.

    No picture may be pending. If the class raises, the env lacks the cameras that were not made.
    """
    if not env.scene.can_render():
        return
    env.scene.forget_fast_shapes()  # type: ignore[attr-defined]  # always a batched scene
    for camera in maniskill_private.cameras(env).values():
        for component in maniskill_private.camera_components(camera):
            # Keep the empty entity. Without it, SAPIEN would renumber the other entities in the scene of a
            # restored snapshot (`cpu_state`), and segmentation pictures name bodies by these numbers.
            component.entity.remove_component(component)
    maniskill_private.forget_cameras(env)
    with torch.random.fork_rng(devices=[]):
        maniskill_private.set_up_sensors(env)


def rehearse_hooks(env: BaseEnv, hooks: Collection[str]) -> dict[str, str]:
    """Call hooks of resets and steps as ManiSkill does, to check that they work, and undo their effects.

    The hooks' writes are not applied, so PhysX continues as before, to the last bit. If a hook itself applies
    its writes, or steps the simulation, the state is restored from a snapshot.

    Args:
        hooks: ``_initialize_episode`` (called with all envs, and with one) and hooks without arguments.

    Returns:
        What could not be undone (for example attributes that a hook made): name and reason.

    Raises:
        Exception: raised by a hook. The state is restored; attributes that the hook added stay.
    """
    every = list(range(env.num_envs))

    def call() -> None:
        for hook in sorted(hooks):
            if hook != "_initialize_episode":
                getattr(env, hook)()
                continue
            for chosen in [every, every[:1]] if env.num_envs > 1 else [every]:
                maniskill_private.set_reset_mask(env, chosen)
                env._initialize_episode(torch.tensor(chosen, device=env.device), {})

    return undone(env, call)


def undone(env: BaseEnv, do: Callable[[], None]) -> dict[str, str]:
    """Call `do`, and undo what it did to the env. Returns and raises like `rehearse_hooks`."""
    every = list(range(env.num_envs))
    kept, px = take_snapshot(env), batched_system(env.scene)
    try:
        with (
            torch.random.fork_rng(devices=[env.device] if env.device.type == "cuda" else []),
            nullcontext() if px is None else px.holding_back(),
        ):
            do()
    finally:
        maniskill_private.set_reset_mask(env, every)
        own = isinstance(env, BatchedCpuMixin)
        if own:
            env.drop_writes()
        if own and all(in_this_state(env, i, kept, i) for i in every):
            _, missed = restore_memory(env, kept.memory, every, every, whole=True)
        else:
            missed = restore_snapshot(env, kept).not_carried
    return missed


def keep_observation_space(env: BaseEnv, obs: Any) -> None:
    """Set the env's observation space from this observation, since an edited hook may return another shape."""
    if env.obs_mode != "none":
        env.update_obs_space(common.to_cpu_tensor(obs))
