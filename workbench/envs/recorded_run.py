"""A recorded episode as plain arrays, the names of its columns, and the keywords that remake its env."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from workbench.envs.keywords import control_mode_of

if TYPE_CHECKING:
    from mani_skill.envs.sapien_env import BaseEnv  # the server imports this module and must not load torch


@dataclass(frozen=True)
class RecordedRun:
    """T actions of one env, and the T + 1 states of its episode if they were recorded.

    State 0 is the reset; action t leads to state t + 1.
    """

    name: str
    """Name to show."""
    seed: int
    """Episode seed; negative if unknown."""
    reset_options: dict[str, Any]
    """``options`` of the reset that began the episode."""
    action: NDArray[np.float32]
    """(T, A)"""
    env_states: dict[str, NDArray]
    """``actors/cube``, ``articulations/panda`` ..., (T + 1, D) each, as ManiSkill's ``get_state_dict`` lays them out;
    empty if no states were recorded."""
    evaluate: dict[str, NDArray] = field(default_factory=dict)
    """(T + 1, ...) every entry that ``evaluate`` returned."""
    reward: NDArray[np.float32] = field(default_factory=lambda: np.zeros(0, np.float32))
    """(T,); empty if the task had no reward."""

    @property
    def length(self) -> int:
        """T, the number of control steps."""
        return len(self.action)

    def state(self, at: int) -> dict[str, NDArray]:
        """State (D,) of each actor and articulation at index `at`; empty if it was not recorded."""
        return {name: rows[at] for name, rows in self.env_states.items() if at < len(rows)}

    def until(self, state: int) -> RecordedRun:
        """Copy of the run up to and including state index `state`."""
        return replace(
            self,
            action=self.action[:state],
            env_states={name: rows[: state + 1] for name, rows in self.env_states.items()},
            evaluate={name: rows[: state + 1] for name, rows in self.evaluate.items()},
            reward=self.reward[:state],
        )


def pose_distances(a: NDArray, b: NDArray) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Distances between the poses `a` and `b`: (...) in metres and (...) in radians.

    Both distances are 0 where both poses are NaN, and infinite where only one pose is NaN.

    Args:
        a, b: (..., 7) position in metres and quaternion wxyz.
    """
    a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
    lacks = ~np.isfinite(a).all(-1), ~np.isfinite(b).all(-1)
    with np.errstate(invalid="ignore"):
        metres = np.linalg.norm(a[..., :3] - b[..., :3], axis=-1)
        # Use the chord between the quaternions: in single precision, the arc cosine of their dot product
        # cannot tell angles below 3e-4 from zero. q and -q are the same rotation.
        p, q = a[..., 3:], b[..., 3:]
        chord = np.minimum(np.linalg.norm(p - q, axis=-1), np.linalg.norm(p + q, axis=-1))
        radians = 4 * np.arcsin(np.clip(chord / 2, 0, 1))
    found = (np.where(lacks[0] | lacks[1], np.inf, distance) for distance in (metres, radians))
    metres, radians = (np.where(lacks[0] & lacks[1], 0.0, distance) for distance in found)
    return metres, radians


# --- names of columns --------------------------------------------------------------------------------


STATE, OBS = "state/", "obs/"
"""Prefixes of column names: ``state/actors/cube``, ``obs/agent/qpos``."""


def states_of(columns: Mapping[str, NDArray], env: int) -> dict[str, NDArray]:
    """States of one env, by actor or articulation; leaves out bodies that the env lacks (rows of NaN)."""
    rows = {name[len(STATE) :]: column[env] for name, column in columns.items() if name.startswith(STATE)}
    return {name: row for name, row in rows.items() if not np.isnan(row).all()}


# --- keywords of ``gym.make`` that make an env again ------------------------------------------------


RUN_KEYWORDS = frozenset({"num_envs", "sim_backend", "render_backend", "render_device", "render_mode"})
"""Keywords that change how an env is run, not what it is."""


def env_kwargs(env: BaseEnv, given: Mapping[str, Any]) -> dict[str, Any]:
    """Keywords of ``gym.make`` that make `env` again: `given` and the env's modes.

    Leaves out values that JSON cannot hold, and `RUN_KEYWORDS`, which ManiSkill's ``replay_trajectory``
    chooses itself when it calls ``gym.make(env_id, **env_kwargs)``.
    """
    modes: dict[str, Any] = {"obs_mode": env.obs_mode, "reward_mode": env.reward_mode}
    if (mode := control_mode_of(env)) is not None:
        modes["control_mode"] = mode
    every = {**given, **modes}
    return {name: every[name] for name in every if name not in RUN_KEYWORDS and _is_json(every[name])}


def _is_json(value: Any) -> bool:
    try:
        return json.loads(json.dumps(value)) == value or isinstance(value, tuple)
    except (TypeError, ValueError):
        return False
