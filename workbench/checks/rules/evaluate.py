"""Checks of what ``evaluate`` returns: success and fail, and the names of its entries."""

from __future__ import annotations

import difflib
from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace

import numpy as np
from mani_skill.envs.sapien_env import BaseEnv
from numpy.typing import NDArray

from workbench.checks.evidence.collect import Checkup, Found, NotApplicable, Note, NotKnown
from workbench.checks.evidence.over_seeds import first_kind, together, tried
from workbench.checks.evidence.rolled_episodes import Episodes
from workbench.checks.register_rule import outlier_check, rule
from workbench.checks.results import Seen
from workbench.envs.action_vector import hold_action
from workbench.envs.broken_rule import Place
from workbench.machine.text import listed, of

READ_BY_MANISKILL = ("success", "fail", "elapsed_steps")
"""Entries of ``evaluate()`` that ManiSkill reads."""
FLICKER_SHARE = 0.25
"""Maximum number of times that success becomes true for one step only, as a share of all times that it
becomes true."""


def see_success_at_reset(checkup: Checkup) -> Iterator[Seen]:
    """One row: the seeds whose reset gives success."""
    success = _flag(checkup.starts, "success")[0]
    seeds = [seed for seed, true in zip(checkup.starts.seeds, success, strict=True) if true]
    yield Seen(place=checkup.places.entry("success"), tried=len(success), seeds=tuple(seeds))


@rule("success-at-reset", "stop", "evaluate", see=see_success_at_reset)
def success_at_reset(rows: Sequence[Seen]) -> Iterator[Found | Note]:
    """evaluate() does not report success right after a reset.

    Episodes end before the policy acts, and the success rate counts them.

    ## Why
    ManiSkill ends an episode when success is true, so a trainer resets the env after one step, again and
    again. The success rate counts these episodes, and a policy that does nothing looks good. With thousands
    of envs, even a few percent of such starts shift the success rate.

    ## Fix
    Place the goal farther away than the threshold reaches, or ask for more in `evaluate`.

    ```python fragment
    goal = cube + torch.tensor([GOAL_RADIUS + 0.1, 0, 0])  # in _initialize_episode
    self.goal.set_pose(Pose.create_from_pq(p=goal))
    ```

    ## How it is checked
    The rule resets all seeds (32 by default) and reads `success` before the first step. The result is *not
    applicable* without an entry `success`. The rule misses a start that is solved in one of thousands of
    seeds.
    """
    if seeds := [seed for row in rows for seed in row.seeds]:
        yield Found(
            f"success is true right after the reset of {of(len(seeds), tried(rows), 'seed')} (seed {listed(seeds)}): "
            "the episode would end at its first step. Place the bodies away from the goal, or require more in "
            "evaluate() than is true at the start.",
            rows[0].place,
            len(seeds),
        )


def see_success_stays_possible(checkup: Checkup) -> Iterator[Seen]:
    """One row if ``evaluate()`` has neither success nor fail. If it has success, a row for each kind of
    rollouts: how many episodes reach success."""
    entries = checkup.starts.evaluate
    own = checkup.loaded.cls.compute_sparse_reward is not BaseEnv.compute_sparse_reward
    sparse = checkup.task.env.reward_mode == "sparse" and not own
    if sparse and any(known != "elapsed_steps" for _, known in _misspelt(entries)):
        raise NotKnown("an entry has nearly the name that ManiSkill reads, see entry-name")
    if "success" not in entries and "fail" not in entries:
        # ManiSkill's tasks of walking, balancing and drawing have neither.
        yield Seen(place=checkup.places.hook("evaluate"), count=int(sparse))
    elif "success" in entries:
        for episodes in checkup.rollouts:
            reached = int(_flag(episodes, "success").any(axis=0).sum())
            yield Seen((episodes.kind,), tried=len(episodes.seeds), count=reached)


@rule("success-stays-possible", "warn", "evaluate", see=see_success_stays_possible)
def success_stays_possible(rows: Sequence[Seen]) -> Iterator[Found | Note]:
    """`evaluate()` has an entry `success` (or `fail`) if the reward is sparse.

    The sparse reward is made of success and fail: without them it is always 0.

    ## Why
    ManiSkill makes the sparse reward from `success` and `fail`. If a task has neither, the sparse reward is 0
    at every step, no episode ends early, and no success rate can be counted.

    ## Fix
    Return a bool tensor with a row for each env.

    ```python fragment
    def evaluate(self):
        distance = torch.linalg.norm(self.cube.pose.p - self.goal.pose.p, dim=1)
        return {"success": distance < GOAL_RADIUS}
    ```

    ## How it is checked
    The rule reads the entries of `evaluate()` after a reset. A task with neither `success` nor `fail` breaks
    the rule if its reward is ManiSkill's sparse one. If such a task has a dense reward, no reward, or its own
    `compute_sparse_reward`, the result is *not applicable*: tasks of walking and balancing have no success.
    The rule notes how many random episodes and how many episodes with the actions of `--actions` succeed. It
    does not find out by itself whether success can be reached. The result is *not known* if `entry-name`
    finds a misspelt entry.
    """
    for row in rows[:1]:
        if not row.names and not row.count:
            raise NotApplicable(
                "the task's reward is not ManiSkill's sparse one, and evaluate() has neither success nor fail: no success "
                "rate can be counted"
            )
        elif not row.names:
            yield Found(
                "evaluate() returns neither success nor fail, so the sparse reward made from them is always 0. Return "
                "{'success': ...} as a bool tensor with a row for each env.",
                row.place,
            )
    for row in together(rows):
        if row.tried:
            yield Note(f"success in {of(row.count, row.tried, f'{row.names[0]} episode')}")


@rule("entry-name", "warn", "evaluate")
def entry_name(checkup: Checkup) -> Iterator[Found | Note]:
    """Entries of evaluate() that ManiSkill should read have exactly the names that it reads.

    ManiSkill passes 'succes' on like any other entry, and no episode ever succeeds.

    ## Why
    ManiSkill reads `success` and `fail` and passes all other entries on, also a misspelt `succes`: there is
    no error, episodes do not end, and the success rate is 0 after days of training.

    ## Fix
    Rename the entry.

    ```python fragment
    return {"success": distance < GOAL_RADIUS}
    ```

    ## How it is checked
    The rule compares the names of the entries after a reset with `success`, `fail` and `elapsed_steps`. It
    reports a name that is nearly one of these if that one is missing. It does not find other words (`done`,
    `solved`).
    """
    for name, known in _misspelt(checkup.starts.evaluate):
        yield Found(
            f"evaluate() returns {name!r}, and ManiSkill reads {known!r}. Rename the entry.",
            checkup.places.entry(name),
        )


def _misspelt(entries: Collection[str]) -> Iterator[tuple[str, str]]:
    """Pairs (entry, name that ManiSkill reads): the entry has nearly that name, and no entry has exactly that
    name."""
    for name in entries:
        for known in READ_BY_MANISKILL:
            close = difflib.SequenceMatcher(None, name.lower(), known).ratio() >= 0.8
            if known not in entries and close and "/" not in name:
                yield name, known


@rule("info-rows", "warn", "evaluate")
def info_rows(checkup: Checkup) -> Iterator[Found | Note]:
    """Every entry of evaluate() has a row for each env.

    Vectorised wrappers and loggers cannot slice the entry by env, and fail or drop it.

    ## Why
    Vectorised wrappers slice every entry by env when some episodes end and others go on. A single number for
    the whole batch cannot be sliced: the wrapper drops it or fails.

    ## Fix
    Return a row for each env, and take the mean where it is logged.

    ```python fragment
    return {"success": success, "progress": progress}  # not progress.mean()
    ```

    ## How it is checked
    The rule reads the entries after a reset and after a step, including those that the reward adds to `info`.
    A list or text with an item for each env counts as rows. The rule does not find an entry whose first
    dimension equals the number of envs by accident.
    """
    task, found = checkup.task, False
    others = checkup.reset(task, checkup.seeds[0]).others
    others = {**others, **checkup.step(task, hold_action(task.parts, task.num_envs)).others}
    for name, entry in others.items():
        if not entry.per_env:
            found = True
            yield Found(
                f"The entry {name!r} of evaluate() is a {entry.what} for all {task.num_envs} envs together. Give it a row "
                "for each env, or leave it out: log a number for people elsewhere.",
                checkup.places.entry(name.rpartition("/")[2]),
            )
    if not found:
        checkup.require_several()


def see_success_and_fail(checkup: Checkup) -> Iterator[Seen]:
    """A row for each kind of rollouts, up to the first kind with a breach: the number of states with both
    success and fail, whether any state has success, and whether any state has fail."""
    for episodes in checkup.rollouts:
        success, fail = _flag(episodes, "success"), _flag(episodes, "fail")
        both = success & fail
        place = checkup.places.entry("success")
        seen = _seen_at(both, episodes, (episodes.kind,), place)
        yield replace(seen, numbers=(float(success.any()), float(fail.any())))
        if both.any():
            return


@rule("success-and-fail", "warn", "evaluate", see=see_success_and_fail)
def success_and_fail(rows: Sequence[Seen]) -> Iterator[Found | Note]:
    """`success` and `fail` are never true together.

    An episode counts as a success and as a failure.

    ## Why
    Both end the episode. The sparse reward adds 1 and subtracts 1, and logs count the episode as a success
    and as a failure.

    ## Fix
    Decide which one wins.

    ```python fragment
    fail = height < -0.1
    return {"success": (distance < GOAL_RADIUS) & ~fail, "fail": fail}
    ```

    ## How it is checked
    The rule rolls out all seeds with random actions for up to 50 control steps, and with the actions of
    `--actions`, and reads each state. The result is *not applicable* if one of the entries is missing, and
    *not known* if no episode succeeds, or none fails. A policy (`--actions`) reaches more states.
    """
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
    """A row about the breaches `bad`, (T, K), in states of episodes."""
    seeds = tuple(episodes.seeds[i] for i in np.flatnonzero(bad.any(axis=0)))
    texts: tuple[str, ...] = ()
    if seeds:
        step, env = (int(i) for i in np.argwhere(bad)[0])
        texts = (f"first at step {step} of seed {episodes.seeds[env]}",)
    return Seen(names, place, bad.shape[1], seeds, int(bad.sum()), texts=texts)


def _episodes_of(row: Seen) -> str:
    """Text such as ``3 of 32 random episodes`` for a row whose first name is the kind of episodes."""
    return of(len(row.seeds), row.tried, f"{row.names[0]} episode")


def see_success_flickers(checkup: Checkup) -> Iterator[Seen]:
    """A row for each kind of rollouts: how often success becomes true, and how often it is false again at the next step."""
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


@rule("success-flickers", "warn", "evaluate", see=see_success_flickers)
def success_flickers(rows: Sequence[Seen]) -> Iterator[Found | Note]:
    """`success` stays true for several steps once it is true.

    Whether an episode counts depends on the step at which `success` is read.

    ## Why
    Evaluation counts success at the last step or at any step, and the two differ if success comes and goes.
    An episode ends at the first success, so a policy is rewarded for passing through the goal.

    ## Fix
    Ask for a state that lasts.

    ```python fragment
    is_placed = distance < GOAL_RADIUS
    return {"success": is_placed & self.agent.is_static(0.2)}
    ```

    ## How it is checked
    The rule counts how often success becomes true and how often it is false again at the next step, in random
    rollouts (all seeds, up to 50 steps) and in those of `--actions`. It reports a task if success is false
    again more than once, and after more than a quarter of the steps at which it becomes true. The result is
    *not known* if no episode succeeds, or if success is true from the reset on
    ([success-at-reset](success-at-reset.md)).
    """
    times, gone = sum(row.tried for row in rows), sum(row.count for row in rows)
    at_reset, succeeds = (any(row.numbers[k] for row in rows) for k in (0, 1))
    which = " or ".join(dict.fromkeys(row.names[0] for row in rows))
    if not succeeds:
        raise NotKnown(f"no {which} episode succeeds")
    if not times:
        raise NotKnown(
            "success does not become true in any episode after its reset"
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


def see_entries_finite(checkup: Checkup) -> Iterator[Seen]:
    """A row for each kind of rollouts, and a row for each entry of ``evaluate()`` that is not finite there."""
    for episodes in checkup.rollouts:
        numbers = float(sum(rows.dtype.kind == "f" for rows in episodes.evaluate.values()))
        yield Seen((episodes.kind,), tried=len(episodes.seeds), numbers=(numbers,) if numbers else ())
        for name, rows in episodes.evaluate.items():
            if rows.dtype.kind != "f":
                continue
            bad = np.logical_or.reduce(~np.isfinite(rows.reshape(*rows.shape[:2], -1)), axis=2)
            if bad.any():
                place = checkup.places.entry(name.rpartition("/")[2])
                yield _seen_at(bad, episodes, (episodes.kind, name), place)


@outlier_check("entries-finite", see=see_entries_finite)
def entries_finite(rows: Sequence[Seen]) -> Iterator[Found | Note]:
    reported: set[str] = set()
    if not any(row.numbers for row in rows):
        raise NotApplicable("evaluate() returns no numbers")
    for row in together(row for row in rows if len(row.names) == 2):
        kind, name = row.names
        if name in reported:
            continue
        reported.add(name)
        count = of(len(row.seeds), tried(rows, kind), f"{kind} episode")
        yield Found(
            f"{name!r} is not finite in {count}, {row.texts[0]}. Look for a division "
            "or a square root of what can be 0, and clamp it; for an unknown value, return 0 and a bool that says so.",
            row.place,
            row.count,
        )


def _flag(episodes: Episodes, name: str) -> NDArray[np.bool_]:
    """(T + 1, K) of an entry of ``evaluate()``. Raises NotApplicable if it is missing."""
    rows = episodes.evaluate.get(name)
    if rows is None:
        raise NotApplicable(f"evaluate() has no entry {name}")
    return flags(rows)


def flags(rows: NDArray) -> NDArray[np.bool_]:
    """(T, K) whether any number of a row (T, K, ...) is true."""
    return np.logical_or.reduce(rows.reshape(*rows.shape[:2], -1).astype(bool), axis=2)
