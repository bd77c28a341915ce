"""Checks of the reward."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from workbench.checks.by_hook.evaluate import flags
from workbench.checks.evidence.checkup import CannotCheck, Check, Checkup, Found, Note
from workbench.checks.evidence.episodes import Episodes
from workbench.checks.evidence.odd_states import DENSE_HOOKS, odd_states
from workbench.checks.evidence.over_seeds import OverSeeds, first_kind, tried
from workbench.checks.results import Seen
from workbench.core.broken_rule import Place
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


def see_reward_finite(checkup: Checkup) -> Iterator[Seen]:
    """Over all rollouts, up to the kind with a breach; else over odd states."""
    place = checkup.places.hook(*_hooks(checkup))
    for episodes in checkup.rollouts:
        reward = _rewards(checkup, episodes)
        bad = ~np.isfinite(reward)
        seeds = tuple(episodes.seeds[i] for i in np.flatnonzero(bad.any(axis=0)))
        texts: tuple[str, ...] = ()
        if seeds:
            step, env = (int(i) for i in np.argwhere(bad)[0])
            texts = f"{reward[step, env]}", f"first at step {step + 1} of seed {episodes.seeds[env]}"
        yield Seen((episodes.kind,), place, bad.shape[1], seeds, int(bad.sum()), texts=texts)
        if seeds:
            return
    seen = checkup.look(odd_states)
    rewards = np.stack(seen.reward[checkup.task.env.reward_mode])
    bad = ~np.isfinite(rewards)
    texts = ()
    if bad.any():
        row, env = (int(i) for i in np.argwhere(bad)[0])
        texts = f"{rewards[row, env]}", f"first {seen.kinds[row]} (seed {seen.seeds[row][env]})"
    yield Seen(("", "odd states"), place, bad.size, count=int(bad.sum()), texts=texts)


def reward_finite(rows: Sequence[Seen]) -> Iterator[Found | Note]:
    if (row := first_kind(sorted(rows, key=lambda row: len(row.names)))) is None:
        return
    if len(row.names) == 1:
        where = of(len(row.seeds), row.tried, f"{row.names[0]} episode")
    else:
        where = f"{of(row.count, row.tried, 'state')} in which joints and bodies were put"
    yield Found(
        f"the reward is {row.texts[0]} in {where}, {row.texts[1]}. Look for a division, a square root or a logarithm of "
        "what can be 0; clamp it, or use torch.linalg.norm(..., dim=1).",
        row.place,
        row.count,
    )


def see_reward_changes(checkup: Checkup) -> Iterator[Seen]:
    """Over random rollouts: the largest and the smallest."""
    _require_dense(checkup)
    reward = _rewards(checkup, checkup.random)
    known = np.nan_to_num(reward)
    yield Seen(
        place=checkup.places.hook(*_hooks(checkup)),
        tried=reward.size,
        numbers=(float(known.max()), float(known.min())),
        texts=(f"{reward.flat[0]:.4g}",),
    )


def reward_changes(rows: Sequence[Seen]) -> Iterator[Found | Note]:
    """One step with another reward than all others is enough."""
    most, least = max(row.numbers[0] for row in rows), min(row.numbers[1] for row in rows)
    if most - least < 1e-7:
        yield Found(
            f"the reward is {rows[0].texts[0]} at each of {tried(rows)} steps of random episodes. Let it depend on a "
            "distance that the robot changes.",
            rows[0].place,
        )


def see_reward_normalized(checkup: Checkup) -> Iterator[Seen]:
    """Over all rollouts, where the reward is the normalized or the sparse one, up to the kind with a breach."""
    mode = checkup.task.env.reward_mode
    if mode not in REWARD_RANGES:
        raise CannotCheck("its reward is neither normalized nor sparse")
    least, most = REWARD_RANGES[mode]
    sparse = mode == "sparse"
    hooks = [REWARD_HOOKS[mode]] if sparse else ["compute_normalized_dense_reward", "compute_dense_reward"]
    for episodes in checkup.rollouts:
        reward = _rewards(checkup, episodes)
        known = np.nan_to_num(reward)
        outside = (known < least - ROUNDING) | (known > most + ROUNDING)
        yield Seen(
            (episodes.kind,),
            checkup.places.hook(*hooks),
            count=int(outside.sum()),
            numbers=(float(np.nanmin(reward)), float(np.nanmax(reward)))
            if not np.isnan(reward).all()
            else (),
            texts=("sparse" if sparse else "normalized",),
        )
        if outside.any():
            return


def reward_normalized(rows: Sequence[Seen]) -> Iterator[Found | Note]:
    if (row := first_kind(rows)) is None:
        return
    ranges = [one.numbers for one in rows if one.names == row.names and one.numbers]
    low, high = min(low for low, _ in ranges), max(high for _, high in ranges)
    yield Found(
        f"the {row.texts[0]} reward goes from {low:.3g} to {high:.3g} in {row.names[0]} episodes. "
        + (
            "Return 1 at success, -1 at fail and 0 elsewhere."
            if row.texts[0] == "sparse"
            else "Divide the dense reward by the largest that an episode can reach in one step."
        ),
        row.place,
        row.count,
    )


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


def see_reward_order(checkup: Checkup) -> Iterator[Seen]:
    """Over all rollouts and odd states: a row for each episode that has success and a higher reward elsewhere."""
    _require_dense(checkup)
    place = checkup.places.hook(*_hooks(checkup))
    for scored in _scored(checkup):
        compared, higher = 0, list[Seen]()
        for column in range(scored.reward.shape[1]):
            reward, success = scored.reward[:, column], scored.success[:, column]
            if not success.any() or success.all():
                continue
            compared += 1
            row = int(np.argmax(np.where(success, -np.inf, reward)))
            at_success, elsewhere = float(reward[success].max()), float(reward[row])
            if elsewhere > at_success:
                where = scored.where(row, column)
                higher.append(
                    Seen(("episode", scored.of), place, numbers=(at_success, elsewhere), texts=(where,))
                )
        ends = float(scored.reward.min()), float(scored.reward.max())
        yield Seen(("all", scored.of), tried=compared, numbers=ends)
        yield from higher


def reward_order(rows: Sequence[Seen]) -> Iterator[Found | Note]:
    """By the range of all rewards of the same kind of episodes."""
    ends: dict[str, list[tuple[float, ...]]] = {}
    for row in rows:
        if row.names[0] == "all":
            ends.setdefault(row.names[1], []).append(row.numbers)
    ranges = {of: max(most for _, most in all) - min(least for least, _ in all) for of, all in ends.items()}
    compared = sum(row.tried for row in rows)
    if not compared:
        raise CannotCheck("no episode that was tried succeeds")
    lower: list[tuple[float, float, float, str]] = []
    place: Place | None = None
    for row in rows:
        if row.names[0] == "episode":
            at_success, elsewhere = row.numbers
            if elsewhere > at_success + CLEARLY_LOWER * ranges[row.names[1]]:
                lower.append((elsewhere - at_success, at_success, elsewhere, row.texts[0]))
                place = row.place
    if lower:
        _, at_success, elsewhere, where = max(lower)
        yield Found(
            f"the reward is at most {at_success:.4g} at success and {elsewhere:.4g} elsewhere in the same episode "
            f"({where}), in {of(len(lower), compared, 'episode')}. Give success the most: "
            '`reward[info["success"]] = LARGEST_REWARD`.',
            place,
            len(lower),
        )


def see_reward_needs_success(checkup: Checkup) -> Iterator[Seen]:
    """Over all rollouts and odd states, where the reward is the normalized one."""
    if checkup.task.env.reward_mode != "normalized_dense":
        raise CannotCheck("it has no normalized dense reward")
    for scored in _scored(checkup):
        most = (scored.reward >= ALL_THERE_IS) & ~scored.success
        places = [scored.where(int(row), int(column)) for row, column in np.argwhere(most)[:1]]
        yield Seen(
            place=checkup.places.hook(*_hooks(checkup)),
            count=int(most.sum()),
            size=float(scored.reward.max()),
            texts=tuple(places),
        )


def reward_needs_success(rows: Sequence[Seen]) -> Iterator[Found | Note]:
    if any(row.size > LARGEST for row in rows):
        raise CannotCheck("its normalized reward goes beyond 1")
    given, places = sum(row.count for row in rows), [text for row in rows for text in row.texts]
    if given:
        yield Found(
            f"the normalized reward is 1 without success in {given} states ({places[0]}): waiting there earns as much. "
            'Let success give the most: `reward[info["success"]] = LARGEST_REWARD`.',
            rows[0].place,
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
    of: str
    """The kind of episodes, or which odd states."""

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
        found.append(
            _Scored(rewards, success, [[f"seed {seed}{actions}" for seed in episodes.seeds]], episodes.kind)
        )
    seen = checkup.look(odd_states)
    mode = checkup.task.env.reward_mode
    for seeds in dict.fromkeys(map(tuple, seen.seeds)):
        rows = [row for row, of_row in enumerate(seen.seeds) if tuple(of_row) == seeds]
        found.append(
            _Scored(
                np.nan_to_num(np.stack([seen.reward[mode][row] for row in rows])),
                flags(np.stack([seen.evaluate[row]["success"] for row in rows])),
                [[f"{seen.kinds[row]}, seed {seed}" for seed in seeds] for row in rows],
                f"odd states from seed {seeds[0]}",
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
    "reward-finite": OverSeeds(see_reward_finite, reward_finite),
    "reward-changes": OverSeeds(see_reward_changes, reward_changes),
    "reward-normalized": OverSeeds(see_reward_normalized, reward_normalized),
    "reward-ratio": reward_ratio,
    "reward-order": OverSeeds(see_reward_order, reward_order),
    "reward-needs-success": OverSeeds(see_reward_needs_success, reward_needs_success),
}
