"""Checks of the reward."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from workbench.checks.by_hook.evaluate import flags
from workbench.checks.evidence.checkup import CannotCheck, Check, Checkup, Found, Note
from workbench.checks.evidence.episodes import Episodes
from workbench.checks.evidence.odd_states import DENSE_HOOKS, odd_states
from workbench.core.capture.outliers import REWARD_RANGES, ROUNDING
from workbench.machine.text import of

REWARD_HOOKS = {**DENSE_HOOKS, "sparse": "compute_sparse_reward"}
LARGEST = 1.0 + 1e-4
"""Of a normalized reward, with room for rounding."""
ALL_THERE_IS = 0.999
"""A normalized reward from here on counts as the largest."""
SAME_RATIO = 1e-3
"""Largest difference from the dense reward over a constant, as a share of the largest normalized reward."""
TELLING = 0.05
"""The ratio is taken where the dense reward has this share of its largest, since rounding decides it near 0."""
CLEARLY_LOWER = 0.05
"""As a share of all rewards' range."""


def reward_finite(checkup: Checkup) -> Iterator[Found | Note]:
    """Over all rollouts and odd states."""
    what = (
        "Look for a division, a square root or a logarithm of what can be 0; clamp it, or use "
        "torch.linalg.norm(..., dim=1)."
    )
    for episodes in checkup.rollouts:
        reward = _rewards(checkup, episodes)
        bad = ~np.isfinite(reward)
        if bad.any():
            step, env = (int(i) for i in np.argwhere(bad)[0])
            count = of(int(bad.any(axis=0).sum()), bad.shape[1], f"{episodes.kind} episode")
            yield Found(
                f"the reward is {reward[step, env]} in {count}, first at step {step + 1} of seed {episodes.seeds[env]}. "
                f"{what}",
                checkup.places.hook(*_hooks(checkup)),
                int(bad.sum()),
            )
            return
    seen = checkup.look(odd_states)
    rewards = np.stack(seen.reward[checkup.task.env.reward_mode])
    bad = ~np.isfinite(rewards)
    if bad.any():
        row, env = (int(i) for i in np.argwhere(bad)[0])
        yield Found(
            f"the reward is {rewards[row, env]} in {of(int(bad.sum()), bad.size, 'state')} in which joints and bodies "
            f"were put, first {seen.kinds[row]} (seed {seen.seeds[row][env]}). {what}",
            checkup.places.hook(*_hooks(checkup)),
            int(bad.sum()),
        )


def reward_changes(checkup: Checkup) -> Iterator[Found | Note]:
    """Over random rollouts."""
    _require_dense(checkup)
    reward = _rewards(checkup, checkup.random)
    spread = float(np.nan_to_num(reward).max() - np.nan_to_num(reward).min())
    if spread < 1e-7:
        yield Found(
            f"the reward is {reward.flat[0]:.4g} at each of {reward.size} steps of random episodes. Let it depend on a "
            "distance that the robot changes.",
            checkup.places.hook(*_hooks(checkup)),
        )


def reward_normalized(checkup: Checkup) -> Iterator[Found | Note]:
    """Over all rollouts, where the reward is the normalized or the sparse one."""
    mode = checkup.task.env.reward_mode
    if mode not in REWARD_RANGES:
        raise CannotCheck("its reward is neither normalized nor sparse")
    least, most = REWARD_RANGES[mode]
    for episodes in checkup.rollouts:
        reward = _rewards(checkup, episodes)
        known = np.nan_to_num(reward)
        outside = (known < least - ROUNDING) | (known > most + ROUNDING)
        if not outside.any():
            continue
        low, high = float(np.nanmin(reward)), float(np.nanmax(reward))
        sparse = mode == "sparse"
        yield Found(
            f"the {'sparse' if sparse else 'normalized'} reward goes from {low:.3g} to {high:.3g} in {episodes.kind} "
            "episodes. "
            + (
                "Return 1 at success, -1 at fail and 0 elsewhere."
                if sparse
                else "Divide the dense reward by the largest that an episode can reach in one step."
            ),
            checkup.places.hook(
                *(
                    [REWARD_HOOKS[mode]]
                    if sparse
                    else ["compute_normalized_dense_reward", "compute_dense_reward"]
                )
            ),
            int(outside.sum()),
        )
        return


def reward_ratio(checkup: Checkup) -> Iterator[Found | Note]:
    """Both hooks, called on the same odd states."""
    rewards = checkup.look(odd_states).reward
    if not DENSE_HOOKS.keys() <= rewards.keys():
        raise CannotCheck("it lacks a dense or a normalized dense reward")
    dense, normalized = (np.concatenate(rewards[mode]) for mode in DENSE_HOOKS)
    finite = np.isfinite(dense) & np.isfinite(normalized)
    size = float(np.abs(dense[finite]).max(initial=0))
    telling = finite & (np.abs(dense) > TELLING * size)
    if not telling.any():
        raise CannotCheck("its dense reward is 0 or not finite in all states that were tried")
    constant = float(np.median(normalized[telling] / dense[telling]))
    wrong = np.abs(normalized - constant * dense)
    off = finite & (wrong > SAME_RATIO * np.abs(normalized[finite]).max())
    if off.any() and (line := _straight_line(dense[finite], normalized[finite])) is not None:
        yield Note(f"the normalized reward is the dense one times {line[0]:.4g} plus {line[1]:.4g}")
    elif off.any():
        first, worst = int(np.flatnonzero(telling)[0]), int(np.argmax(np.where(off, wrong, 0)))
        yield Found(
            f"the normalized reward is {normalized[worst]:.4g} where the dense reward is {dense[worst]:.4g}, and "
            f"{normalized[first]:.4g} where it is {dense[first]:.4g}: no single constant divides them. Write "
            "`return self.compute_dense_reward(obs, action, info) / LARGEST_REWARD`.",
            checkup.places.hook("compute_normalized_dense_reward", "compute_dense_reward"),
            int(off.sum()),
        )


def _straight_line(dense: NDArray, normalized: NDArray) -> tuple[float, float] | None:
    """Slope and offset with which the dense reward becomes the normalized one; None if it is no rising line."""
    if np.ptp(dense) == 0:
        return None
    slope, offset = (float(number) for number in np.polyfit(dense, normalized, 1))
    wrong = np.abs(slope * dense + offset - normalized).max()
    return (slope, offset) if slope > 0 and wrong <= SAME_RATIO * np.abs(normalized).max() else None


def reward_order(checkup: Checkup) -> Iterator[Found | Note]:
    """Over all rollouts and odd states, in episodes that have success."""
    _require_dense(checkup)
    lower: list[tuple[float, float, float, str]] = []
    compared = 0
    for scored in _scored(checkup):
        for column in range(scored.reward.shape[1]):
            reward, success = scored.reward[:, column], scored.success[:, column]
            if not success.any() or success.all():
                continue
            compared += 1
            row = int(np.argmax(np.where(success, -np.inf, reward)))
            at_success, elsewhere = float(reward[success].max()), float(reward[row])
            if elsewhere > at_success + CLEARLY_LOWER * scored.range:
                lower.append((elsewhere - at_success, at_success, elsewhere, scored.where(row, column)))
    if not compared:
        raise CannotCheck("no episode that was tried succeeds")
    if lower:
        _, at_success, elsewhere, where = max(lower)
        yield Found(
            f"the reward is at most {at_success:.4g} at success and {elsewhere:.4g} elsewhere in the same episode "
            f"({where}), in {of(len(lower), compared, 'episode')}. Give success the most: "
            '`reward[info["success"]] = LARGEST_REWARD`.',
            checkup.places.hook(*_hooks(checkup)),
            len(lower),
        )


def reward_needs_success(checkup: Checkup) -> Iterator[Found | Note]:
    """Over all rollouts and odd states, where the reward is the normalized one."""
    if checkup.task.env.reward_mode != "normalized_dense":
        raise CannotCheck("it has no normalized dense reward")
    given, places = 0, []
    for scored in _scored(checkup):
        if (scored.reward > LARGEST).any():
            raise CannotCheck("its normalized reward goes beyond 1")
        most = (scored.reward >= ALL_THERE_IS) & ~scored.success
        given += int(most.sum())
        places += [scored.where(int(row), int(column)) for row, column in np.argwhere(most)[:1]]
    if given:
        yield Found(
            f"the normalized reward is 1 without success in {given} states ({places[0]}): waiting there earns as much. "
            'Let success give the most: `reward[info["success"]] = LARGEST_REWARD`.',
            checkup.places.hook(*_hooks(checkup)),
            given,
        )


# --- rewards and success of many states --------------------------------------------------------------------


@dataclass(frozen=True)
class _Scored:
    """Rewards and success of T states of K episodes."""

    reward: NDArray
    """(T, K)"""
    success: NDArray[np.bool_]
    """(T, K)"""
    places: list[list[str]]
    """(1, K) or (T, K) which state that is, for a sentence."""

    @property
    def range(self) -> float:
        return float(np.ptp(self.reward))

    def where(self, row: int, column: int) -> str:
        if len(self.places) == 1:
            return f"step {row + 1} of {self.places[0][column]}"
        return self.places[row][column]


def _scored(checkup: Checkup) -> list[_Scored]:
    """Of all rollouts, then of the odd states of each batch."""
    found: list[_Scored] = []
    for episodes in checkup.rollouts:
        rewards = np.nan_to_num(_rewards(checkup, episodes))
        if "success" not in episodes.evaluate:
            raise CannotCheck("evaluate() has no entry success")
        success = flags(episodes.evaluate["success"][1:])
        actions = "" if episodes.kind == "random" else f" with {episodes.kind} actions"
        found.append(_Scored(rewards, success, [[f"seed {seed}{actions}" for seed in episodes.seeds]]))
    seen = checkup.look(odd_states)
    mode = checkup.task.env.reward_mode
    for seeds in dict.fromkeys(map(tuple, seen.seeds)):
        rows = [row for row, of_row in enumerate(seen.seeds) if tuple(of_row) == seeds]
        found.append(
            _Scored(
                np.nan_to_num(np.stack([seen.reward[mode][row] for row in rows])),
                flags(np.stack([seen.evaluate[row]["success"] for row in rows])),
                [[f"{seen.kinds[row]}, seed {seed}" for seed in seeds] for row in rows],
            )
        )
    return found


def _rewards(checkup: Checkup, episodes: Episodes) -> NDArray:
    """(T, K)"""
    if checkup.task.env.reward_mode == "none":
        raise CannotCheck("it has no reward")
    if not episodes.reward.size:
        raise CannotCheck("no step was made")
    return episodes.reward


def _require_dense(checkup: Checkup) -> None:
    if "dense" not in checkup.task.env.reward_mode:
        raise CannotCheck(f"its reward is {checkup.task.env.reward_mode}")


def _hooks(checkup: Checkup) -> tuple[str, ...]:
    """The hooks that make the present reward, as a person would look for them."""
    mode = checkup.task.env.reward_mode
    return ("compute_dense_reward", REWARD_HOOKS[mode]) if "dense" in mode else (REWARD_HOOKS[mode],)


CHECKS: Mapping[str, Check] = {
    "reward-finite": reward_finite,
    "reward-changes": reward_changes,
    "reward-normalized": reward_normalized,
    "reward-ratio": reward_ratio,
    "reward-order": reward_order,
    "reward-needs-success": reward_needs_success,
}
