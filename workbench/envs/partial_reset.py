"""Resets of some envs that change neither state nor random numbers of the others."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from mani_skill.agents.controllers.base_controller import BaseController, CombinedController
from mani_skill.utils.structs import Pose

from workbench.envs.broken_rule import find_assignment
from workbench.envs.error_notes import CoreRefusal, ErrorNote
from workbench.envs.indices import env_numbers, envs_of_batch
from workbench.envs.kept_rows import KeptRows
from workbench.envs.maniskill_private import agents, drawing_from, set_episode_seeds, task_class


class KeptControllers:
    """Copy of the active controllers' state for some envs: start, target and everything else with a row per env.

    ManiSkill 3.0.1 resets the controllers of every env in a partial reset: it sets the reset mask back to all ones before
    ``controller.reset()``, which reads that mask. A controller with ``use_target`` then takes the present joints as its
    target in envs that are not reset. So these values are kept and put back before the first observation.
    """

    def __init__(self, env: Any, kept_envs: list[int]) -> None:
        self._rows = torch.tensor(kept_envs, dtype=torch.long, device=env.device)
        self._kept: list[tuple[BaseController, str, torch.Tensor]] = []
        for controller in active_controllers(env):
            for name, value in vars(controller).items():
                rows = value.raw_pose if isinstance(value, Pose) else value
                if isinstance(rows, torch.Tensor) and rows.shape[:1] == (env.num_envs,):
                    self._kept.append((controller, name, rows[self._rows].clone()))

    def put_back(self) -> None:
        for controller, name, rows in self._kept:
            value = getattr(controller, name)
            (value.raw_pose if isinstance(value, Pose) else value)[self._rows] = rows


def active_controllers(env: Any, robots: list[Any] | None = None) -> list[BaseController]:
    """The controllers in use, with each combined controller replaced by its parts; empty without a robot.

    Args:
        robots: the agents whose controllers are wanted; by default all.
    """
    single: list[BaseController] = []
    for agent in agents(env) if robots is None else robots:
        combined = isinstance(agent.controller, CombinedController)
        single += agent.controller.controllers.values() if combined else [agent.controller]
    return single


TARGET_FLAGS = ("sets_target_qpos", "sets_target_qvel")
"""Attributes that say which drive targets a controller sets. ManiSkill reads them in each step, on the GPU
only."""


def without_target_flags(env: Any) -> list[BaseController]:
    """The robots' controllers that lack an attribute of `TARGET_FLAGS`: ``BaseController`` has neither."""
    controllers = [agent.controller for agent in agents(env)]
    return [one for one in controllers if not all(hasattr(one, flag) for flag in TARGET_FLAGS)]


def untouched_envs(env: Any, options: dict[str, Any] | None) -> list[int]:
    """The envs that a reset with these options does not touch; empty for a reset of all envs."""
    chosen = _chosen(env, options or {})
    return [] if chosen is None else sorted(set(range(env.num_envs)).difference(chosen))


def _chosen(env: Any, options: Mapping[str, Any]) -> list[int] | None:
    """The envs to reset that `options` names; None for all. As in ManiSkill, -1 is the last env, and a mask
    (N,) names the envs where it is True."""
    named = options.get("env_idx")
    if named is None:
        return None
    count = env.num_envs
    if isinstance(named, (torch.Tensor, np.ndarray)) and named.dtype in (torch.bool, np.bool_):
        named = np.flatnonzero(np.asarray(named)) if named.shape == (count,) else named
    chosen = [i + count if -count <= i < 0 else i for i in env_numbers(named)]
    return envs_of_batch(chosen, count)


def in_ascending_order(
    options: dict[str, Any], seeds: Any, env: Any
) -> tuple[dict[str, Any], list[int] | None]:
    """Options of a partial reset with the envs, and the rows that belong to them, in ascending order.

    ManiSkill's setters give the first row to the lowest env that is reset; ``self.x[env_idx] = rows`` gives
    it to the first env of ``env_idx``. Only in ascending order are these the same env.

    Args:
        seeds: the ``seed`` argument of ``reset``.

    Returns:
        The options; and the seeds in the same order, or None if the reset is of all envs or `seeds` does not
        have one seed for each env to reset.

    Raises:
        TypeError, IndexError, ValueError: ``env_idx`` is a mask of the wrong length, or names an unknown env,
            an env twice, or no env.
    """
    chosen = _chosen(env, options)
    if chosen is None:
        return options, None
    order = sorted(range(len(chosen)), key=chosen.__getitem__)
    one_each = np.ndim(seeds) == 1 and len(seeds) == len(chosen)
    rows = torch.tensor([chosen[k] for k in order], dtype=torch.long, device=env.device)
    made = {**options, "env_idx": rows}
    states = options.get("reset_to_env_states", {})
    if "obs" in states:
        # ManiSkill assigns rows of observations in the order of `env_idx`, but rows of states in ascending
        # order of the envs.
        made["reset_to_env_states"] = {**states, "obs": _rows(states["obs"], order)}
    return made, [int(seeds[k]) for k in order] if one_each else None


def _rows(value: Any, order: list[int]) -> Any:
    if isinstance(value, dict):
        return {name: _rows(held, order) for name, held in value.items()}
    return value[order] if np.ndim(value) else value


@contextmanager
def seeded(env: Any, env_idx: list[int], seeds: list[int]) -> Iterator[None]:
    """Context in which a reset of these envs, in ascending order, starts their episodes from these seeds.

    ``BaseEnv.reset(seed=[...])`` cannot do this: it takes the list as the seeds of the whole batch.
    """
    set_episode_seeds(env, env_idx, seeds)
    devices = [env.device] if env.device.type == "cuda" else []
    with torch.random.fork_rng(devices=devices), drawing_from(env, env_idx[0]):
        torch.manual_seed(seeds[0])
        yield


@contextmanager
def note_what_was_reset(env: Any, untouched: list[int]) -> Iterator[None]:
    """Add notes to an exception of a partial reset: which envs were being reset, and which buffers have fewer
    rows now.

    If a hook replaces a buffer of N rows by one of ``len(env_idx)`` rows, another hook, which has no mistake,
    fails with torch's message about sizes.
    """
    if not untouched:
        yield
        return
    chosen = sorted(set(range(env.num_envs)).difference(untouched))
    rows = KeptRows(env, chosen)
    try:
        yield
    except CoreRefusal:
        raise  # its message needs no note
    except Exception as error:
        error.add_note(ErrorNote(f"Envs {chosen} of {env.num_envs} were being reset."))
        for path in (path for path, envs in rows.changed_envs().items() if not envs):
            place = find_assignment(task_class(env), path)
            at = "" if place is None else f" ({Path(place[0]).name}:{place[1]})"
            error.add_note(
                ErrorNote(f"self.{path}: {env.num_envs} rows before the reset, {len(chosen)} now{at}.")
            )
        raise
