"""Plans the actions of any env of a task, with rollouts on a separate batch of envs of the same task."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from mani_skill.agents.controllers.pd_joint_pos import PDJointPosController, PDJointPosMimicController
from mani_skill.envs.sapien_env import BaseEnv
from numpy.typing import NDArray

from workbench.envs import action_vector as actions
from workbench.envs.keywords import control_mode_of
from workbench.envs.maniskill_private import task_class
from workbench.envs.scene.scene_index import once_a_scene, read_poses, scene_index
from workbench.envs.snapshots.rng_state import read_shared_rng, write_shared_rng
from workbench.envs.snapshots.snapshot import Snapshot, restore_snapshot
from workbench.envs.task_env import EnvOptions, build_env
from workbench.planning.options import PlanOptions
from workbench.planning.sampling import Sampler

_ABSOLUTE_NOISE_FACTOR = 0.2
"""Factor on the noise for absolute joint positions: no plan crosses the whole range of a joint."""
_PLANNED_MODE = "pd_ee_delta_pose"
_NOT_FOR_ROLLOUTS = ("num_envs", "obs_mode", "render_mode", "render_backend", "sim_backend")
"""Keyword arguments of the live env that are not passed on to the envs of its rollouts: rollouts need no
pictures and no observations."""


class NotAlike(ValueError):
    """The envs of the task have different bodies, so that no env can stand in for another."""


class NothingToPlan(ValueError):
    """The task has no actions, or no reward by which one action is better than another."""


def require_plannable(env: BaseEnv) -> None:
    """Raise NothingToPlan if the task cannot be planned; builds nothing."""
    if env.reward_mode == "none":
        raise NothingToPlan(
            "there is nothing to plan: the planner maximises the reward, and the task has none"
        )
    if not actions.action_parts(env):
        raise NothingToPlan("there is nothing to plan: the task has no robot with a controller")


@dataclass(frozen=True)
class Plan:
    """Plan for one env, with the results of the last round of rollouts."""

    actions: NDArray[np.float32]
    """(H, A) flat actions, the next one first."""
    rewards: NDArray[np.float32]
    """(K, H) of all rollouts; 0 after a fail. Rollout 0 is the previous plan, and rollout 1 holds still."""
    terms: Mapping[str, NDArray[np.float32]]
    """(K,) sums of ``info["reward_terms"]`` over each rollout, by name; empty if the task has none."""
    success_at: NDArray[np.int32]
    """(K,) step at which each rollout succeeded, counted from 1; 0 without success."""
    seconds: float
    paths: NDArray[np.float32] | None = None
    """(K, H + 1, 3) path of the traced body in each rollout, metres in the env's frame."""

    @property
    def returns(self) -> NDArray[np.float32]:
        """(K,) return of each rollout; NaN or infinite if one of its rewards is."""
        return self.rewards.sum(1)

    @property
    def best(self) -> int:
        """The rollout with the highest return; NaN and infinite returns count as the worst."""
        returns = self.returns
        return int(np.where(np.isfinite(returns), returns, -np.inf).argmax())


def control_mode_to_plan(env: BaseEnv, given: Mapping[str, Any]) -> dict[str, str]:
    """Keyword argument of the control mode in which plans are found fastest; empty if `env` uses this mode
    already, if the robot lacks it, or if `given` names a mode.

    Each of the six dimensions of a hand motion has a direct effect on the bodies of a task; the motion of a
    single joint has none.
    """
    modes = getattr(env.agent, "supported_control_modes", ())
    if (
        given.get("control_mode") is not None
        or _PLANNED_MODE not in modes
        or env.control_mode == _PLANNED_MODE
    ):
        return {}
    return {"control_mode": _PLANNED_MODE}


def make_rollout_env(
    env: BaseEnv, kwargs: Mapping[str, Any], rollouts: int, threads: int | None = None
) -> BaseEnv:
    """Make envs for rollouts of the task of `env`: like `env`, but without what only a person or a policy sees.

    Args:
        env: the live env; the new envs use the same kind of simulation (CPU or GPU).
        kwargs: the keyword arguments that `env` was made with.
        rollouts: number of envs.
        threads: threads that step the envs on the CPU; None for one on each core that the process may use.

    Raises:
        Exception: raised by the author's class while it builds.
    """
    kept = {name: value for name, value in kwargs.items() if name not in _NOT_FOR_ROLLOUTS}
    # With "state" the reward gets the same parts as with "state_dict", but ManiSkill also flattens them to a
    # vector for a policy.
    plain = "state_dict" if "state_dict" in env.SUPPORTED_OBS_MODES else "state"
    kept["obs_mode"] = "none" if env.obs_mode == "none" else plain
    kept["reward_mode"] = env.reward_mode
    if (mode := control_mode_of(env)) is not None:
        kept["control_mode"] = mode
    options = EnvOptions(
        rollouts,
        backend="gpu" if env.device.type == "cuda" else "cpu",
        render=False,
        threads=threads,
        rules="off",  # the live env checks them
        kwargs=kept,
    )
    try:
        rolled = build_env(task_class(env), options)
    except Exception:
        # A missing renderer raises errors of many kinds: only a second try, with a renderer, shows whether
        # the task needs one.
        if not env.scene.can_render():
            raise
        rolled = build_env(task_class(env), replace(options, render=True))
    try:
        rolled.reset(seed=0)
    except BaseException:
        rolled.close()
        raise
    return rolled


class RolloutPlanner:
    """Plans the actions of a task's envs, one env after the other, on a batch of K envs of the same task.

    The author's reward is used unchanged: the return of a rollout is the sum of its rewards over the horizon, up to a fail. A
    rollout restores a snapshot and takes control steps.
    """

    def __init__(self, env: BaseEnv, options: PlanOptions, exact: bool = True) -> None:
        """
        Args:
            env: K envs of `make_rollout_env`, for exclusive use.
            exact: whether to restore exactly, so that the same snapshot, options and seed give the same plan to the last bit.

        Raises:
            ValueError: the number of envs differs from the number of rollouts.
        """
        if env.num_envs != options.rollouts:
            raise ValueError(f"{options.rollouts} rollouts need {options.rollouts} envs, not {env.num_envs}")
        self.env, self._options, self._exact = env, options, exact
        self._parts = actions.action_parts(env)
        self.horizon = options.steps(env.control_timestep, "success" in env.get_info())
        """H, control steps of a plan."""
        low, high = actions.bounds(self._parts)
        bounded = np.isfinite(low) & np.isfinite(high)
        self._low = torch.from_numpy(np.where(bounded, low, -1.0).astype(np.float32))
        self._high = torch.from_numpy(np.where(bounded, high, 1.0).astype(np.float32))
        dimensions = [part for part in self._parts for _ in part.names]
        self._switches = torch.tensor([_switches(part) for part in dimensions])
        self._scale = torch.tensor([_noise_scale(part) for part in dimensions])
        self._samplers: dict[int, Sampler] = {}
        self._alike: tuple[object, set[int]] = (None, set())
        """Scene of the live batch, and those of its envs that are known to have the same bodies as the
        rollouts' envs."""

    def begin(self, env: int, seed: int) -> None:
        """Begin an episode in this env of the live batch: forget its plan, and seed its candidates."""
        self._samplers[env] = Sampler(self._options, self.horizon, self._switches, self._scale, seed)

    def require_alike(self, live: BaseEnv, env: int) -> None:
        """Check that the rollouts' envs have the same bodies as this env of the live batch. The result is cached.

        Raises:
            NotAlike: the bodies differ, as in a randomly built scene; the message names them.
        """
        scene, known = self._alike
        if scene is not live.scene:
            self._alike = scene, known = live.scene, set()
        if env not in known:
            self.require_bodies(bodies_of(live)[env])
            known.add(env)

    def require_bodies(self, wanted: Mapping[str, bytes]) -> None:
        """Check as `require_alike` does, for a live env in another process.

        Args:
            wanted: bodies of the live env, from `bodies_of`.
        """
        for bodies in bodies_of(self.env):
            if bodies == wanted:
                continue
            other = sorted(name for name in {*bodies, *wanted} if bodies.get(name) != wanted.get(name))
            raise NotAlike(
                f"{', '.join(other)}: different in each env. Rollouts need envs with identical bodies: build the same bodies in "
                "each env, and randomise only their poses"
            )

    def plan(self, snapshot: Snapshot, env: int, traced: int | None = None) -> Plan:
        """Plan from the state that this env has in the snapshot, starting from the env's last plan.

        Preserves the state of the process's random generators.

        Args:
            traced: body that `Plan.paths` follows, as an index into `envs.scene.scene_index.SceneIndex.names`.

        Raises:
            KeyError: the env's episode was not begun.
            Exception: raised by the author's task in a step.
        """
        began = time.perf_counter()
        sampler = self._samplers[env]
        device = self.env.device
        shared = read_shared_rng(device)
        try:
            for _ in range(self._options.rounds):
                every = range(self.env.num_envs)
                restore_snapshot(self.env, snapshot, every, source=env, fresh_physics=self._exact)
                # Without this the random numbers of a task's step would depend on all earlier draws of this process.
                _seed_shared_rng(sampler.draw_seed())
                knots = sampler.candidates(self._hold())
                paths: list[NDArray[np.float32]] = []
                sequences = self._from_unit(sampler.sequences(knots))
                rewards, terms, succeeded = self._roll_out(sequences, traced, paths)
                sampler.improve(knots, rewards.sum(1))
        finally:
            write_shared_rng(shared, device)
        sequence = self._from_unit(sampler.sequences(sampler.plan[None]))[0]
        sampler.shift(self._options.every)
        return Plan(
            sequence.numpy(),
            rewards.numpy(),
            {name: term.numpy() for name, term in terms.items()},
            succeeded.numpy(),
            time.perf_counter() - began,
            np.stack(paths, 1) if paths else None,
        )

    def close(self) -> None:
        self.env.close()

    def _hold(self) -> torch.Tensor:
        hold = torch.from_numpy(actions.hold_action(self._parts, self.env.num_envs)[0])
        return (2 * hold - self._high - self._low) / (self._high - self._low)

    def _from_unit(self, action: torch.Tensor) -> torch.Tensor:
        sized = self._low + (action + 1) / 2 * (self._high - self._low)
        return torch.minimum(torch.maximum(sized, self._low), self._high)

    def _roll_out(
        self, sequences: torch.Tensor, traced: int | None, paths: list[NDArray[np.float32]]
    ) -> tuple[torch.Tensor, dict[str, torch.Tensor], torch.Tensor]:
        """Roll out actions (K, H, A) from the current state; returns rewards (K, H), sums of the terms (K,), and the steps of
        success (K,).

        Args:
            traced: body whose positions (K, 3), at the start and after each step, are appended to `paths`;
                None to trace no body.
        """
        count, horizon, _ = sequences.shape
        env, device = self.env, self.env.device
        sequences = sequences.to(device)
        rewards = torch.zeros((count, horizon), device=device)
        alive = torch.ones(count, dtype=torch.bool, device=device)
        succeeded = torch.zeros(count, dtype=torch.int32, device=device)
        terms: dict[str, torch.Tensor] = {}
        for h in range(horizon):
            if traced is not None:
                paths.append(read_poses(env)[:, traced, :3])
            _, reward, _, _, info = env.step(actions.by_robot(self._parts, sequences[:, h]))
            rewards[:, h] = torch.where(alive, _row(reward, rewards), 0.0)
            given: Any = info.get("reward_terms")
            for name, term in given.items() if isinstance(given, Mapping) else ():
                if isinstance(term, torch.Tensor) and term.shape == (count,):
                    terms[name] = terms.get(name, 0.0) + torch.where(alive, term.float(), 0.0)
            if "success" in info:
                now = _row(info["success"], alive) & alive & (succeeded == 0)
                succeeded[now] = h + 1
            if "fail" in info:
                alive &= ~_row(info["fail"], alive)
        if traced is not None:
            paths.append(read_poses(env)[:, traced, :3])
        return rewards.cpu(), {name: term.cpu() for name, term in terms.items()}, succeeded.cpu()


def _row(value: Any, like: torch.Tensor) -> torch.Tensor:
    """One number per env, with the type and device of `like`."""
    return torch.as_tensor(value, device=like.device).to(like.dtype)


def _seed_shared_rng(seed: int) -> None:
    torch.manual_seed(seed)
    np.random.seed(seed)


def _switches(part: actions.ActionPart) -> bool:
    """Whether the part is a gripper, for which values between open and closed are useless."""
    return isinstance(part.controller, PDJointPosMimicController) and len(part.names) == 1


def _noise_scale(part: actions.ActionPart) -> float:
    controller: Any = part.controller
    absolute = isinstance(controller, PDJointPosController) and not controller.config.use_delta
    return _ABSOLUTE_NOISE_FACTOR if absolute and not _switches(part) else 1.0


# --- comparison of the envs' bodies ----------------------------------------------------------------------


@once_a_scene
def bodies_of(env: BaseEnv) -> list[dict[str, bytes]]:
    """Hash of each body by name, one dict per env. The hash covers what determines how the body moves and
    collides, not its state. Equal bodies have the same hash in every process."""
    index = scene_index(env)
    return [
        {
            name: _body(entity)
            for name, entity in zip(index.names, entities, strict=True)
            if entity is not None
        }
        for entities in index.entities
    ]


def _body(entity: Any) -> bytes:
    digest = hashlib.blake2b(digest_size=16)
    for component in entity.components:
        shapes = getattr(component, "collision_shapes", None)
        if shapes is None:
            continue
        digest.update(repr(float(getattr(component, "mass", 0.0))).encode())
        for shape in shapes:
            digest.update(type(shape).__name__.encode())
            for name in ("half_size", "radius", "half_length", "scale", "vertices"):
                if (value := getattr(shape, name, None)) is not None:
                    digest.update(name.encode() + np.asarray(value).tobytes())
            digest.update(shape.local_pose.p.tobytes() + shape.local_pose.q.tobytes())
    return digest.digest()
