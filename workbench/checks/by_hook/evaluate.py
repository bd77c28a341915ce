"""Checks of what ``evaluate`` says: success and fail, and the names of its entries."""

from __future__ import annotations

import difflib
from collections.abc import Collection, Iterator, Mapping

import numpy as np
from mani_skill.envs.sapien_env import BaseEnv
from numpy.typing import NDArray

from workbench.checks.evidence.checkup import CannotCheck, Check, Checkup, Found, Note
from workbench.checks.evidence.episodes import Episodes
from workbench.core.env.actions import hold_action
from workbench.machine.text import listed, of

READ_BY_MANISKILL = ("success", "fail", "elapsed_steps")
FLICKER_SHARE = 0.25
"""Of the steps on which success was true for the first time and gone at the next."""


def success_at_reset(checkup: Checkup) -> Iterator[Found | Note]:
    """Over all seeds."""
    success = _flag(checkup.starts, "success")[0]
    if success.any():
        seeds = [seed for seed, true in zip(checkup.starts.seeds, success, strict=True) if true]
        yield Found(
            f"success is true right after the reset of {of(len(seeds), len(success), 'seed')} (seed {listed(seeds)}): "
            "the episode would end at its first step. Place the bodies away from the goal, or ask in evaluate() for "
            "more than they have at the start.",
            checkup.places.entry("success"),
            len(seeds),
        )


def success_and_fail(checkup: Checkup) -> Iterator[Found | Note]:
    """Over all rollouts."""
    for episodes in checkup.rollouts:
        both = _flag(episodes, "success") & _flag(episodes, "fail")
        if both.any():
            step, env = (int(i) for i in np.argwhere(both)[0])
            count = of(int(both.any(axis=0).sum()), both.shape[1], f"{episodes.kind} episode")
            yield Found(
                f"success and fail are both true in {count}, first at step {step} of seed {episodes.seeds[env]}. Write "
                "`success & ~fail`.",
                checkup.places.entry("success"),
                int(both.sum()),
            )
            return


def success_flickers(checkup: Checkup) -> Iterator[Found | Note]:
    """Over all rollouts that succeed."""
    times = gone = 0
    at_reset = succeeds = False
    kinds: list[str] = []
    for episodes in checkup.rollouts:
        success = _flag(episodes, "success")
        begun = success[1:-1] & ~success[:-2]
        times, gone = times + int(begun.sum()), gone + int((begun & ~success[2:]).sum())
        at_reset, succeeds = at_reset or bool(success[0].any()), succeeds or bool(success.any())
        kinds.append(episodes.kind)
    which = " or ".join(kinds)
    if not succeeds:
        raise CannotCheck(f"no {which} episode succeeds")
    if not times:
        raise CannotCheck(
            "where success is true, it is so from the reset on"
            if at_reset
            else "success comes at the last step only"
        )
    if gone > max(1, FLICKER_SHARE * times):
        yield Found(
            f"success is true for a single step {gone} of {times} times in {which} episodes. Ask for a state that lasts, "
            "such as `is_robot_static` or a count of steps, or an easier threshold.",
            checkup.places.entry("success"),
            gone,
        )


def success_stays_possible(checkup: Checkup) -> Iterator[Found | Note]:
    """Whether there is an entry at all, and in how many rollouts it is reached."""
    entries = checkup.starts.evaluate
    if any(known != "elapsed_steps" for _, known in _misspelt(entries)):
        raise CannotCheck("an entry has nearly the name that ManiSkill reads, see entry-name")
    if "success" not in entries and "fail" not in entries:
        own = checkup.loaded.cls.compute_sparse_reward is not BaseEnv.compute_sparse_reward
        if checkup.task.env.reward_mode != "sparse" or own:
            # As ManiSkill's tasks of walking, balancing and drawing.
            yield Note("evaluate() has neither success nor fail, so no success rate can be counted")
            return
        yield Found(
            "evaluate() returns neither success nor fail, from which the sparse reward is made: it is always 0. Return "
            "{'success': ...} as a bool tensor with a row for each env.",
            checkup.places.hook("evaluate"),
        )
    elif "success" in entries:
        for episodes in checkup.rollouts:
            reached = int(_flag(episodes, "success").any(axis=0).sum())
            yield Note(f"success in {of(reached, len(episodes.seeds), f'{episodes.kind} episode')}")


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
    task = checkup.task
    others = checkup.reset(task, checkup.seeds[0]).others
    others = {**others, **checkup.step(task, hold_action(task.parts, task.num_envs)).others}
    for name, entry in others.items():
        if not entry.per_env:
            yield Found(
                f"the entry {name!r} of evaluate() is a {entry.what} for all {task.num_envs} envs together. Give it a row "
                "for each env, or leave it out: what only people read can be logged elsewhere.",
                checkup.places.entry(name.rpartition("/")[2]),
            )


def entries_finite(checkup: Checkup) -> Iterator[Found | Note]:
    """Over all rollouts."""
    told: set[str] = set()
    for episodes in checkup.rollouts:
        for name, rows in episodes.evaluate.items():
            if rows.dtype.kind != "f" or name in told:
                continue
            bad = np.logical_or.reduce(~np.isfinite(rows.reshape(*rows.shape[:2], -1)), axis=2)
            if not bad.any():
                continue
            told.add(name)
            step, env = (int(i) for i in np.argwhere(bad)[0])
            count = of(int(bad.any(axis=0).sum()), bad.shape[1], f"{episodes.kind} episode")
            yield Found(
                f"{name!r} is not finite in {count}, first at step {step} of seed {episodes.seeds[env]}. Look for a division "
                "or a square root of what can be 0, and clamp it; for what is not known, return 0 and a bool beside it.",
                checkup.places.entry(name.rpartition("/")[2]),
                int(bad.sum()),
            )


def _flag(episodes: Episodes, name: str) -> NDArray[np.bool_]:
    """(T + 1, K)"""
    rows = episodes.evaluate.get(name)
    if rows is None:
        raise CannotCheck(f"evaluate() has no entry {name}")
    return flags(rows)


def flags(rows: NDArray) -> NDArray[np.bool_]:
    """(T, K) of (T, K, ...)."""
    return np.logical_or.reduce(rows.reshape(*rows.shape[:2], -1).astype(bool), axis=2)


CHECKS: Mapping[str, Check] = {
    "success-at-reset": success_at_reset,
    "success-stays-possible": success_stays_possible,
    "entry-name": entry_name,
    "info-rows": info_rows,
    "success-and-fail": success_and_fail,
    "success-flickers": success_flickers,
    "entries-finite": entries_finite,
}
