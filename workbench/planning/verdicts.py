"""Judges a reward by planned episodes: each verdict follows from numbers and names the seeds that show it.

Imports no torch."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from workbench.planning.planned_episodes import PlannedEpisode

_EQUAL_FRACTION = 0.002
"""Rewards count as equal if they differ by less than this fraction of the range of all rewards seen."""
_MIN_FALL_FRACTION = 0.25
"""Minimum fall of the reward that counts, as a fraction of the rise from the first reward to the reward at success."""
MIN_EPISODES = 3
"""Minimum number of episodes among which a majority counts as evidence."""
MIN_SEEDS = 8
"""Minimum number of seeds for which a report without verdicts is evidence of a good reward: a reward that
pays without success shows only if some seeds are solved and others are not."""
_LAST_STEPS = 10
"""Number of steps at the end of an episode that the verdicts look at; at most half of the episode's steps."""


@dataclass(frozen=True)
class RewardVerdict:
    """A rule of the reward that some episodes break."""

    rule: str
    """Id of the rule in the table of rules."""
    message: str
    seeds: tuple[int, ...]
    """Seeds of the episodes that break the rule."""


@dataclass(frozen=True)
class PlannedEpisodes:
    """The planned episodes of a task, with values derived for comparisons."""

    all: tuple[PlannedEpisode, ...]

    @property
    def solved(self) -> list[PlannedEpisode]:
        return [one for one in self.all if one.solved_at]

    @property
    def unsolved(self) -> list[PlannedEpisode]:
        return [one for one in self.all if not one.solved_at and one.steps]

    @property
    def at_success(self) -> float | None:
        """Median reward of the steps at which the episodes succeed; None if none succeeds."""
        rewards = [one.reward[one.solved_at - 1] for one in self.solved]
        return float(np.median(rewards)) if rewards else None

    @property
    def same(self) -> float:
        """Difference below which two rewards of a control step count as equal."""
        seen = [one.reward[np.isfinite(one.reward)] for one in self.all]
        rewards = np.concatenate([*seen, np.zeros(0, np.float32)])
        return _EQUAL_FRACTION * float(np.ptp(rewards)) if len(rewards) else 0.0

    @property
    def without_reward(self) -> bool:
        """Whether no rollout earned more than another before a success: the reward is sparse or constant."""
        with np.errstate(invalid="ignore"):  # infinite rewards
            flat = [(one.best - one.worst)[: (one.solved_at or one.steps + 1) - 1] for one in self.all]
        return bool(self.all) and all(not len(each) or float(each.max()) == 0 for each in flat)


def of_episodes(episodes: Sequence[PlannedEpisode]) -> list[RewardVerdict]:
    """The verdicts on a task's reward, at most one for each rule."""
    every = PlannedEpisodes(tuple(episodes))
    return [verdict for find in VERDICTS.values() if (verdict := find(every)) is not None]


def in_the_way(episode: PlannedEpisode, episodes: Sequence[PlannedEpisode]) -> str:
    """Why an episode was not solved, in a few words; empty if it was solved."""
    if episode.solved_at:
        return ""
    if episode.failed_at:
        return f"failed at step {episode.failed_at}"
    if episode.cut_off:
        steps = f"{episode.steps} step{'' if episode.steps == 1 else 's'}"
        return f"wall time limit reached after {steps} (--seconds-per-seed)"
    every = PlannedEpisodes(tuple(episodes))
    if every.without_reward:
        return "no rollout earned more than another"
    if _earns_like_success(every, episode):
        return f"earned {_end(episode).mean():.3f} a step without success"
    if _is_flat(every, episode):
        return f"all rollouts earned the same from step {_since(_spread_a_step(episode), every.same)} on"
    if _is_stuck(every, episode):
        return f"no rollout earned more than the episode already did from step {_since(_gain_a_step(episode), every.same)} on"
    return "not solved within the step limit"


# --- one function each -----------------------------------------------------------------------------------


def exploited(episodes: PlannedEpisodes) -> RewardVerdict | None:
    """Unsolved episodes that earn, in their last steps, at least as much per step as solved episodes earn at
    success."""
    found = [one for one in episodes.unsolved if _earns_like_success(episodes, one)]
    if not found:
        return None
    entries = ", ".join(f"{name} {value:.4g}" for name, value in found[0].evaluate.items())
    at_end = f"; at the end of seed {found[0].seed}, evaluate() returned {entries}" if entries else ""
    rate = float(np.median([_end(one).mean() for one in found]))
    return RewardVerdict(
        "reward-exploited",
        f"{len(found)} of {len(episodes.all)} episodes ended without success and earned {rate:.3f} a step at their end; "
        f"successful ones earned {episodes.at_success:.3f} at success{at_end}",
        _seeds(found),
    )


def flat(episodes: PlannedEpisodes) -> RewardVerdict | None:
    """Unsolved episodes at whose end all rollouts earned the same, so that the reward gives no direction."""
    if episodes.without_reward and episodes.unsolved:
        return RewardVerdict(
            "reward-flat",
            "no rollout earned more than another before success: with a sparse reward planning succeeds only by chance. "
            "Give the task a dense reward, or record demonstrations in another way (workbench record --actions FILE)",
            _seeds(episodes.unsolved),
        )
    found = [one for one in episodes.unsolved if not _ended_early(one) and _is_flat(episodes, one)]
    if not found:
        return None
    first = found[0]
    since = _since(_spread_a_step(first), episodes.same)
    still = [
        name
        for name, spread in first.terms.items()
        if not (_end(first, spread) > _least(episodes, first)).any()
    ]
    named = f"; flat terms: {', '.join(still)}" if still else ""
    return RewardVerdict(
        "reward-flat",
        f"at the end of {len(found)} of {len(episodes.all)} episodes all rollouts earned the same, whatever they did: seed "
        f"{first.seed} from step {since} on, at {first.reward[-1]:.3f} a step{named}",
        _seeds(found),
    )


def stuck(episodes: PlannedEpisodes) -> RewardVerdict | None:
    """Unsolved episodes at whose end no rollout earned more per step than the better of two: the rollout that
    holds still, and the step before."""
    found = [
        one
        for one in episodes.unsolved
        if not _ended_early(one)
        and "success" in one.evaluate  # in a task without success, the best episode stays where it is
        and not _earns_like_success(episodes, one)
        and not _is_flat(episodes, one)
        and _is_stuck(episodes, one)
    ]
    if not found:
        return None
    first = found[0]
    since = _since(_gain_a_step(first), episodes.same)
    return RewardVerdict(
        "reward-stuck",
        f"at the end of {len(found)} of {len(episodes.all)} episodes no rollout of {first.horizon} steps earned more than the "
        f"episode already did: seed {first.seed} from step {since} on, at {first.reward[-1]:.3f} a step. Progress costs reward "
        "first, or is beyond the horizon of a plan (--horizon)",
        _seeds(found),
    )


def against(episodes: PlannedEpisodes) -> RewardVerdict | None:
    """Solved episodes in which the reward fell before success."""
    falls = [(one, *_largest_fall(one.reward[: one.solved_at])) for one in episodes.solved]
    found = [
        (one, high, low)
        for one, high, low in falls
        if one.reward[high] - one.reward[low]
        > max(_MIN_FALL_FRACTION * abs(one.reward[one.solved_at - 1] - one.reward[0]), episodes.same)
    ]
    if not _are_most([each for each, *_ in found], episodes.solved):
        return None
    one, high, low = found[0]
    return RewardVerdict(
        "reward-against",
        f"on the way to success the reward falls, in {len(found)} of {len(episodes.solved)} solved episodes: seed {one.seed} "
        f"from {one.reward[high]:.3f} at step {high + 1} to {one.reward[low]:.3f} at step {low + 1}, success at step "
        f"{one.solved_at}",
        _seeds([each for each, *_ in found]),
    )


def lost(episodes: PlannedEpisodes) -> RewardVerdict | None:
    """Solved episodes that lost success a few steps later, while the planner kept maximizing the reward."""
    found = [one for one in episodes.solved if not one.success[one.solved_at - 1 :].all()]
    if not _are_most(found, episodes.solved):
        return None
    first = found[0]
    again = int(first.success[first.solved_at - 1 :].argmin())
    return RewardVerdict(
        "success-lost",
        f"success is lost in {len(found)} of {len(episodes.solved)} solved episodes: seed {first.seed} succeeded at step "
        f"{first.solved_at} and lost success {again} {'step' if again == 1 else 'steps'} later, while maximizing the reward",
        _seeds(found),
    )


def failing_pays(episodes: PlannedEpisodes) -> RewardVerdict | None:
    """Episodes that failed while rewards are negative, so that an early end earns more than continuing."""
    found = [one for one in episodes.unsolved if one.failed_at and float(one.reward.mean()) < 0]
    if not _are_most(found, episodes.all):
        return None
    first = found[0]
    return RewardVerdict(
        "failing-pays",
        f"{len(found)} of {len(episodes.all)} episodes end by failing, and rewards are below 0: seed {first.seed} failed at "
        f"step {first.failed_at}, with {first.reward.mean():.3f} a step until then. Steps after a fail earn nothing, so the "
        "earliest fail earns most",
        _seeds(found),
    )


VERDICTS: dict[str, Callable[[PlannedEpisodes], RewardVerdict | None]] = {
    "reward-exploited": exploited,
    "reward-flat": flat,
    "reward-stuck": stuck,
    "reward-against": against,
    "success-lost": lost,
    "failing-pays": failing_pays,
}
"""Check of each rule by its id, in the order of the report."""


# --- numbers of an episode -------------------------------------------------------------------------------


def _end(episode: PlannedEpisode, row: NDArray[Any] | None = None) -> NDArray[Any]:
    """The values of `row` (T,) at the last steps of the episode; without a row, the rewards."""
    row = episode.reward if row is None else row
    return row[-max(1, min(_LAST_STEPS, episode.steps // 2)) :]


def _are_most(found: Sequence[PlannedEpisode], among: Sequence[PlannedEpisode]) -> bool:
    return len(among) >= MIN_EPISODES and 2 * len(found) > len(among)


def _ended_early(episode: PlannedEpisode) -> bool:
    return episode.failed_at > 0 or episode.cut_off


def _earns_like_success(episodes: PlannedEpisodes, episode: PlannedEpisode) -> bool:
    paid = episodes.at_success
    return paid is not None and not _ended_early(episode) and float(_end(episode).mean()) >= paid


def _spread_a_step(episode: PlannedEpisode) -> NDArray[Any]:
    with np.errstate(invalid="ignore"):  # infinite rewards
        return (episode.best - episode.worst) / episode.horizon


def _gain_a_step(episode: PlannedEpisode) -> NDArray[Any]:
    """(T,) reward per step of the best rollout, minus the better of two: the reward per step of holding
    still, and the reward of the step before. Holding still may earn less than the step before, since an
    object may slip."""
    before = np.concatenate([[-np.inf], episode.reward[:-1]])
    return episode.best / episode.horizon - np.maximum(episode.hold / episode.horizon, before)


def _least(episodes: PlannedEpisodes, episode: PlannedEpisode) -> float:
    return episodes.same * episode.horizon


def _is_flat(episodes: PlannedEpisodes, episode: PlannedEpisode) -> bool:
    return bool((_end(episode, _spread_a_step(episode)) <= episodes.same).all())


def _is_stuck(episodes: PlannedEpisodes, episode: PlannedEpisode) -> bool:
    return bool((_end(episode, _gain_a_step(episode)) <= episodes.same).all())


def _since(row: NDArray[Any], most: float) -> int:
    """The first step, counted from 1, from which on a row stays at or below `most`."""
    above = np.flatnonzero(row > most)
    return int(above[-1]) + 2 if len(above) else 1


def _largest_fall(row: NDArray[np.float32]) -> tuple[int, int]:
    """Indices (high, low) between which a row falls most, with high before low."""
    highest = np.maximum.accumulate(row)
    low = int((highest - row).argmax())
    return int(row[: low + 1].argmax()), low


def _seeds(episodes: Sequence[PlannedEpisode]) -> tuple[int, ...]:
    return tuple(episode.seed for episode in episodes)
