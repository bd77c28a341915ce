"""Checks of the reward on planned episodes, by what the rollouts of each step earned."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from workbench.checks.evidence.collect import Checkup, Found, NotApplicable, Note, NotKnown
from workbench.checks.register_rule import rule
from workbench.envs.task_env import TaskEnv, given_arguments
from workbench.planning.planned_episodes import EpisodeLog, PlannedEpisode
from workbench.planning.planner import Planner
from workbench.planning.rollouts import NotAlike, NothingToPlan, control_mode_to_plan, require_plannable
from workbench.planning.seeds_report import few_seeds_text
from workbench.planning.verdicts import MIN_EPISODES, MIN_SEEDS, VERDICTS, PlannedEpisodes
from workbench.task.blame import blamed

MAX_SEEDS = MIN_SEEDS
"""Maximum number of seeds that are planned: each takes seconds."""
STEPS_WITHOUT_LIMIT = 200
"""Maximum number of control steps of an episode whose task has no time limit."""
STEPS_AFTER_SUCCESS = 5
"""Number of control steps that an episode goes on after its success."""
_MIN_SOLVED = {
    "reward-exploited": 1,
    "reward-stuck": 0,
    "reward-against": MIN_EPISODES,
    "success-lost": MIN_EPISODES,
}
"""Rules about success, each with the number of seeds that must be solved to show that the rule is kept."""


@rule("reward-exploited", "warn", "compute_dense_reward", solve=True)
def reward_exploited(checkup: Checkup) -> Iterator[Found | Note]:
    """An episode without success earns less than a successful one.

    A policy learns something else that earns as much as success, and never solves the task.

    ## Why
    A policy maximises the reward as written, not as meant. If something else pays as much as success,
    training ends there: the curve of the return looks perfect, and the success rate stays at 0.

    ## Fix
    Look at the episodes that the finding names, and let the reward pay for what `evaluate` checks. For
    example, a cube held above the target is near it in x and y only.

    ```python fragment
    at_goal = torch.linalg.norm(self.cube.pose.p - self.goal.pose.p, dim=1)  # in x, y and z
    reward = 1 - torch.tanh(5 * at_goal)
    reward[info["success"]] = 3.0
    ```

    ## How it is checked
    `workbench check --solve` and [`workbench solve`](../jobs/solve.md) plan episodes with the task's own
    reward. The rule reports an unsolved episode if the mean reward of its last steps (at most ten) is at
    least the median reward of the steps at which solved episodes succeed. It finds nothing if no seed is
    solved, since what success pays is then unknown.
    """
    episodes = checkup.look(solved_episodes)
    solved = [one.solved_at for one in episodes.solved]
    steps = f", in {np.median(solved):g} control steps (median)" if solved else ""
    yield Note(f"planning solved {len(solved)} of {len(episodes.all)} seeds{steps}")
    if len(episodes.all) < MIN_SEEDS:
        yield Note(few_seeds_text(len(episodes.all)))
    yield from _verdict(checkup, "reward-exploited", "compute_dense_reward")


@rule("reward-flat", "warn", "compute_dense_reward", solve=True)
def reward_flat(checkup: Checkup) -> Iterator[Found | Note]:
    """While the task is unsolved, some actions earn more than others.

    The reward gives no direction: training gets stuck where it is flat.

    ## Why
    Where all actions earn the same, no gradient says what to do next. Training stays there, or gets away only
    by chance.

    ## Fix
    Give the next stage a term that changes as soon as the robot moves. `tanh` of a large number is flat:
    choose its factor by the distances of the task. A sparse reward is flat everywhere, and needs
    demonstrations.

    ```python fragment
    reach = 1 - torch.tanh(2 * distance)  # not 50 * distance: that is flat beyond 5 cm
    info["reward_terms"] = {"reach": reach, "place": place}
    ```

    ## How it is checked
    `workbench check --solve` and [`workbench solve`](../jobs/solve.md) plan episodes with the task's own
    reward. The rule reports an unsolved episode if, in each of its last steps (at most ten), the mean rewards
    per step of the best and the worst rollout differ by at most 1/500 of the range of all rewards that were
    seen. It names the terms of `info["reward_terms"]` that are flat there. It does not see a flat place in
    which no episode ends.
    """
    yield from _verdict(checkup, "reward-flat", "compute_dense_reward")


@rule("reward-stuck", "warn", "compute_dense_reward", solve=True)
def reward_stuck(checkup: Checkup) -> Iterator[Found | Note]:
    """While the task is unsolved, some actions earn more than the episode earned so far.

    A policy learns to stop there: the way to success costs reward first.

    ## Why
    The episode is in a local optimum: the way to success costs reward first, such as letting go of a cube
    that is near its goal, or going around an obstacle. A policy learns to stay.

    ## Fix
    Pay for a stage that is reached and keep paying for it, so that the next stage never costs more than it
    brings. Or lower a penalty that is larger than what can be gained.

    ```python fragment
    reward = reach + 1.0 * info["is_grasped"] + place * info["is_grasped"]
    reward[info["is_on_target"]] = 4.0  # letting go costs nothing any more
    ```

    ## How it is checked
    `workbench check --solve` and [`workbench solve`](../jobs/solve.md) plan episodes with the task's own
    reward. In each of the last steps (at most ten) of an unsolved episode, the rule compares the best rollout
    with the better of two: holding still, and the reward of the step before. It reports the episode if the
    best rollout never gains more per step than 1/500 of the range of all rewards that were seen, although the
    rollouts differ. A task without success never breaks the rule. The rule also reports an episode in which
    progress pays only after the end of a rollout: try a longer `--horizon`.
    """
    yield from _verdict(checkup, "reward-stuck", "compute_dense_reward")


@rule("reward-against", "warn", "compute_dense_reward", solve=True)
def reward_against(checkup: Checkup) -> Iterator[Found | Note]:
    """The reward does not fall on the way to success.

    A policy has to learn against its reward, and most policies turn back.

    ## Why
    Planning looks ahead and goes through a valley of the reward. A policy that learns from its own attempts
    comes to the edge of the valley and turns back.

    ## Fix
    Let the reward of each stage start from the end of the stage before, and keep the terms of earlier stages.

    ```python fragment
    reward = reach
    reward[grasped] = (2.0 + lift)[grasped]  # reach is at most 1: no step down
    ```

    ## How it is checked
    `workbench check --solve` and [`workbench solve`](../jobs/solve.md) plan episodes with the task's own
    reward. The rule reports a task if at least three episodes are solved and, in more than half of these, the
    reward falls on the way by more than a quarter of what it gains from the first step to success.
    """
    yield from _verdict(checkup, "reward-against", "compute_dense_reward")


@rule("success-lost", "warn", "evaluate", solve=True)
def success_lost(checkup: Checkup) -> Iterator[Found | Note]:
    """A solved task stays solved while the planner seeks more reward.

    Success depends on the step at which it is read, and the reward leads away from it.

    ## Why
    Whether an episode counts depends on the step at which success is read. The reward leads away from the
    success, so it pays for something other than what `evaluate` checks.

    ## Fix
    Give success the highest reward, and ask in `evaluate` for a state that lasts.

    ```python fragment
    success = at_goal & self.agent.is_static(0.2)
    reward[info["success"]] = 5.0  # more than anything else pays
    ```

    ## How it is checked
    `workbench check --solve` and [`workbench solve`](../jobs/solve.md) plan episodes with the task's own
    reward. Each episode goes on for five steps after its first success. The rule reports a task if at least
    three episodes are solved and, in more than half of these, success is false at one of the five steps.
    """
    yield from _verdict(checkup, "success-lost", "evaluate")


@rule("failing-pays", "warn", "compute_dense_reward", solve=True)
def failing_pays(checkup: Checkup) -> Iterator[Found | Note]:
    """Failing early does not earn more than going on.

    A policy learns to end the episode as soon as it can.

    ## Why
    If each step costs and a failure ends the episode, the earliest failure is the cheapest episode. A policy
    learns to drop the cube at once.

    ## Fix
    Let a failure cost more than an episode without one can cost, or make the rewards of steps positive.

    ```python fragment
    reward = progress  # not progress - 1
    reward[info["fail"]] = -10.0
    ```

    ## How it is checked
    `workbench check --solve` and [`workbench solve`](../jobs/solve.md) plan episodes with the task's own
    reward. The rule reports a task if there are at least three episodes and more than half of them end by
    `fail` with a mean reward below 0. Rollouts earn nothing after a failure, as in a real episode.
    """
    yield from _verdict(checkup, "failing-pays", "compute_dense_reward")


def _verdict(checkup: Checkup, rule_id: str, hook: str) -> Iterator[Found | Note]:
    episodes = checkup.look(solved_episodes)
    verdict = VERDICTS[rule_id](episodes)
    if verdict is None:
        _require_tried(rule_id, episodes)
        return
    place = checkup.places.hook(hook, "compute_normalized_dense_reward", "evaluate")
    yield Found(f"{verdict.message[0].upper()}{verdict.message[1:]}.", place, len(verdict.seeds))


def solved_episodes(checkup: Checkup) -> PlannedEpisodes:
    """Evidence for `Checkup.look`: episodes of the first seeds. Each ends at its failure, at its time limit, or
    `STEPS_AFTER_SUCCESS` steps after its success.

    Raises:
        NotApplicable, NotKnown: nothing can be planned.
    """
    # Planning needs several envs: each rollout runs in its own.
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
            for seed in checkup.seeds[:MAX_SEEDS]:
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
    for _ in range(live.max_episode_steps or STEPS_WITHOUT_LIMIT):
        with blamed("step", checkup.loaded, rolled):
            action = planner.flat_actions([0])
        log.add_plan(planner.plans[0])
        step = checkup.step(live, action)
        log.add_step(step, 0)
        success, fail = (bool(step.evaluate.get(name, np.zeros(1))[0]) for name in ("success", "fail"))
        after += success or after > 0
        if fail or after > STEPS_AFTER_SUCCESS:
            break
    return log.episode()


def _require_tried(rule_id: str, episodes: PlannedEpisodes) -> None:
    """Raise NotApplicable or NotKnown if the episodes do not show that the rule is kept."""
    entries = {name for one in episodes.all for name in one.evaluate}
    if rule_id in _MIN_SOLVED and "success" not in entries:
        raise NotApplicable("evaluate() has no entry success")
    if rule_id == "failing-pays" and "fail" not in entries:
        raise NotApplicable("evaluate() has no entry fail")
    if len(episodes.all) < MIN_SEEDS:
        raise NotKnown(f"fewer than {MIN_SEEDS} seeds were planned")
    if len(episodes.solved) < _MIN_SOLVED.get(rule_id, 0):
        raise NotKnown(f"planning solved {len(episodes.solved)} of {len(episodes.all)} seeds")
