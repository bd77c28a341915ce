"""Checks of the reward."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from workbench.checks.checkup import CannotCheck, Check, Checkup, Episodes, Found, Note
from workbench.checks.evaluate import of

REWARD_HOOKS = {
    "dense": "compute_dense_reward",
    "normalized_dense": "compute_normalized_dense_reward",
    "sparse": "compute_sparse_reward",
}
LARGEST = 1.0 + 1e-4
"""Of a normalized reward, with room for rounding."""


def reward_finite(checkup: Checkup) -> Iterator[Found | Note]:
    """Over random rollouts."""
    reward = _rewards(checkup)
    bad = ~np.isfinite(reward)
    if bad.any():
        step, env = (int(i) for i in np.argwhere(bad)[0])
        yield Found(
            f"the reward is {reward[step, env]} in {of(int(bad.any(axis=0).sum()), bad.shape[1], 'random episode')}, "
            f"first at step {step + 1} of seed {checkup.random.seeds[env]}. Look for a division, a square root or a "
            "logarithm of what can be 0; clamp it, or use torch.linalg.norm(..., dim=1).",
            checkup.places.hook(*_hooks(checkup)),
            int(bad.sum()),
        )


def reward_changes(checkup: Checkup) -> Iterator[Found | Note]:
    """Over random rollouts."""
    if "dense" not in checkup.task.env.reward_mode:
        raise CannotCheck(f"its reward is {checkup.task.env.reward_mode}")
    reward = _rewards(checkup)
    spread = float(np.nan_to_num(reward).max() - np.nan_to_num(reward).min())
    if spread < 1e-7:
        yield Found(
            f"the reward is {reward.flat[0]:.4g} at each of {reward.size} steps of random episodes. Let it depend on a "
            "distance that the robot changes.",
            checkup.places.hook(*_hooks(checkup)),
        )


def reward_normalized(checkup: Checkup) -> Iterator[Found | Note]:
    """Over random rollouts, where the reward is the normalized one."""
    if checkup.task.env.reward_mode != "normalized_dense":
        raise CannotCheck("it has no normalized dense reward")
    reward = _rewards(checkup)
    outside = np.abs(np.nan_to_num(reward)) > LARGEST
    if outside.any():
        low, high = float(np.nanmin(reward)), float(np.nanmax(reward))
        yield Found(
            f"the normalized reward goes from {low:.3g} to {high:.3g} in random episodes. Divide the dense reward by "
            "the largest that an episode can reach in one step.",
            checkup.places.hook("compute_normalized_dense_reward", "compute_dense_reward"),
            int(outside.sum()),
        )


def _rewards(checkup: Checkup) -> np.ndarray:
    """(T, K) of random rollouts."""
    episodes: Episodes = checkup.random
    if checkup.task.env.reward_mode == "none":
        raise CannotCheck("it has no reward")
    if not episodes.reward.size:
        raise CannotCheck("no step was made")
    return episodes.reward


def _hooks(checkup: Checkup) -> tuple[str, ...]:
    """The hooks that make the present reward, as a person would look for them."""
    mode = checkup.task.env.reward_mode
    return ("compute_dense_reward", REWARD_HOOKS[mode]) if "dense" in mode else (REWARD_HOOKS[mode],)


CHECKS: Mapping[str, Check] = {
    "reward-finite": reward_finite,
    "reward-changes": reward_changes,
    "reward-normalized": reward_normalized,
}
