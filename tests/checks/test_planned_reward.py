"""Rules on planned episodes: off by default, and not judged where no plan can be made."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.checks.checked import check_rule, the_finding
from tests.checks.given import outcome
from workbench.checks.evidence.collect import Checkup
from workbench.checks.job_items import CheckOptions, count_rules, degrees_of_request
from workbench.checks.results import RuleResult
from workbench.checks.rule_table import SOLVE_RULES, degree_of_each
from workbench.checks.rules.planned_reward import solved_episodes
from workbench.planning.planned_episodes import PlannedEpisode
from workbench.planning.rollouts import Plan
from workbench.planning.verdicts import MIN_EPISODES, MIN_SEEDS, VERDICTS, PlannedEpisodes
from workbench.task.problem import TaskError

TASKS = Path(__file__).parents[2] / "tasks"


def test_planning_rules_are_off_by_default() -> None:
    assert set(VERDICTS) == SOLVE_RULES
    assert {degree_of_each(solve=True)[rule] for rule in SOLVE_RULES} == {"warn"}
    assert degree_of_each(["reward-flat"])["reward-flat"] == "warn"
    assert degree_of_each(ignore=["reward-flat"], solve=True)["reward-flat"] == "off"
    counted = [count_rules(degrees_of_request(CheckOptions("x", solve=solve))) for solve in (False, True)]
    assert counted[1] - counted[0] == len(SOLVE_RULES)
    with pytest.raises(ValueError, match="use --solve"):
        degrees_of_request(CheckOptions("x", actions="solve"))


@pytest.mark.parametrize(
    ("name", "state", "why"),
    [
        ("different_objects", "not_known", "different in each env"),
        ("minimal", "not_applicable", "maximises the reward"),
    ],
)
def test_a_task_that_cannot_be_planned_is_not_judged_with_the_reason(name: str, state: str, why: str) -> None:
    given = {"reward_mode": "none"} if name == "minimal" else {}
    result = check_rule(
        "reward-flat", str(TASKS / f"{name}.py"), num_envs=2, seeds=1, render_backend="none", **given
    )
    assert result.state == state and why in result.why


def planned(
    seed: int, solved_at: int = 0, ends: float = 0.7, failed: bool = False, **entries: float
) -> PlannedEpisode:
    """An episode of 20 steps whose reward rises, to 1 at its success or to `ends`, and whose rollouts differ."""
    steps = np.arange(1, 21)
    reward = (np.minimum(steps / solved_at, 1) if solved_at else ends * steps / 20).astype(np.float32)
    best, fail = reward * 10 + 1, np.zeros(20, bool)
    fail[-1] = failed
    success = (steps >= solved_at) & (solved_at > 0)
    made = PlannedEpisode(seed, 10, reward, success, fail, best, best - 1, best - 2)
    return replace(made, evaluate=entries or {"success": 0.0, "fail": 0.0})


def judged(example: Checkup, rule: str, *episodes: PlannedEpisode) -> RuleResult:
    return outcome(example, rule, look=lambda see: PlannedEpisodes(episodes))


def test_a_verdict_is_a_finding_at_its_hook_with_its_seeds(example: Checkup) -> None:
    solved = [planned(seed, solved_at=15) for seed in range(MIN_SEEDS - 2)]
    held = [replace(planned(seed), reward=np.ones(20, np.float32)) for seed in (20, 21)]
    result = judged(example, "reward-exploited", *solved, *held)
    finding = the_finding(result)
    assert (
        finding.count == 2
        and finding.code.startswith("def compute_dense_reward(")
        and "20" in finding.message
    )
    assert len(result.notes) == 1 and f"{MIN_SEEDS - 2} of {MIN_SEEDS} seeds" in result.notes[0]
    lost = planned(9, solved_at=15)
    lost.success[17] = False
    assert the_finding(judged(example, "success-lost", lost, lost, lost)).code.startswith("def evaluate(")


@pytest.mark.parametrize("rule", sorted(SOLVE_RULES))
def test_a_rule_is_kept_only_if_the_episodes_could_have_broken_it(rule: str, example: Checkup) -> None:
    solved = [planned(seed, solved_at=15) for seed in range(MIN_EPISODES)]
    unsolved = [planned(seed) for seed in range(MIN_SEEDS)]
    enough = [*solved, *unsolved[MIN_EPISODES:]]
    assert judged(example, rule, *enough).state == "kept"
    assert judged(example, rule, *enough[:-1]).state == "not_known"
    about_success = rule in ("reward-exploited", "reward-against", "success-lost")
    assert judged(example, rule, *unsolved).state == ("not_known" if about_success else "kept")
    one = [solved[0], *unsolved[1:]]
    assert judged(example, rule, *one).state == (
        "not_known" if rule in ("reward-against", "success-lost") else "kept"
    )
    plain = [replace(each, evaluate={"height": 1.0}) for each in enough]
    free = "reward-flat"
    assert judged(example, rule, *plain).state == ("kept" if rule == free else "not_applicable")


class Planner:
    """Instead of planning, turns the first joint at full speed; notes from which seeds."""

    horizon = 4

    def __init__(self, env: Any, made_with: dict[str, Any]) -> None:
        self.rollout_env, self.made_with = env, made_with
        self.begun: list[int | None] = []
        self.closed = 0
        Planner.last = self

    def reset(self, seed: int | None = None) -> None:
        self.begun.append(seed)
        self.count = 0

    def require_alike(self, env: int) -> None:
        assert env == 0

    def flat_actions(self, envs: list[int]) -> np.ndarray:
        assert envs == [0]
        self.count += 1
        rewards = np.array([[self.count, 0], [0, 0]], np.float32)
        self.plans = {0: Plan(np.zeros((4, 7), np.float32), rewards, {}, np.zeros(2, np.int32), 1.0)}
        return np.array([[0.5, 0, 0, 0, 0, 0, 1]], np.float32)

    def close(self) -> None:
        self.closed += 1


@pytest.mark.parametrize(("entry", "steps"), [("success", 8), ("fail", 3)])
def test_an_episode_goes_on_a_little_after_its_success_and_ends_at_its_fail(
    entry: str, steps: int, example: Checkup, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("workbench.checks.rules.planned_reward.Planner", Planner)
    cls = example.loaded.cls
    stock = cls.evaluate
    monkeypatch.setattr(cls, "evaluate", lambda env: {**stock(env), entry: env.elapsed_steps >= 3})
    episodes = solved_episodes(example)
    planner = Planner.last
    assert [one.seed for one in episodes.all] == planner.begun == example.seeds and planner.closed == 1
    assert planner.made_with["render_backend"] == "none"
    assert {one.steps for one in episodes.all} == {steps} and {one.horizon for one in episodes.all} == {4}
    assert {getattr(one, f"{'solved' if entry == 'success' else 'failed'}_at") for one in episodes.all} == {3}
    assert all((one.best == np.arange(1, steps + 1)).all() and not one.hold.any() for one in episodes.all)
    assert {round(one.evaluate["cube_to_goal"], 3) for one in episodes.all} == {0.2}
    assert {one.plan_seconds for one in episodes.all} == {steps}
    with pytest.raises(TaskError):
        monkeypatch.setattr(Planner, "flat_actions", lambda planner, envs: 1 / 0)
        solved_episodes(example)
    assert Planner.last.closed == 1 and Planner.last is not planner
