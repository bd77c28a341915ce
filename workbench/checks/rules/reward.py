"""Checks of the reward."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from mani_skill.envs.sapien_env import BaseEnv
from numpy.typing import NDArray

from workbench.checks.evidence.collect import Checkup, Found, NotApplicable, Note, NotKnown
from workbench.checks.evidence.odd_states import DENSE_HOOKS, SHORT, OddStates, odd_states
from workbench.checks.evidence.over_seeds import first_kind, tried
from workbench.checks.evidence.rolled_episodes import Episodes
from workbench.checks.register_rule import outlier_check, rule
from workbench.checks.results import Seen
from workbench.checks.rules.evaluate import flags
from workbench.envs.broken_rule import Place
from workbench.envs.outliers import REWARD_RANGES, ROUNDING
from workbench.machine.text import of

REWARD_HOOKS = {**DENSE_HOOKS, "sparse": "compute_sparse_reward"}
"""Hook of each reward mode."""
MAX_NORMALIZED = 1.0 + 1e-4
"""Maximum of a normalized reward, with room for rounding."""
FULL_REWARD = 0.999
"""Minimum normalized reward that counts as the largest."""
RATIO_TOLERANCE = 1e-3
"""Maximum difference between the normalized reward and a constant times the dense reward, as a share of the
largest normalized reward."""
RATIO_SHARE = 0.05
"""Minimum size of a dense reward from which the ratio is computed, as a share of the largest one: near 0,
rounding decides the ratio."""
CLEARLY_LOWER_SHARE = 0.05
"""Minimum difference of rewards that counts, as a share of the range of all rewards."""


def see_reward_finite(checkup: Checkup) -> Iterator[Seen]:
    """A row for each kind of rollouts up to the first breach; without a breach, also a row for the odd
    states."""
    _require_reward(checkup)
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


@outlier_check("reward-finite", see=see_reward_finite)
def reward_finite(rows: Sequence[Seen]) -> Iterator[Found | Note]:
    if (row := first_kind(sorted(rows, key=lambda row: len(row.names)))) is None:
        return
    if len(row.names) == 1:
        where = of(len(row.seeds), row.tried, f"{row.names[0]} episode")
    else:
        where = f"{of(row.count, row.tried, 'state')} in which joints and bodies were put"
    yield Found(
        f"The reward is {row.texts[0]} in {where}, {row.texts[1]}. Look for a division, a square root or a logarithm of "
        "what can be 0; clamp it, or use torch.linalg.norm(..., dim=1).",
        row.place,
        row.count,
    )


def see_reward_changes(checkup: Checkup) -> Iterator[Seen]:
    """One row: the largest and the smallest reward of random rollouts."""
    _require_dense(checkup)
    reward = _rewards(checkup, checkup.random)
    known = np.nan_to_num(reward)
    yield Seen(
        place=checkup.places.hook(*_hooks(checkup)),
        tried=reward.size,
        numbers=(float(known.max()), float(known.min())),
        texts=(f"{reward.flat[0]:.4g}",),
    )


@rule("reward-changes", "warn", "compute_dense_reward", see=see_reward_changes)
def reward_changes(rows: Sequence[Seen]) -> Iterator[Found | Note]:
    """A dense reward changes while the robot moves.

    The policy has nothing to learn from.

    ## Why
    A reward that is the same everywhere gives no direction: the policy stays random.

    ## Fix
    Let the reward depend on a distance that the robot changes.

    ```python fragment
    distance = torch.linalg.norm(self.cube.pose.p - self.agent.tcp.pose.p, dim=1)
    return 1 - torch.tanh(5 * distance)
    ```

    ## How it is checked
    The rule reads the dense reward in random rollouts of all seeds (up to 50 steps), and reports it if it is
    one number throughout. The result is *not applicable* for sparse rewards. The rule does not see a reward
    that changes but leads nowhere.
    """
    most, least = max(row.numbers[0] for row in rows), min(row.numbers[1] for row in rows)
    if most - least < 1e-7:
        yield Found(
            f"The reward is {rows[0].texts[0]} at each of {tried(rows)} steps of random episodes. Let it depend on a "
            "distance that the robot changes.",
            rows[0].place,
        )


def see_reward_normalized(checkup: Checkup) -> Iterator[Seen]:
    """A row for each kind of rollouts up to the first breach; without a breach, also a row for the odd states
    with success. For a normalized or sparse reward only."""
    mode = checkup.task.env.reward_mode
    if mode not in REWARD_RANGES:
        raise NotApplicable("the reward is neither normalized nor sparse")
    least, most = REWARD_RANGES[mode]
    sparse = mode == "sparse"
    hooks = [REWARD_HOOKS[mode]] if sparse else ["compute_normalized_dense_reward", "compute_dense_reward"]

    def of(name: str, where: str, rewards: NDArray, successes: int) -> Seen:
        known = rewards[~np.isnan(rewards)]
        outside = (known < least - ROUNDING) | (known > most + ROUNDING)
        return Seen(
            (name,),
            checkup.places.hook(*hooks),
            tried=successes,
            count=int(outside.sum()),
            numbers=(float(known.min()), float(known.max())) if known.size else (),
            texts=("sparse" if sparse else "normalized", where),
        )

    for episodes in checkup.rollouts:
        success = episodes.evaluate.get("success")
        reached = 0 if success is None else int(flags(success).any(axis=0).sum())
        row = of(episodes.kind, f"in {episodes.kind} episodes", _rewards(checkup, episodes), reached)
        yield row
        if row.count:
            return
    if sparse and checkup.loaded.cls.compute_sparse_reward is BaseEnv.compute_sparse_reward:
        yield Seen(("ManiSkill's own",), tried=1)
        return
    if "success" not in checkup.starts.evaluate:
        yield Seen(("no success",))
        return
    seen = checkup.look(odd_states)
    success = flags(np.stack([entries["success"] for entries in seen.evaluate]))
    paid = np.stack(seen.reward[mode])[success]
    if (constant := paid_at_success(seen, mode)) is not None:
        paid = np.append(paid, constant)
    yield of("success", "in states with success", paid, len(paid))


@outlier_check("reward-normalized", see=see_reward_normalized)
def reward_normalized(rows: Sequence[Seen]) -> Iterator[Found | Note]:
    if (row := first_kind(rows)) is not None:
        ranges = [one.numbers for one in rows if one.names == row.names and one.numbers]
        low, high = min(low for low, _ in ranges), max(high for _, high in ranges)
        yield Found(
            f"The {row.texts[0]} reward goes from {low:.3g} to {high:.3g} {row.texts[1]}. "
            + (
                "Return 1 at success, -1 at fail and 0 elsewhere."
                if row.texts[0] == "sparse"
                else "Divide the dense reward by the largest that an episode can reach in one step."
            ),
            row.place,
            row.count,
        )
    elif any(row.names == ("no success",) for row in rows):
        raise NotKnown("evaluate() has no success, so it is not known in which states the reward is largest")
    elif not any(row.tried for row in rows):
        raise NotKnown("no tried episode succeeds, and the reward is largest at success")


def paid_at_success(seen: OddStates, mode: str) -> float | None:
    """The reward with ``info["success"]`` set to true, if it is the same number in all states; else None."""
    paid = np.concatenate([*seen.reward_if_success.get(mode, ()), np.zeros(0)])
    if not len(paid) or not np.isfinite(paid).all() or np.ptp(paid) > ROUNDING:
        return None
    return float(paid[0])


@rule("reward-ratio", "warn", "compute_normalized_dense_reward")
def reward_ratio(checkup: Checkup) -> Iterator[Found | Note]:
    """The normalized dense reward is the dense reward divided by a constant.

    The two modes train different tasks.

    ## Why
    People choose between the two modes for the scale, not for the task. If one is not the other divided by a
    constant, results with one say little about the other.

    ## Fix
    Compute the normalized reward from the dense reward.

    ```python fragment
    def compute_normalized_dense_reward(self, obs, action, info):
        return self.compute_dense_reward(obs, action, info) / 3
    ```

    ## How it is checked
    The rule calls both hooks on the same states, those that `reward-finite` makes, with the same action, and
    again with `info["success"]` true in all envs. It restores the task's memory between the calls. If the
    normalized reward rises in a straight line with the dense one but with an offset, the rule only notes it.
    The result is *not applicable* without both rewards.
    """
    seen = checkup.look(odd_states)
    if not DENSE_HOOKS.keys() <= seen.reward.keys():
        raise NotApplicable("the task lacks a dense or a normalized dense reward")
    dense, normalized = (
        np.concatenate([*seen.reward[mode], *seen.reward_if_success.get(mode, ())]) for mode in DENSE_HOOKS
    )
    finite = np.isfinite(dense) & np.isfinite(normalized)
    size = float(np.abs(dense[finite]).max(initial=0))
    telling = finite & (np.abs(dense) > RATIO_SHARE * size)
    if not telling.any():
        raise NotKnown("the dense reward is 0 or not finite in all states that were tried")
    constant = float(np.median(normalized[telling] / dense[telling]))
    wrong = np.abs(normalized - constant * dense)
    off = finite & (wrong > RATIO_TOLERANCE * np.abs(normalized[finite]).max())
    if off.any() and (line := _straight_line(dense[finite], normalized[finite])) is not None:
        yield Note(f"the normalized reward is the dense one times {line[0]:.4g} plus {line[1]:.4g}")
    elif off.any():
        first, worst = int(np.flatnonzero(telling)[0]), int(np.argmax(np.where(off, wrong, 0)))
        yield Found(
            f"The normalized reward is {normalized[worst]:.4g} where the dense reward is {dense[worst]:.4g}, and "
            f"{normalized[first]:.4g} where it is {dense[first]:.4g}: no single constant is their ratio. Write "
            "`return self.compute_dense_reward(obs, action, info) / LARGEST_REWARD`.",
            checkup.places.hook("compute_normalized_dense_reward", "compute_dense_reward"),
            int(off.sum()),
        )


def _straight_line(dense: NDArray, normalized: NDArray) -> tuple[float, float] | None:
    """Slope and offset of the normalized reward as a linear function of the dense reward; None if the
    normalized reward is not linear, or does not rise."""
    if np.ptp(dense) == 0:
        return None
    slope, offset = (float(number) for number in np.polyfit(dense, normalized, 1))
    wrong = np.abs(slope * dense + offset - normalized).max()
    return (slope, offset) if slope > 0 and wrong <= RATIO_TOLERANCE * np.abs(normalized).max() else None


def see_reward_order(checkup: Checkup) -> Iterator[Seen]:
    """For each kind of rollouts and each batch of odd states: a row with the number of compared episodes and
    the range of the rewards, and a row for each episode whose reward is higher elsewhere than at success. One
    more row about `paid_at_success`, unless that is None."""
    _require_dense(checkup)
    place = checkup.places.hook(*_hooks(checkup))
    every = _scored(checkup)
    for scored in every:
        compared, higher = 0, list[Seen]()
        for column in range(scored.reward.shape[1]):
            if not scored.tried(column):
                continue
            reward, success = scored.reward[:, column], scored.success[:, column]
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
    paid = paid_at_success(checkup.look(odd_states), checkup.task.env.reward_mode)
    if paid is not None:
        most = [np.where(scored.success, -np.inf, scored.reward) for scored in every]
        best = int(np.argmax([each.max() for each in most]))
        row, column = (int(i) for i in np.unravel_index(int(np.argmax(most[best])), most[best].shape))
        where, ends = (
            every[best].where(row, column),
            [float(f(s.reward)) for s in every for f in (np.min, np.max)],
        )
        numbers = paid, float(most[best].max()), min(ends), max(ends)
        yield Seen(("paid",), place, numbers=numbers, texts=(where,))


@rule("reward-order", "warn", "compute_dense_reward", see=see_reward_order)
def reward_order(rows: Sequence[Seen]) -> Iterator[Found | Note]:
    """The dense reward at success is not lower than elsewhere in the same episode.

    Policies learn to avoid success.

    ## Why
    If the way to success earns more than success, a policy that maximises the reward stops just before it.
    The reward curve rises and the success rate does not.

    ## Fix
    Give success the most, after all other terms.

    ```python fragment
    reward = reach + place
    reward[info["success"]] = 3  # more than reach + place can be
    ```

    ## How it is checked
    For each episode that has states with and without success, the rule compares the largest reward with
    success and the largest without it: in random rollouts, in those of `--actions`, and in the states that
    `reward-finite` makes. A body at the goal is often a success; from there the rule moves all bodies and
    joints back towards the reset until success ends, so that states close to success are compared too. A
    difference below 5% of the rewards' range does not count.

    The rule also calls the reward hook once more for each of these states, with `info["success"]` true in all
    envs. If the reward is then one number, as after `reward[info["success"]] = 0.5`, that number is what
    success pays, and no state without success may earn more. This finds the mistake even if no episode
    succeeds.

    If no episode can be compared and the second call finds no mistake, the result is *not known*.
    """
    ends: dict[str, list[tuple[float, ...]]] = {}
    for row in rows:
        if row.names[0] == "all":
            ends.setdefault(row.names[1], []).append(row.numbers)
    ranges = {of: max(most for _, most in all) - min(least for least, _ in all) for of, all in ends.items()}
    compared = sum(row.tried for row in rows)
    lower: list[tuple[float, float, float, str]] = []
    place: Place | None = None
    for row in rows:
        if row.names[0] == "episode":
            at_success, elsewhere = row.numbers
            if elsewhere > at_success + CLEARLY_LOWER_SHARE * ranges[row.names[1]]:
                lower.append((elsewhere - at_success, at_success, elsewhere, row.texts[0]))
                place = row.place
    advice = 'Give success the most: `reward[info["success"]] = LARGEST_REWARD`.'
    if lower:
        _, at_success, elsewhere, where = max(lower)
        yield Found(
            f"The reward is at most {at_success:.4g} at success and {elsewhere:.4g} elsewhere in the same episode "
            f"({where}), in {of(len(lower), compared, 'episode')}. {advice}",
            place,
            len(lower),
        )
        return
    for row in rows:
        if row.names == ("paid",):
            paid, elsewhere, least, most = row.numbers
            if elsewhere > paid + CLEARLY_LOWER_SHARE * (most - least):
                yield Found(
                    f'The reward is {paid:.4g} wherever info["success"] is true, and {elsewhere:.4g} without success '
                    f"({row.texts[0]}). {advice}",
                    row.place,
                )
                return
    if not compared:
        raise NotKnown("no tried episode succeeds")


def see_reward_needs_success(checkup: Checkup) -> Iterator[Seen]:
    """A row for each kind of rollouts and each batch of odd states. For a normalized reward only."""
    if checkup.task.env.reward_mode != "normalized_dense":
        raise NotApplicable("the reward is not the normalized dense one")
    for scored in _scored(checkup):
        most = (scored.reward >= FULL_REWARD) & ~scored.success
        tried = sum(scored.tried(column) for column in range(scored.reward.shape[1]))
        places = [scored.where(int(row), int(column)) for row, column in np.argwhere(most)[:1]]
        yield Seen(
            place=checkup.places.hook(*_hooks(checkup)),
            tried=tried,
            count=int(most.sum()),
            size=float(scored.reward.max()),
            texts=tuple(places),
        )


@rule("reward-needs-success", "warn", "compute_dense_reward", see=see_reward_needs_success)
def reward_needs_success(rows: Sequence[Seen]) -> Iterator[Found | Note]:
    """Only success earns the largest normalized reward.

    Policies learn to wait where they earn as much as at success.

    ## Why
    If a state without success earns the largest reward, waiting there earns as much as success, and more if
    success ends the episode.

    ## Fix
    Leave the largest reward to success.

    ```python fragment
    reward = reach + place  # at most 2
    reward[info["success"]] = 3
    return reward / 3
    ```

    ## How it is checked
    The rule reports a normalized reward of 0.999 or more in a state without success, in random rollouts, in
    those of `--actions`, and in the states that `reward-finite` makes. The result is *not applicable* without
    a normalized reward or an entry `success`. It is *not known* if the reward goes beyond 1, or if no episode
    or state that was tried succeeds, since the rule then did not see what is paid near success.
    """
    if any(row.size > MAX_NORMALIZED for row in rows):
        raise NotKnown("the normalized reward goes beyond 1")
    given, places = sum(row.count for row in rows), [text for row in rows for text in row.texts]
    if given:
        yield Found(
            f"The normalized reward is 1 without success in {given} states ({places[0]}): staying there earns as much as success. "
            'Let success give the most: `reward[info["success"]] = LARGEST_REWARD`.',
            rows[0].place,
            given,
        )
    elif not any(row.tried for row in rows):
        raise NotKnown("no tried episode succeeds")


# --- rewards and success of many states --------------------------------------------------------------------


@dataclass(frozen=True)
class _Scored:
    """Rewards and success of T states of K episodes."""

    reward: NDArray
    """(T, K)"""
    success: NDArray[np.bool_]
    """(T, K)"""
    places: list[list[str]]
    """(1, K) or (T, K) description of each state, for a sentence."""
    of: str
    """Kind of the episodes, or text such as ``odd states from seed 0``."""
    short: NDArray[np.bool_] | None = None
    """(T,) whether each odd state was made between the reset and a success (`SHORT`); None for rollouts."""

    def tried(self, column: int) -> bool:
        """Whether an episode has states with success and, near them, states without success."""
        success = self.success[:, column]
        near = success if self.short is None else success[self.short]
        return bool(success.any()) and not bool(near.all())

    def where(self, row: int, column: int) -> str:
        if len(self.places) == 1:
            return f"step {row + 1} of {self.places[0][column]}"
        return self.places[row][column]


def _scored(checkup: Checkup) -> list[_Scored]:
    """Rewards and success of all rollouts, then of the odd states of each batch."""
    found: list[_Scored] = []
    for episodes in checkup.rollouts:
        rewards = np.nan_to_num(_rewards(checkup, episodes))
        if "success" not in episodes.evaluate:
            raise NotApplicable("evaluate() has no entry success")
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
                np.array([seen.kinds[row] == SHORT for row in rows]),
            )
        )
    return found


def _rewards(checkup: Checkup, episodes: Episodes) -> NDArray:
    """(T, K). Raises NotApplicable without a reward, and NotKnown without a step."""
    _require_reward(checkup)
    if not episodes.reward.size:
        raise NotKnown("no step was made")
    return episodes.reward


def _require_reward(checkup: Checkup) -> None:
    if checkup.task.env.reward_mode == "none":
        raise NotApplicable("the task has no reward")


def _require_dense(checkup: Checkup) -> None:
    _require_reward(checkup)
    if "dense" not in checkup.task.env.reward_mode:
        raise NotApplicable(f"the reward is {checkup.task.env.reward_mode}")


def _hooks(checkup: Checkup) -> tuple[str, ...]:
    """The hooks that make the present reward, in the order in which a person would look for them."""
    mode = checkup.task.env.reward_mode
    return ("compute_dense_reward", REWARD_HOOKS[mode]) if "dense" in mode else (REWARD_HOOKS[mode],)
