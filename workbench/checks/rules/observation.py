"""Checks of the observation: whether a policy can use its numbers."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from mani_skill.envs.sapien_env import BaseEnv
from numpy.typing import NDArray

from workbench.checks.evidence.collect import Checkup, Found, NotApplicable, Note, NotKnown
from workbench.checks.evidence.odd_states import odd_states
from workbench.checks.evidence.over_seeds import together, tried
from workbench.checks.register_rule import outlier_check, rule
from workbench.checks.results import Seen
from workbench.envs.broken_rule import Place
from workbench.envs.state_columns import flat_names, split_flat
from workbench.machine.text import of

HUGE_NUMBER = 1000.0
"""Maximum absolute value of a number in an observation."""


def see_observation_finite(checkup: Checkup) -> Iterator[Seen]:
    """A row for each leaf of the observation in random rollouts; if all leaves are finite there, also a row
    for the first leaf that is not finite in `odd_states`."""
    finite = True
    for name, rows in _leaves(checkup).items():
        bad = np.logical_or.reduce(~np.isfinite(rows), axis=2)
        seeds = tuple(checkup.random.seeds[i] for i in np.flatnonzero(bad.any(axis=0)))
        texts: tuple[str, ...] = ()
        if seeds:
            finite = False
            step, env = (int(i) for i in np.argwhere(bad)[0])
            texts = (f"first at step {step} of seed {checkup.random.seeds[env]}",)
        place = place_of_leaf(checkup, name) if seeds else None
        yield Seen(("random", name), place, bad.shape[1], seeds, int(bad.sum()), texts=texts)
    if not finite:
        return
    seen = checkup.look(odd_states)
    for row, obs in enumerate(seen.obs):
        for name, rows in obs.items():
            bad = ~np.isfinite(rows).all(axis=1)
            if bad.any():
                env = int(np.flatnonzero(bad)[0])
                text = f"{seen.kinds[row]} (seed {seen.seeds[row][env]})"
                place = place_of_leaf(checkup, name)
                yield Seen(("odd states", name), place, count=int(bad.sum()), texts=(text,))
                return


@outlier_check("observation-finite", see=see_observation_finite)
def observation_finite(rows: Sequence[Seen]) -> Iterator[Found | Note]:
    _require_leaves(rows)
    found = [row for row in together(rows) if row.count]
    for row in sorted(found, key=lambda row: row.names[0] != "random")[:1]:
        where = row.texts[0]
        if row.names[0] == "random":
            where = f"in {of(len(row.seeds), row.tried, 'episode')}, {where}"
        yield Found(
            f"{row.names[1]!r} of the observation is not finite {where}. Look for a division or a square root of what can "
            "be 0, and clamp it.",
            row.place,
            row.count,
        )


def see_observation_constant(checkup: Checkup) -> Iterator[Seen]:
    """A row for each leaf in random rollouts and `odd_states`, with its numbers if none of them changes."""
    seen = checkup.look(odd_states)
    yield Seen(tried=len(checkup.seeds))
    for name, rows in _leaves(checkup).items():
        odd = [obs[name] for obs in seen.obs if name in obs]
        values = np.concatenate([rows.reshape(-1, rows.shape[2]), *odd])
        changes = not values.size or not np.isfinite(values).all() or np.ptp(values, axis=0).max() > 0
        yield Seen(
            (name,),
            None if changes else place_of_leaf(checkup, name),
            tried=len(values),
            numbers=() if changes else tuple(values[0].tolist()),
            texts=("of the robot",) if _is_of_the_robot(checkup, name) else (),
        )


@rule("observation-constant", "warn", "_get_obs_extra", see=see_observation_constant)
def observation_constant(rows: Sequence[Seen]) -> Iterator[Found | Note]:
    """Numbers of an observation differ between episodes or steps.

    Constant numbers carry no information, and normalisers divide by their zero variance.

    ## Why
    A number that never changes tells a policy nothing. A normaliser divides by its variance of 0, and a later
    change of the constant breaks a trained policy.

    ## Fix
    Leave the number out, or draw it in `_initialize_episode`.

    ```python fragment
    obs = {"goal_pos": self.goal.pose.p}  # without the size of the cube, which is always 0.02
    ```

    ## How it is checked
    The rule reports an entry of the observation if none of its numbers changes over all seeds, all steps of
    random rollouts and the states that `reward-finite` makes. It only notes an entry of zeros and ones (a
    flag, a force, a unit rotation), since random actions may never change it, and an entry that the robot's
    class adds (`agent/...`). It accepts an entry in which only some numbers are constant, such as the height
    of a goal. The result is *not known* with one seed.
    """
    named = [row for row in rows if row.names]
    _require_leaves(named)
    if tried(rows) < 2:
        raise NotKnown("the rule needs two seeds")
    values: dict[tuple[str, ...], set[tuple[float, ...]]] = {}
    for row in named:
        values.setdefault(row.names, set()).add(row.numbers)
    for row in together(rows):
        name, value = row.names[0], np.array(row.numbers)
        if len(values[row.names]) > 1 or not row.numbers:
            continue
        if np.isin(value, (0.0, 1.0)).all() or row.texts:
            # A flag or a force, which random actions may never change; or an entry of the robot's class, such
            # as a palm that is fixed.
            yield Note(f"{name!r} of the observation is {_text(value)} in all states that were tried")
            continue
        yield Found(
            f"{name!r} of the observation is {_text(value)} in all of {row.tried} states, over "
            f"{tried(rows)} seeds. Leave it out, or draw it in _initialize_episode.",
            row.place,
        )


def see_observation_huge(checkup: Checkup) -> Iterator[Seen]:
    """A row for each leaf in random rollouts, with the number of states in which it is huge."""
    for name, rows in _leaves(checkup).items():
        size = np.abs(np.nan_to_num(rows, posinf=0, neginf=0))
        huge = size.max(axis=2) > HUGE_NUMBER
        texts: tuple[str, ...] = ()
        if huge.any():
            step, env = (int(i) for i in np.argwhere(huge)[0])
            texts = (f"first at step {step} of seed {checkup.random.seeds[env]}",)
        place = place_of_leaf(checkup, name) if texts else None
        yield Seen((name,), place, count=int(huge.sum()), size=float(size.max()), texts=texts)


@rule("observation-huge", "warn", "_get_obs_extra", see=see_observation_huge)
def observation_huge(rows: Sequence[Seen]) -> Iterator[Found | Note]:
    """Numbers of an observation are below 1000.

    Larger numbers drown all others in a network without normalisation; most often the cause is a hidden body
    or a wrong unit.

    ## Why
    Without a normaliser, a number of 100000 drowns all others in the first layer. Most often the cause is a
    body that was moved far away, or a wrong unit.

    ## Fix
    Give metres and radians, and clamp what may become large.

    ```python fragment
    obs = {"force": (force / 100).clamp(-1, 1)}
    ```

    ## How it is checked
    The rule reads each number of the observation in random rollouts of all seeds, and reports numbers above
    1000. NaN and infinity belong to `observation-finite`. The rule does not see what only a good policy
    reaches.
    """
    _require_leaves(rows)
    for row in together(rows):
        if row.count:
            yield Found(
                f"{row.names[0]!r} of the observation is up to {row.size:.4g}, {row.texts[0]}. Give metres and radians, "
                "clamp it, or leave out bodies that are hidden by moving them far away.",
                row.place,
                row.count,
            )


def _require_leaves(rows: Sequence[Seen]) -> None:
    if not rows:
        raise NotApplicable("the observation has no numbers")


# --- leaves by name ------------------------------------------------------------------------------------------


def _leaves(checkup: Checkup) -> dict[str, NDArray[np.float64]]:
    """(T + 1, K, D) by leaf, in random rollouts; a flat observation is split by its names."""
    obs = checkup.random.obs
    names = flat_names(checkup.task, checkup.task.obs) if [*obs] == ["obs"] else None
    if names is None:
        return obs
    parts = split_flat(names, obs["obs"])
    return {name: rows.reshape(*rows.shape[:2], -1) for name, rows, _ in parts}


def place_of_leaf(checkup: Checkup, leaf: str) -> Place | None:
    """The author's line that makes a leaf."""
    owner, _, name = leaf.partition("/")
    if owner == "agent":
        return checkup.places.hook("_get_obs_agent")
    return checkup.places.entry(name.partition("/")[0] or leaf, "_get_obs_extra")


def _is_of_the_robot(checkup: Checkup, leaf: str) -> bool:
    """Whether the robot's class makes a leaf, and not the task."""
    return leaf.startswith("agent/") and checkup.loaded.cls._get_obs_agent is BaseEnv._get_obs_agent


def _text(value: NDArray[np.float64]) -> str:
    shown = ", ".join(f"{number:.4g}" for number in value[:7])
    return shown if len(value) == 1 else f"({shown}{', ...' if len(value) > 7 else ''})"
