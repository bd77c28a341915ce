"""Checks of the observation: what a policy reads, and what it should or should not be told."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from mani_skill.envs.sapien_env import BaseEnv
from numpy.typing import NDArray

from workbench.checks.evidence.checkup import Check, Checkup, Found, NotApplicable, Note, NotKnown, leaf_rows
from workbench.checks.evidence.odd_states import DENSE_HOOKS, odd_states, write_all
from workbench.checks.evidence.over_seeds import OverSeeds, together, tried
from workbench.checks.results import Seen
from workbench.envs import maniskill_private
from workbench.envs.broken_rule import Place
from workbench.envs.evaluate_entries import split_entries
from workbench.envs.scene.scene_index import scene_index
from workbench.envs.simulation.state_layout import BODY
from workbench.envs.snapshots.snapshot import remembering
from workbench.envs.state_columns import flat_names, split_flat
from workbench.envs.task_env import TaskEnv
from workbench.episodes.recorded_state import read_states
from workbench.machine.text import listed, of
from workbench.task.blame import blamed

HUGE = 1000.0
MOVED = np.array([0.031, -0.043, 0.057], np.float32)
"""Metres by which a body is moved, to see which numbers follow."""
FOLLOWS = 1e-5
"""Least change of a number that follows."""
MOST_BODIES = 40
"""Bodies that are moved one after the other."""


def see_observation_finite(checkup: Checkup) -> Iterator[Seen]:
    """Over random rollouts: a row for each leaf; where all are finite, also over odd states."""
    finite = True
    for name, rows in _leaves(checkup).items():
        bad = np.logical_or.reduce(~np.isfinite(rows), axis=2)
        seeds = tuple(checkup.random.seeds[i] for i in np.flatnonzero(bad.any(axis=0)))
        texts: tuple[str, ...] = ()
        if seeds:
            finite = False
            step, env = (int(i) for i in np.argwhere(bad)[0])
            texts = (f"first at step {step} of seed {checkup.random.seeds[env]}",)
        place = _place(checkup, name) if seeds else None
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
                place = _place(checkup, name)
                yield Seen(("odd states", name), place, count=int(bad.sum()), texts=(text,))
                return


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
    """Over random rollouts and odd states: the numbers of each leaf in which none changes."""
    seen = checkup.look(odd_states)
    yield Seen(tried=len(checkup.seeds))
    for name, rows in _leaves(checkup).items():
        odd = [obs[name] for obs in seen.obs if name in obs]
        values = np.concatenate([rows.reshape(-1, rows.shape[2]), *odd])
        changes = not values.size or not np.isfinite(values).all() or np.ptp(values, axis=0).max() > 0
        yield Seen(
            (name,),
            None if changes else _place(checkup, name),
            tried=len(values),
            numbers=() if changes else tuple(values[0].tolist()),
            texts=("of the robot",) if _is_of_the_robot(checkup, name) else (),
        )


def observation_constant(rows: Sequence[Seen]) -> Iterator[Found | Note]:
    """Leaves that are the same for all seeds."""
    named = [row for row in rows if row.names]
    _require_leaves(named)
    if tried(rows) < 2:
        raise NotKnown("it needs two seeds")
    values: dict[tuple[str, ...], set[tuple[float, ...]]] = {}
    for row in named:
        values.setdefault(row.names, set()).add(row.numbers)
    for row in together(rows):
        name, value = row.names[0], np.array(row.numbers)
        if len(values[row.names]) > 1 or not row.numbers:
            continue
        if np.isin(value, (0.0, 1.0)).all() or row.texts:
            # A flag or a force, which random actions may never raise; or the robot's own, such as a palm that is fixed.
            yield Note(f"{name!r} of the observation is {_text(value)} in all states that were tried")
            continue
        yield Found(
            f"{name!r} of the observation is {_text(value)} in all of {row.tried} states, over "
            f"{tried(rows)} seeds. Leave it out, or draw it anew in _initialize_episode.",
            row.place,
        )


def see_observation_huge(checkup: Checkup) -> Iterator[Seen]:
    """Over random rollouts: a row for each leaf."""
    for name, rows in _leaves(checkup).items():
        size = np.abs(np.nan_to_num(rows, posinf=0, neginf=0))
        huge = size.max(axis=2) > HUGE
        texts: tuple[str, ...] = ()
        if huge.any():
            step, env = (int(i) for i in np.argwhere(huge)[0])
            texts = (f"first at step {step} of seed {checkup.random.seeds[env]}",)
        place = _place(checkup, name) if texts else None
        yield Seen((name,), place, count=int(huge.sum()), size=float(size.max()), texts=texts)


def observation_huge(rows: Sequence[Seen]) -> Iterator[Found | Note]:
    _require_leaves(rows)
    for row in together(rows):
        if row.count:
            yield Found(
                f"{row.names[0]!r} of the observation is up to {row.size:.4g}, {row.texts[0]}. Give metres and radians, "
                "clamp it, or leave out what is hidden far away.",
                row.place,
                row.count,
            )


def _require_leaves(rows: Sequence[Seen]) -> None:
    if not rows:
        raise NotApplicable("its observation has no numbers")


def ground_truth(checkup: Checkup) -> Iterator[Found | Note]:
    """In a mode with pictures: each body that moves freely is moved, and the numbers that follow are found."""
    told: dict[str, list[str]] = {}
    seen = {body: moved for body, moved in checkup.look(followers).items() if not moved.hidden}
    if not seen:
        raise NotApplicable("nothing but its robot moves freely")
    for body, moved in seen.items():
        for leaf in moved.observation:
            told.setdefault(leaf, []).append(body)
    for leaf, bodies in told.items():
        yield Found(
            f"{leaf!r} of _get_obs_extra() follows {listed(bodies)} in obs_mode "
            f"{checkup.pictured.env.obs_mode!r}. Put it behind `if self.obs_mode_struct.use_state:`.",
            _place(checkup, f"extra/{leaf}"),
        )
    if not told:
        _require_all_moved(checkup)


def _require_all_moved(checkup: Checkup) -> None:
    if (count := len(scene_index(checkup.pictured.env).states)) > MOST_BODIES:
        raise NotKnown(f"{MOST_BODIES} of {count} bodies were looked at")


def hidden_goal(checkup: Checkup) -> Iterator[Found | Note]:
    """In a mode with pictures: each body that the task hides is moved, and what follows is found."""
    bodies = {body: moved for body, moved in checkup.look(followers).items() if moved.hidden}
    if not bodies:
        raise NotApplicable("it hides nothing from pictures")
    found = False
    for body, moved in bodies.items():
        if moved.meaning and not moved.observation:
            found = True
            yield Found(
                f"{body} is hidden from pictures, {listed(sorted(moved.meaning))} of evaluate() or the reward depends "
                "on where it is, and nothing in _get_obs_extra() does. Add its position there, in all modes.",
                checkup.places.hook("_get_obs_extra"),
            )
    if not found:
        _require_all_moved(checkup)


# --- leaves by name ------------------------------------------------------------------------------------------


def _leaves(checkup: Checkup) -> dict[str, NDArray[np.float64]]:
    """(T + 1, K, D) of random rollouts by leaf; a flat observation is split by its names."""
    obs = checkup.random.obs
    names = flat_names(checkup.task, checkup.task.obs) if [*obs] == ["obs"] else None
    if names is None:
        return obs
    parts = split_flat(names, obs["obs"])
    return {name: rows.reshape(*rows.shape[:2], -1) for name, rows, _ in parts}


def _place(checkup: Checkup, leaf: str) -> Place | None:
    """Where the task makes a leaf."""
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


# --- what follows a body that is moved -----------------------------------------------------------------------


@dataclass
class Followers:
    """What changes with the place of one body, and nothing else."""

    hidden: bool
    """Whether the task hides the body from pictures."""
    observation: set[str] = field(default_factory=set)
    """Leaves of ``_get_obs_extra``."""
    meaning: set[str] = field(default_factory=set)
    """Entries of ``evaluate``, and ``the reward``."""


def followers(checkup: Checkup) -> dict[str, Followers]:
    """Evidence for `Checkup.look`: what follows each body that moves freely or is hidden, in a mode with pictures."""
    task = checkup.pictured
    checkup.reset(task, checkup.seeds[0])
    env: Any = task.env
    begun = read_states(env)
    robots = {agent.robot.name for agent in maniskill_private.agents(env)}
    index = scene_index(env)
    hidden = {name for name, is_hidden in zip(index.names, index.hidden, strict=True) if is_hidden}
    found: dict[str, Followers] = {}
    with blamed("observation", checkup.loaded, task):
        before = _ask(checkup, task)
        again = _ask(checkup, task)
        restless = _changed(before, again)
        for name, struct in [*index.states.items()][:MOST_BODIES]:
            kind, _, body = name.partition("/")
            free = body not in robots if kind == "articulations" else struct.px_body_type == "dynamic"
            if not (free or body in hidden) or np.isnan(begun[name]).any():
                continue
            states = {other: rows.copy() for other, rows in begun.items()}
            states[name][:, :3] += MOVED
            if kind == "articulations":
                joints = (states[name].shape[1] - BODY) // 2
                states[name][:, BODY : BODY + joints] += 0.02
            write_all(env, states)
            moved = _changed(before, _ask(checkup, task)) - restless
            found[body] = Followers(
                body in hidden,
                {leaf.removeprefix("obs/") for leaf in moved if leaf.startswith("obs/")},
                {leaf for leaf in moved if not leaf.startswith("obs/")},
            )
            write_all(env, begun)
    return found


def _ask(checkup: Checkup, task: TaskEnv) -> dict[str, NDArray[np.float64]]:
    """(N, D) of each leaf of ``_get_obs_extra`` (``obs/...``), each entry of ``evaluate``, and the reward."""
    env = task.env
    with remembering(env):
        info = env.get_info()
        extra = maniskill_private.extra_observation(env, info)
        rows = {f"obs/{name}": value for name, value in leaf_rows(extra, task.num_envs).items()}
        entries = split_entries(info, task.num_envs)[0]
        rows |= {name: np.asarray(value, np.float64) for name, value in entries.items()}
        if checkup.loaded.cls.compute_dense_reward is not BaseEnv.compute_dense_reward:
            action = torch.zeros(env.action_space.shape or (), device=env.device)
            observed: Any = {"extra": extra}
            reward = getattr(env, DENSE_HOOKS["dense"])(obs=observed, action=action, info=info)
            rows["the reward"] = torch.as_tensor(reward).double().numpy(force=True)
    return rows


def _changed(before: dict[str, NDArray[np.float64]], now: dict[str, NDArray[np.float64]]) -> set[str]:
    return {
        name
        for name, rows in now.items()
        if name in before
        and rows.shape == before[name].shape
        and np.abs(np.nan_to_num(rows) - np.nan_to_num(before[name])).max(initial=0) > FOLLOWS
    }


CHECKS: Mapping[str, Check] = {
    "observation-finite": OverSeeds(see_observation_finite, observation_finite),
    "observation-constant": OverSeeds(see_observation_constant, observation_constant),
    "observation-huge": OverSeeds(see_observation_huge, observation_huge),
}
PICTURE_CHECKS: Mapping[str, Check] = {
    "ground-truth": ground_truth,
    "hidden-goal": hidden_goal,
}
"""In an env that observes pictures, as the cameras."""
