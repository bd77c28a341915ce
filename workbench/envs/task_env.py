"""A running task: N envs behind one interface that gives plain arrays."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, get_args

import numpy as np
import torch
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.utils import common
from numpy.typing import NDArray

from workbench.envs import action_vector as actions
from workbench.envs import maniskill_private
from workbench.envs.assets import refuse_downloads, require_assets, robots_of
from workbench.envs.backends import (
    Backend,
    BackendUnavailable,
    choose_backend,
    keep_render_device,
    sapien_device,
)
from workbench.envs.broken_rule import BrokenRules, warn_of
from workbench.envs.camera_data import PictureDegree
from workbench.envs.contact_forces import pair_forces
from workbench.envs.cpu_scene import batched_class, refuse_unbuilt_env
from workbench.envs.evaluate_entries import FLAGS, flat_entries, split_entries
from workbench.envs.gpu_rules import Degree, Finding, degrees_of
from workbench.envs.indices import envs_of_batch
from workbench.envs.keywords import constructor_arguments
from workbench.envs.maniskill_private import episode_seeds, flatten_observation, keep_observation
from workbench.envs.partial_reset import in_ascending_order, seeded
from workbench.envs.scene.scene_index import read_joints, read_poses
from workbench.envs.snapshots.snapshot import (
    RestoreReport,
    Snapshot,
    remembering,
    restore_snapshot,
    take_snapshot,
)
from workbench.envs.step_result import BodyPair, StepResult
from workbench.envs.strict import StrictMixin
from workbench.envs.task_drawings import drawings
from workbench.envs.wrong_options import wrong_option


@dataclass(frozen=True)
class EnvOptions:
    """Options for building the envs of a task."""

    num_envs: int = 16
    backend: Backend = "auto"
    """``cpu``: batched on the CPU. ``gpu``: ManiSkill's GPU simulation. ``auto``: see `choose_backend`."""
    render: bool = True
    """False: no render system is made, so there are no pictures, and no graphics driver is used."""
    threads: int | None = None
    """Threads that step the envs on the CPU; None for one on each core that the process may use."""
    pictures: PictureDegree = "exact"
    """Degree of the pictures that the env itself draws: observations and ``render``."""
    rules: Degree | None = None
    """One degree for all rules of GPU simulation, which are checked on the CPU; None: each rule has its own
    degree, see `gpu_rules`."""
    on_finding: Callable[[Finding], None] = warn_of
    """Called once for each place where a rule that does not stop the task is broken."""
    kwargs: Mapping[str, Any] = field(default_factory=dict)
    """Further keyword arguments of the task class: ``obs_mode``, ``robot_uids``, ``control_mode`` ... If they
    include ``render_backend``, no renderer is searched for."""

    def __post_init__(self) -> None:
        if self.num_envs < 1:
            raise ValueError(f"num_envs must be at least 1, not {self.num_envs}")
        if self.backend not in get_args(Backend):
            raise ValueError(f"backend must be one of {', '.join(get_args(Backend))}, not {self.backend!r}")
        if self.pictures not in get_args(PictureDegree):
            raise ValueError(
                f"pictures must be one of {', '.join(get_args(PictureDegree))}, not {self.pictures!r}"
            )
        degrees_of(self.rules)  # raises for an unknown degree
        if self.threads is not None and self.threads < 1:
            raise ValueError(f"threads must be at least 1, or None for all cores, not {self.threads}")


def given_arguments(
    task: type[BaseEnv], env_kwargs: Mapping[str, Any], default_kwargs: Mapping[str, Any]
) -> dict[str, Any]:
    """Keyword arguments for the constructor of the task class, from the registration and the user.

    Args:
        env_kwargs: the user's arguments, in JSON.
        default_kwargs: the arguments of the registration; the user's arguments take precedence.
    """
    return {**default_kwargs, **constructor_arguments(task, env_kwargs, BaseEnv)}


def make_env(
    task: type[BaseEnv],
    options: EnvOptions,
    *,
    asset_ids: Sequence[str] = (),
    default_kwargs: Mapping[str, Any] | None = None,
) -> BaseEnv:
    """Make N envs of the task class, unwrapped, in the class's `default_reward_mode`.

    Raises:
        MissingAssets: the task or its robot needs a download; the message has its name and the command.
        BackendUnavailable: this machine cannot simulate on a GPU, or the installed ManiSkill lacks private names.
        WrongOption: a keyword argument of `options` does not exist, or has an unknown value.
        Exception: raised by the author's class while it builds.
    """
    reward = {"reward_mode": default_reward_mode(task)}
    return build_env(task, options, asset_ids=asset_ids, default_kwargs={**reward, **(default_kwargs or {})})


def build_env(
    task: type[BaseEnv],
    options: EnvOptions,
    *,
    asset_ids: Sequence[str] = (),
    default_kwargs: Mapping[str, Any] | None = None,
) -> BaseEnv:
    """Make N envs of the task class, unwrapped, as ``gym.make(...).unwrapped`` does; raises like `make_env`.

    The class decides what the keyword arguments leave open. Without ``reward_mode`` it takes the first of its
    ``SUPPORTED_REWARD_MODES``, even if it does not implement that mode.
    """
    if moved := maniskill_private.why_not(""):
        raise BackendUnavailable(moved)
    kwargs = {**(default_kwargs or {}), **options.kwargs, "num_envs": options.num_envs}
    require_assets(task.__name__, asset_ids, robots_of(task, kwargs))
    # ManiSkill also takes None for "none".
    wanted = (kwargs.get("render_backend", "found") or "none") if options.render else "none"
    # A process has one render device: do not look for another when one is named.
    backend = choose_backend(options.backend, render=wanted == "found")
    kwargs["render_backend"] = backend.render_backend if wanted == "found" else wanted
    if kwargs["render_backend"] != "none":
        keep_render_device(kwargs["render_backend"])
    drawn_by_gpu = sapien_device(kwargs["render_backend"]).startswith("cuda")
    if options.pictures == "fast" and (backend.simulation == "gpu" or drawn_by_gpu):
        raise BackendUnavailable(_NO_FAST_PICTURES)
    try:
        with refuse_downloads(task.__name__):
            if backend.simulation == "gpu":
                env = task(sim_backend="physx_cuda", **kwargs)
                refuse_unbuilt_env(env, task, options.num_envs)
                return env
            made = batched_class(task, options.threads, options.rules, options.on_finding, options.pictures)
            return made(**kwargs)
    except Exception as error:
        if (wrong := wrong_option(task, options.kwargs, error)) is not None:
            raise wrong from error
        raise


_NO_FAST_PICTURES = (
    'Fast pictures are for software renderers: a GPU draws exact pictures faster. Leave out pictures="fast" '
    "(on the command line: --fast-pictures)."
)


def default_reward_mode(task: type[BaseEnv]) -> str:
    """The richest reward mode that the class implements.

    ManiSkill's own default is ``normalized_dense``, even for a class without a dense reward: the first step
    of such a task then raises a bare NotImplementedError.
    """
    wanted = ("normalized_dense", "dense", "sparse", "none")
    method = {"normalized_dense": "compute_normalized_dense_reward", "dense": "compute_dense_reward"}
    for mode in wanted:
        hook = method.get(mode)
        implemented = hook is None or getattr(task, hook) is not getattr(BaseEnv, hook)
        if mode in task.SUPPORTED_REWARD_MODES and implemented:
            return mode
    return "none"


class TaskEnv:
    """N envs of one task, on the CPU or a GPU: reset, step and snapshots, in plain arrays."""

    def __init__(
        self,
        env: BaseEnv,
        max_episode_steps: int | None = None,
        check: Callable[[Mapping[str, Any], Any], None] | None = None,
        obs: Any = None,
    ) -> None:
        """
        Args:
            env: an unwrapped ManiSkill env (see `make_env`).
            max_episode_steps: the time limit that ``gym.make``'s wrapper would apply.
            check: called with ``info`` and the reward (None after a reset), before they are converted to
                arrays; raises if the task returned something wrong.
            obs: the last observation of an env that already runs, as its ``obs_mode`` gives it.
        """
        self.env = env
        self.max_episode_steps = max_episode_steps
        self.obs: Any = obs
        """The last observation, as the task's ``obs_mode`` gives it."""
        self._check = check
        self.watched_forces: tuple[BodyPair, ...] = ()
        """Pairs of bodies whose contact forces are in each `StepResult`."""

    @property
    def num_envs(self) -> int:
        return self.env.num_envs

    @property
    def parts(self) -> tuple[actions.ActionPart, ...]:
        return actions.action_parts(self.env)

    @property
    def control_dt(self) -> float:
        """Simulated seconds in one control step."""
        return self.env.control_timestep

    def reset(
        self,
        seed: int | Sequence[int] | None = None,
        env_idx: Sequence[int] | None = None,
        options: Mapping[str, Any] | None = None,
    ) -> StepResult:
        """Start new episodes in all envs, or in those of `env_idx`.

        A reset of all envs is ManiSkill's own ``reset(seed=[...])``. For a subset ManiSkill seeds torch with
        the seed of env 0, so a seed given for env 3 has no effect. Here a partial reset takes its random
        numbers from the seed of the lowest env in `env_idx`: ``reset(seed=7, env_idx=[3])`` starts the same
        episode as ``reset(seed=7)`` of a single stock env. Listing the envs, with their seeds, in another
        order makes no difference.

        Args:
            seed: one seed (the i-th env that is reset gets ``seed + i``), or one for each env that is reset; None
                continues with the task's own random numbers.
            options: further ``options`` for the task's own ``reset``.
        """
        chosen = envs_of_batch(range(self.num_envs) if env_idx is None else env_idx, self.num_envs)
        seeds = _seed_list(seed, len(chosen))
        if env_idx is None:
            self.obs, info = self.env.reset(seed=seeds, options=dict(options or {}))
        else:
            self.obs, info = self._partial_reset(chosen, seeds, options or {})
        info = {key: value for key, value in info.items() if key != "reconfigure"}
        if self._check is not None:
            self._check(info, None)
        return self.result(info, np.zeros(self.num_envs), None)

    def _partial_reset(
        self, chosen: list[int], seeds: list[int] | None, further: Mapping[str, Any]
    ) -> tuple[Any, dict[str, Any]]:
        # The CPU mixin does this too, but an env in GPU simulation has only ManiSkill's own reset.
        options, seeds = in_ascending_order({**further, "env_idx": chosen}, seeds, self.env)
        if seeds is None:
            return self.env.reset(options=options)
        with seeded(self.env, sorted(chosen), seeds):
            return self.env.reset(options=options)

    def step(self, action: NDArray[np.float32] | None) -> StepResult:
        """Make one control step with a flat action (N, A); None leaves the controllers' targets unchanged.

        A task without a controller ignores the action.
        """
        action = action if self.parts else None
        env_action = None if action is None else actions.to_env_action(self.env, self.parts, action)
        self.obs, reward, terminated, _, info = self.env.step(env_action)
        if self._check is not None:
            self._check(info, reward)
        return self.result(info, reward, action, terminated)

    def snapshot(self, env_idx: Sequence[int] | None = None) -> Snapshot:
        """Copy of everything that decides how the episodes of these envs (None: of all) continue; see
        `take_snapshot`."""
        return take_snapshot(self.env, env_idx)

    def restore(
        self,
        snapshot: Snapshot,
        env_idx: Sequence[int] | None = None,
        source: int | Sequence[int] | None = None,
        fresh_physics: bool = True,
    ) -> tuple[StepResult, RestoreReport]:
        """Restore envs, as `restore_snapshot` does, then observe and evaluate. The reward is zero, as after a reset."""
        report = restore_snapshot(self.env, snapshot, env_idx, source, fresh_physics)
        return self.rescore(), report

    def rescore(self, action: NDArray[np.float32] | None = None) -> StepResult:
        """Compute ``evaluate``, observation and reward of the present state, without a step.

        Args:
            action: (N, A) action that led to this state, for the reward; None gives rewards of zero, as after
                a reset.
        """
        reward: Any = None
        with remembering(self.env):
            info = self.env.get_info()
            obs = self.env.get_obs(info, unflattened=True)
            if action is not None:
                flat = actions.to_env_action(self.env, self.parts, action)
                made: Any = common.to_tensor(flat, device=self.env.device) if self.parts else None
                reward = self.env.get_reward(obs=obs, action=made, info=info)
            self.obs = flatten_observation(self.env, obs)
            keep_observation(self.env, self.obs)
        if self._check is not None:
            self._check(info, reward)
        return self.result(info, np.zeros(self.num_envs) if reward is None else reward, action)

    @property
    def observes_pictures(self) -> bool:
        """Whether every step renders pictures for the observation."""
        return self.env.obs_mode not in ("state", "state_dict", "none")

    @property
    def episode_seeds(self) -> NDArray[np.int64]:
        """(N,) seeds of the last resets."""
        return np.array(episode_seeds(self.env), dtype=np.int64)

    @property
    def broken_rules(self) -> BrokenRules | None:
        """Breaches of the rules of GPU simulation; None if no rule is checked."""
        return self.env.broken_rules if isinstance(self.env, StrictMixin) else None

    def close(self) -> None:
        self.env.close()

    def result(
        self,
        info: Mapping[str, Any],
        reward: Any,
        action: NDArray[np.float32] | None,
        terminated: Any = None,
        truncated: Any = None,
        look: bool = True,
    ) -> StepResult:
        """The result of the last step or reset, even if it was made on `env` directly.

        Args:
            action: (N, A) of the step; None after a reset, or after a step without an action.
            terminated, truncated: None to take them from `info` and the time limit.
            look: whether to compute `StepResult.sound_obs`.
        """
        count = self.num_envs
        elapsed = _column(self.env.elapsed_steps, np.int32, count)
        if terminated is None:
            flags = [_column(info[key], bool, count) for key in FLAGS if key in info]
            terminated = np.logical_or.reduce(flags) if flags else False
        if truncated is None:
            truncated = self.max_episode_steps is not None and elapsed >= self.max_episode_steps
        evaluate, others = split_entries(info, count)
        return StepResult(
            elapsed_steps=elapsed,
            reward=_column(reward, np.float32, count),
            terminated=_column(terminated, bool, count),
            truncated=_column(truncated, bool, count),
            evaluate=evaluate,
            others=others,
            poses=read_poses(self.env),
            qpos=read_joints(self.env),
            action=None if action is None else np.array(action, dtype=np.float32),
            sound_obs=_sound(self.obs, count) if look else None,
            forces=pair_forces(self.env, self.watched_forces, (elapsed > 0) & (action is not None)),
            drawn=drawings.of_batch(count) if drawings.on else {},
        )


def _seed_list(seed: int | Sequence[int] | None, count: int) -> list[int] | None:
    if seed is None:
        return None
    seeds = [seed + i for i in range(count)] if isinstance(seed, int) else [int(s) for s in seed]
    if len(seeds) != count:
        raise ValueError(f"{len(seeds)} seeds for {count} envs: give one for each env, or a single number")
    return seeds


def _sound(obs: Any, num_envs: int) -> NDArray[np.bool_]:
    """`StepResult.sound_obs`; a value that is not a batch of floats counts as finite."""
    sound = np.ones(num_envs, bool)
    for name, value in flat_entries(obs):
        # Skip pictures: they are large, and come from the renderer, not from the task.
        if name.startswith("sensor_data/") or not isinstance(value, torch.Tensor):
            continue
        if value.is_floating_point() and value.ndim and len(value) == num_envs:
            sound &= to_numpy(torch.isfinite(value.reshape(num_envs, -1)).all(dim=1))
    return sound


def _column(value: Any, dtype: type, num_envs: int) -> NDArray[Any]:
    """(N, ...) copy of `value`; a value without a row for each env is repeated for each env."""
    array = np.array(value.numpy(force=True) if isinstance(value, torch.Tensor) else value, dtype)
    if num_envs == array.size == 1:
        return array.reshape(1)
    batched = array.ndim > 0 and len(array) == num_envs
    return array if batched else np.broadcast_to(array, (num_envs, *array.shape)).copy()


def to_numpy(value: Any) -> NDArray[Any]:
    """A copy on the host, which the next step does not change."""
    if isinstance(value, torch.Tensor):
        return value.numpy(force=True).copy()
    return np.array(value)
