"""Checks of what ``evaluate`` says: success and fail, and the names of its entries."""

from __future__ import annotations

import difflib
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
from mani_skill.envs.sapien_env import BaseEnv
from numpy.typing import NDArray

from workbench.checks.evidence.checkup import Check, Checkup, Found, NotApplicable, Note, NotKnown
from workbench.checks.evidence.episode_batches import Episodes
from workbench.checks.evidence.over_seeds import OverSeeds, first_kind, together, tried
from workbench.checks.results import Seen
from workbench.envs.action_vector import hold_action
from workbench.envs.broken_rule import Place
from workbench.machine.text import listed, of

READ_BY_MANISKILL = ("success", "fail", "elapsed_steps")
FLICKER_SHARE = 0.25
"""Of the steps on which success was true for the first time and gone at the next."""


def see_success_at_reset(checkup: Checkup) -> Iterator[Seen]:
    """Over all seeds."""
    success = _flag(checkup.starts, "success")[0]
    seeds = [seed for seed, true in zip(checkup.starts.seeds, success, strict=True) if true]
    yield Seen(place=checkup.places.entry("success"), tried=len(success), seeds=tuple(seeds))


def success_at_reset(rows: Sequence[Seen]) -> Iterator[Found | Note]:
    if seeds := [seed for row in rows for seed in row.seeds]:
        yield Found(
            f"success is true right after the reset of {of(len(seeds), tried(rows), 'seed')} (seed {listed(seeds)}): "
            "the episode would end at its first step. Place the bodies away from the goal, or ask in evaluate() for "
            "more than they have at the start.",
            rows[0].place,
            len(seeds),
        )


def see_success_and_fail(checkup: Checkup) -> Iterator[Seen]:
    """Over all rollouts, up to the kind that has both; and whether there was a success and a fail at all."""
    for episodes in checkup.rollouts:
        success, fail = _flag(episodes, "success"), _flag(episodes, "fail")
        both = success & fail
        place = checkup.places.entry("success")
        seen = _seen_at(both, episodes, (episodes.kind,), place)
        yield replace(seen, numbers=(float(success.any()), float(fail.any())))
        if both.any():
            return


def success_and_fail(rows: Sequence[Seen]) -> Iterator[Found | Note]:
    for k, what in enumerate(("succeeds", "fails")):
        if not any(row.numbers[k] for row in rows):
            raise NotKnown(f"no tried episode {what}")
    if (row := first_kind(rows)) is not None:
        yield Found(
            f"success and fail are both true in {_episodes_of(row)}, {row.texts[0]}. Write `success & ~fail`.",
            row.place,
            row.count,
        )


def _seen_at(bad: NDArray[np.bool_], episodes: Episodes, names: tuple[str, ...], place: Place | None) -> Seen:
    """A row of a breach that is there at states, (T, K), of episodes."""
    seeds = tuple(episodes.seeds[i] for i in np.flatnonzero(bad.any(axis=0)))
    texts: tuple[str, ...] = ()
    if seeds:
        step, env = (int(i) for i in np.argwhere(bad)[0])
        texts = (f"first at step {step} of seed {episodes.seeds[env]}",)
    return Seen(names, place, bad.shape[1], seeds, int(bad.sum()), texts=texts)


def _episodes_of(row: Seen) -> str:
    """``3 of 32 random episodes``, of a row whose first name is their kind."""
    return of(len(row.seeds), row.tried, f"{row.names[0]} episode")


def see_success_flickers(checkup: Checkup) -> Iterator[Seen]:
    """Over all rollouts that succeed."""
    for episodes in checkup.rollouts:
        success = _flag(episodes, "success")
        begun = success[1:-1] & ~success[:-2]
        yield Seen(
            (episodes.kind,),
            checkup.places.entry("success"),
            tried=int(begun.sum()),
            count=int((begun & ~success[2:]).sum()),
            numbers=(float(success[0].any()), float(success.any())),
        )


def success_flickers(rows: Sequence[Seen]) -> Iterator[Found | Note]:
    times, gone = sum(row.tried for row in rows), sum(row.count for row in rows)
    at_reset, succeeds = (any(row.numbers[k] for row in rows) for k in (0, 1))
    which = " or ".join(dict.fromkeys(row.names[0] for row in rows))
    if not succeeds:
        raise NotKnown(f"no {which} episode succeeds")
    if not times:
        raise NotKnown(
            "where success is true, it is so from the reset on"
            if at_reset
            else "success comes at the last step only"
        )
    if gone > max(1, FLICKER_SHARE * times):
        yield Found(
            f"success is true for a single step {gone} of {times} times in {which} episodes. Ask for a state that lasts, "
            "such as `is_robot_static` or a count of steps, or an easier threshold.",
            rows[0].place,
            gone,
        )


def see_success_stays_possible(checkup: Checkup) -> Iterator[Seen]:
    """Whether there is an entry at all, and in how many rollouts it is reached."""
    entries = checkup.starts.evaluate
    own = checkup.loaded.cls.compute_sparse_reward is not BaseEnv.compute_sparse_reward
    sparse = checkup.task.env.reward_mode == "sparse" and not own
    if sparse and any(known != "elapsed_steps" for _, known in _misspelt(entries)):
        raise NotKnown("an entry has nearly the name that ManiSkill reads, see entry-name")
    if "success" not in entries and "fail" not in entries:
        # As ManiSkill's tasks of walking, balancing and drawing.
        yield Seen(place=checkup.places.hook("evaluate"), count=int(sparse))
    elif "success" in entries:
        for episodes in checkup.rollouts:
            reached = int(_flag(episodes, "success").any(axis=0).sum())
            yield Seen((episodes.kind,), tried=len(episodes.seeds), count=reached)


def success_stays_possible(rows: Sequence[Seen]) -> Iterator[Found | Note]:
    for row in rows[:1]:
        if not row.names and not row.count:
            raise NotApplicable(
                "its reward is not the sparse one of ManiSkill, and evaluate() has neither success nor fail: no success rate "
                "can be counted"
            )
        elif not row.names:
            yield Found(
                "evaluate() returns neither success nor fail, from which the sparse reward is made: it is always 0. Return "
                "{'success': ...} as a bool tensor with a row for each env.",
                row.place,
            )
    for row in together(rows):
        if row.tried:
            yield Note(f"success in {of(row.count, row.tried, f'{row.names[0]} episode')}")


def entry_name(checkup: Checkup) -> Iterator[Found | Note]:
    """Entries one or two letters away from one that ManiSkill reads."""
    for name, known in _misspelt(checkup.starts.evaluate):
        yield Found(
            f"evaluate() returns {name!r}, and ManiSkill reads {known!r}. Rename the entry.",
            checkup.places.entry(name),
        )


def _misspelt(entries: Collection[str]) -> Iterator[tuple[str, str]]:
    """Names of entries that are nearly one that ManiSkill reads and that is missing, and that one."""
    for name in entries:
        for known in READ_BY_MANISKILL:
            close = difflib.SequenceMatcher(None, name.lower(), known).ratio() >= 0.8
            if known not in entries and close and "/" not in name:
                yield name, known


def info_rows(checkup: Checkup) -> Iterator[Found | Note]:
    """After a reset and after a step."""
    task, found = checkup.task, False
    others = checkup.reset(task, checkup.seeds[0]).others
    others = {**others, **checkup.step(task, hold_action(task.parts, task.num_envs)).others}
    for name, entry in others.items():
        if not entry.per_env:
            found = True
            yield Found(
                f"the entry {name!r} of evaluate() is a {entry.what} for all {task.num_envs} envs together. Give it a row "
                "for each env, or leave it out: what only people read can be logged elsewhere.",
                checkup.places.entry(name.rpartition("/")[2]),
            )
    if not found:
        checkup.require_several()


def see_entries_finite(checkup: Checkup) -> Iterator[Seen]:
    """Over all rollouts."""
    told: set[str] = set()
    for episodes in checkup.rollouts:
        numbers = float(sum(rows.dtype.kind == "f" for rows in episodes.evaluate.values()))
        yield Seen((episodes.kind,), tried=len(episodes.seeds), numbers=(numbers,) if numbers else ())
        for name, rows in episodes.evaluate.items():
            if rows.dtype.kind != "f" or name in told:
                continue
            bad = np.logical_or.reduce(~np.isfinite(rows.reshape(*rows.shape[:2], -1)), axis=2)
            if bad.any():
                told.add(name)
                place = checkup.places.entry(name.rpartition("/")[2])
                yield _seen_at(bad, episodes, (episodes.kind, name), place)


def entries_finite(rows: Sequence[Seen]) -> Iterator[Found | Note]:
    told: set[str] = set()
    if not any(row.numbers for row in rows):
        raise NotApplicable("evaluate() returns no numbers")
    for row in together(row for row in rows if len(row.names) == 2):
        kind, name = row.names
        if name in told:
            continue
        told.add(name)
        count = of(len(row.seeds), tried(rows, kind), f"{kind} episode")
        yield Found(
            f"{name!r} is not finite in {count}, {row.texts[0]}. Look for a division "
            "or a square root of what can be 0, and clamp it; for what is not known, return 0 and a bool beside it.",
            row.place,
            row.count,
        )


def _flag(episodes: Episodes, name: str) -> NDArray[np.bool_]:
    """(T + 1, K)"""
    rows = episodes.evaluate.get(name)
    if rows is None:
        raise NotApplicable(f"evaluate() has no entry {name}")
    return flags(rows)


def flags(rows: NDArray) -> NDArray[np.bool_]:
    """(T, K) of (T, K, ...)."""
    return np.logical_or.reduce(rows.reshape(*rows.shape[:2], -1).astype(bool), axis=2)


CHECKS: Mapping[str, Check] = {
    "success-at-reset": OverSeeds(see_success_at_reset, success_at_reset),
    "success-stays-possible": OverSeeds(see_success_stays_possible, success_stays_possible),
    "entry-name": entry_name,
    "info-rows": info_rows,
    "success-and-fail": OverSeeds(see_success_and_fail, success_and_fail),
    "success-flickers": OverSeeds(see_success_flickers, success_flickers),
    "entries-finite": OverSeeds(see_entries_finite, entries_finite),
}
