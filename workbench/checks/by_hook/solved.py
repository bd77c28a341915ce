"""Checks of the reward on episodes that are solved by planning: what the rollouts of each step earned."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from workbench.checks.evidence.checkup import Check, Checkup, Found, NotApplicable, Note, NotKnown
from workbench.envs.task_env import TaskEnv, given_arguments
from workbench.planning.planned_episodes import EpisodeLog, PlannedEpisode
from workbench.planning.planner import Planner
from workbench.planning.rollouts import NotAlike, NothingToPlan, control_mode_to_plan, require_plannable
from workbench.planning.seeds_report import few_seeds_text
from workbench.planning.verdicts import MIN_EPISODES, MIN_SEEDS, PlannedEpisodes
from workbench.planning.verdicts import RULES as VERDICTS
from workbench.task.blame import blamed

SEEDS = MIN_SEEDS
"""Most seeds that are solved: each takes seconds."""
STEPS = 200
"""Of an episode whose task has no time limit."""
AFTER_SUCCESS = 5
"""Control steps that an episode goes on after its success."""
HOOK = {"success-lost": "evaluate"}
"""At which a rule is told; the others at the dense reward."""
_OF_SUCCESS = {
    "reward-exploited": 1,
    "reward-stuck": 0,
    "reward-against": MIN_EPISODES,
    "success-lost": MIN_EPISODES,
}
"""Rules that speak of success, with the fewest solved seeds from which on it says something that they are not broken."""


def solved_episodes(checkup: Checkup) -> PlannedEpisodes:
    """The first seeds, each to its success, its fail or the end of its time.

    Raises:
        NotApplicable, NotKnown: nothing can be planned.
    """
    # Each rollout is an env.
    checkup.require_several()
    cls, found = checkup.loaded.cls, list[PlannedEpisode]()
    given = {**checkup.loaded.default_kwargs, **checkup.env_kwargs}
    try:
        require_plannable(checkup.task.env)
    except NothingToPlan as reason:
        raise NotApplicable(str(reason)) from None
    mode = control_mode_to_plan(checkup.task.env, given)
    with checkup.env(1, **mode) as live:  # type: ignore[arg-type]
        made_with = given_arguments(cls, checkup.env_kwargs, checkup.loaded.default_kwargs)
        with blamed("build", checkup.loaded):
            planner = Planner(live.env, made_with=made_with)  # type: ignore[arg-type]
        try:
            for seed in checkup.seeds[:SEEDS]:
                found.append(_solved(checkup, live, planner, seed))
        finally:
            with blamed("step", checkup.loaded):
                planner.close()
    return PlannedEpisodes(tuple(found))


def _solved(checkup: Checkup, live: TaskEnv, planner: Planner, seed: int) -> PlannedEpisode:
    checkup.reset(live, [seed])
    planner.reset(seed=seed)
    log, rolled = EpisodeLog(seed, planner.horizon), TaskEnv(planner.rollout_env)
    try:
        planner.require_alike(0)
    except NotAlike as error:
        raise NotKnown(str(error)) from error
    after = 0
    for _ in range(live.max_episode_steps or STEPS):
        with blamed("step", checkup.loaded, rolled):
            action = planner.flat_actions([0])
        log.add_plan(planner.plans[0])
        step = checkup.step(live, action)
        log.add_step(step, 0)
        success, fail = (bool(step.evaluate.get(name, np.zeros(1))[0]) for name in ("success", "fail"))
        after += success or after > 0
        if fail or after > AFTER_SUCCESS:
            break
    return log.episode()


def _require_tried(rule: str, episodes: PlannedEpisodes) -> None:
    """Raise NotApplicable or NotKnown where no verdict says nothing."""
    entries = {name for one in episodes.all for name in one.evaluate}
    if rule in _OF_SUCCESS and "success" not in entries:
        raise NotApplicable("evaluate() has no entry success")
    if rule == "failing-pays" and "fail" not in entries:
        raise NotApplicable("evaluate() has no entry fail")
    if len(episodes.all) < MIN_SEEDS:
        raise NotKnown(f"fewer than {MIN_SEEDS} seeds were planned")
    if len(episodes.solved) < _OF_SUCCESS.get(rule, 0):
        raise NotKnown(f"planning solved {len(episodes.solved)} of {len(episodes.all)} seeds")


def _check_of(rule: str) -> Check:
    def check(checkup: Checkup) -> Iterator[Found | Note]:
        episodes = checkup.look(solved_episodes)
        verdict = VERDICTS[rule](episodes)
        if rule == "reward-exploited":
            solved = [one.solved_at for one in episodes.solved]
            steps = f", in {np.median(solved):g} control steps (median)" if solved else ""
            yield Note(f"planning solved {len(solved)} of {len(episodes.all)} seeds{steps}")
            if len(episodes.all) < MIN_SEEDS:
                yield Note(few_seeds_text(len(episodes.all)))
        if verdict is not None:
            hook = HOOK.get(rule, "compute_dense_reward")
            place = checkup.places.hook(hook, "compute_normalized_dense_reward", "evaluate")
            yield Found(f"{verdict.message[0].upper()}{verdict.message[1:]}.", place, len(verdict.seeds))
        else:
            _require_tried(rule, episodes)

    return check


CHECKS: dict[str, Check] = {rule: _check_of(rule) for rule in VERDICTS}
