"""``workbench.make``: a ManiSkill task, batched on the CPU, as a standard gymnasium env."""

from __future__ import annotations

import linecache
import traceback
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec, WrapperSpec
from mani_skill.envs.sapien_env import BaseEnv

from workbench.envs.backends import BackendUnavailable, find_renderer
from workbench.envs.broken_rule import class_is_installed, warn_of
from workbench.envs.camera_data import PictureDegree
from workbench.envs.cpu_scene import BatchedCpuMixin
from workbench.envs.gpu_rules import Degree
from workbench.envs.task_env import Backend, EnvOptions, build_env, default_reward_mode
from workbench.machine.library_files import is_installed
from workbench.pictures.render import findings_of_shaders, list_cameras
from workbench.task import registry
from workbench.task.load import LoadedTask, class_of_module, load_task, task_of_class
from workbench.task.problem import definition_line
from workbench.task.reference import split_reference

_STATE_MODES = {"state", "state_dict", "none"}
"""The parts of an ``obs_mode`` that need no rendering."""


def make(
    task: str | Path | type[BaseEnv],
    num_envs: int = 1,
    *,
    backend: Backend = "auto",
    max_episode_steps: int | None = None,
    threads: int | None = None,
    rules: Degree | None = None,
    pictures: PictureDegree = "exact",
    **kwargs: Any,
) -> gym.Env:
    """Make a gymnasium env of `num_envs` envs, like ``gym.make`` on a GPU.

    gymnasium's own ``make`` is called with a spec whose entry point builds the batched env, so training code,
    ManiSkill's wrappers and its baselines find the usual spec, time limit and class. Nothing is registered or
    replaced: ``gym.make`` of the same id still makes ManiSkill's env. The arguments in ``env.spec`` are those
    of stock ManiSkill, so its tools can replay what ``RecordEpisode`` writes. This function differs from
    ``gym.make`` where stock ManiSkill would fail:

    * ``num_envs`` above 1 works without a GPU.
    * A task whose first reward mode is not implemented (its ``step`` raises NotImplementedError in stock ManiSkill) gets
      the richest mode that is implemented. For other tasks the default is stock ManiSkill's: the first of
      ``SUPPORTED_REWARD_MODES``.
    * ``render_backend`` is chosen if it is not given. Without a graphics driver, an env without pictures gets
      ``render_backend="none"``, and an env that needs pictures raises BackendUnavailable.
    * ``max_episode_steps=-1`` gives an env without a limit; ManiSkill's wrapper would end every episode.
    * Missing assets raise an error that names them, instead of a question on standard input.

    Args:
        task: a registered id (``PickCube-v1``), a file (``push.py``, ``push.py:PushEnv``), a class of a
            module (``lab.tasks:PushEnv``) or a class that inherits BaseEnv. Each call executes a file again,
            as the page does; ``gym.make`` then knows the ids that the file registers, too. A module is
            imported as by ``import``.
        num_envs: number of envs in the batch.
        backend: ``cpu``: batched on the CPU. ``gpu``: ManiSkill's GPU simulation, which needs CUDA and
            PhysX's GPU library. ``auto``: the CPU, even if there is a GPU, because the tests of GPU
            simulation have not passed on any machine so far. `backend` replaces ``sim_backend``.
        max_episode_steps: the time limit in control steps; None for the registered limit, -1 for no limit.
        threads: threads that step the envs on the CPU; None for one per core that the process may use.
        rules: rules of GPU simulation, checked on the CPU: ``stop`` raises if one is broken, ``warn`` warns,
            ``off`` checks none. None: raises if a task overwrites the state of other envs, and warns for all
            other rules; for an installed task, only warns.
        pictures: ``exact``: identical to stock ManiSkill, to the bit. ``fast``: several times as many
            pictures per second on the CPU, because robots and other heavy meshes are simplified to the detail
            that the cameras can see; warns that a policy trained on such pictures sees different pictures on
            a GPU.
        kwargs: arguments of ``gym.make`` for the task: ``obs_mode``, ``reward_mode``, ``control_mode``,
            ``render_mode``, ``robot_uids``, ``sensor_configs``, ``reconfiguration_freq``, ``sim_config`` ...

    Raises:
        TaskError: there is no such id, file or class, or the file cannot be imported; the message says where
            and why.
        MissingAssets: a download is needed; the message names it and the command.
        BackendUnavailable: this machine has no GPU simulation, or no renderer for the requested pictures.
        ValueError, TypeError: arguments that contradict each other.
    """
    _refuse_contradictions(num_envs, kwargs)
    found = _find_task(task)
    given = {**found.default_kwargs, **kwargs}
    if rules is None and not found.followed and class_is_installed(found.cls):
        rules = "warn"  # an installed task cannot be fixed here
    if given.get("reward_mode") is None and not _stock_reward_works(found.cls):
        # Stored in the spec's arguments, so that a replay with gym.make has a reward too.
        kwargs["reward_mode"] = default_reward_mode(found.cls)
    limits = ()
    if max_episode_steps == -1:
        max_episode_steps = limit = None
    else:
        limit = found.max_episode_steps
        # ``register_env`` adds the same wrapper. The wrapper removes gymnasium's own limit, which gives one
        # bool for all envs.
        entry = "mani_skill.utils.registration:TimeLimitWrapper"
        limits = (WrapperSpec("MSTimeLimit", entry_point=entry, kwargs={"max_episode_steps": limit}),)
    if pictures == "fast":
        warnings.warn(_FAST_PICTURES, stacklevel=2)
    options = EnvOptions(int(num_envs), backend, threads=threads, rules=rules, pictures=pictures)
    spec = EnvSpec(
        id=found.env_id,
        entry_point=partial(_build, found.cls, found.asset_ids, options),
        max_episode_steps=limit,
        disable_env_checker=True,  # it does not support batches
        kwargs=dict(found.default_kwargs),
        additional_wrappers=limits,
    )
    try:
        return gym.make(spec, max_episode_steps=max_episode_steps, num_envs=int(num_envs), **kwargs)
    except _RaisedInConstructor as raised:
        raise raised.error from raised.error.__cause__


_FAST_PICTURES = (
    'pictures="fast" renders simplified meshes: a policy trained on these pictures sees different pictures on a '
    'GPU, in stock ManiSkill and with the default, pictures="exact". In ManiSkill\'s tabletop tasks the pictures '
    "differ by 0.3 of 255 on average, and by more than 10 in 0.4 % of the pixels (128 x 128; more in "
    "`workbench help benchmarks`)."
)


class _RaisedInConstructor(Exception):
    """Carries a TypeError past gymnasium, which would raise a new TypeError without the author's frames."""

    def __init__(self, error: TypeError) -> None:
        super().__init__(error)
        self.error = error


def _build(
    cls: type[BaseEnv], asset_ids: Sequence[str], options: EnvOptions, num_envs: int, **kwargs: Any
) -> BaseEnv:
    try:
        return _built(cls, asset_ids, options, num_envs, **kwargs)
    except TypeError as error:
        if (place := _line_of(cls, error)) is not None:
            error.add_note(f"{place[0]}:{place[1]}: {linecache.getline(*place).strip()}")
        raise _RaisedInConstructor(error) from error


def _line_of(cls: type[BaseEnv], error: TypeError) -> tuple[str, int] | None:
    """The author's line that raised `error`; if there is none, as for an unknown keyword, the line of the
    constructor."""
    lines = [(frame.filename, frame.lineno or 1) for frame in traceback.extract_tb(error.__traceback__)]
    raised_at = next((line for line in reversed(lines) if not is_installed(line[0])), None)
    return raised_at or definition_line(cls.__init__)


def _built(
    cls: type[BaseEnv], asset_ids: Sequence[str], options: EnvOptions, num_envs: int, **kwargs: Any
) -> BaseEnv:
    if "render_backend" not in kwargs and find_renderer() is None:
        needs = _what_needs_pictures(cls, kwargs)
        if needs is not None:
            raise BackendUnavailable(
                f"{needs} needs a renderer, and SAPIEN finds no Vulkan driver on this machine: "
                "`workbench doctor` says which one to install."
            )
    # `num_envs` can differ from `options`: ``gym.make(env.spec, num_envs=2)`` gives another number.
    env = build_env(cls, replace(options, num_envs=num_envs, kwargs=kwargs), asset_ids=asset_ids)
    if isinstance(env, BatchedCpuMixin):
        for finding in findings_of_shaders(list_cameras(env)):
            warn_of(finding)
    return env


def _refuse_contradictions(num_envs: Any, kwargs: Mapping[str, Any]) -> None:
    whole = isinstance(num_envs, (int, float, np.integer)) and not isinstance(num_envs, bool)
    if not whole or num_envs != num_envs // 1 or num_envs < 1:
        raise ValueError(f"num_envs must be an integer of at least 1, not {num_envs!r}")
    if "sim_backend" in kwargs:
        raise ValueError(
            f"sim_backend={kwargs['sim_backend']!r}: leave it out. backend= names the simulation here: "
            'backend="cpu" (batched on the CPU), "gpu" (ManiSkill\'s GPU simulation) or "auto". '
            "For stock ManiSkill use gym.make."
        )
    if kwargs.get("render_backend", "found") in (None, "none"):
        needs = _what_needs_pictures(None, kwargs)
        if needs is not None:
            raise ValueError(f"{needs} needs pictures, but render_backend='none' disables rendering")


def _what_needs_pictures(cls: type[BaseEnv] | None, kwargs: Mapping[str, Any]) -> str | None:
    """The argument, as text, that needs rendering; None if there is none."""
    if kwargs.get("render_mode") is not None:
        return f"render_mode={kwargs['render_mode']!r}"
    obs_mode = kwargs.get("obs_mode") or (cls.SUPPORTED_OBS_MODES[0] if cls is not None else "state")
    if set(obs_mode.split("+")) - _STATE_MODES:
        return f"obs_mode={obs_mode!r}"
    return None


def _stock_reward_works(cls: type[BaseEnv]) -> bool:
    """Whether the class implements ManiSkill's default reward mode."""
    mode = cls.SUPPORTED_REWARD_MODES[0]
    hook = f"compute_{mode}_reward"
    return mode not in ("dense", "normalized_dense") or getattr(cls, hook) is not getattr(BaseEnv, hook)


def _find_task(task: str | Path | type[BaseEnv]) -> LoadedTask:
    if not isinstance(task, (str, Path, type)):
        raise TypeError(
            f"make() takes a registered id, a file or a class that inherits BaseEnv, not {type(task).__name__}"
        )
    cls = task if isinstance(task, type) else None
    if cls is None and registry.environment(str(task)) is None:
        named = split_reference(str(task))
        cls = None if named is None else class_of_module(*named)
    if cls is not None:
        if not registry.is_task(cls):
            raise TypeError(f"{cls.__name__} does not inherit mani_skill.envs.sapien_env.BaseEnv")
        return task_of_class(cls, registry.id_of(cls) or cls.__name__)
    loaded = load_task(str(task))
    for notice in loaded.notices:
        warnings.warn(notice, stacklevel=3)
    return loaded
