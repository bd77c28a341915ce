"""The table of envs against a plain reference that follows one env at a time."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.ui.scenes import OUTLIER_FINDINGS, step_of, table_scene
from workbench.core.capture.outliers import OutlierKind
from workbench.core.env.step_result import StepResult
from workbench.jobs.task import Restored, Stepped
from workbench.session.history.env_table import KEPT_REWARDS, EnvRows, EnvTable, Outcome
from workbench.session.history.history import FAIL, SUCCESS, History

N = 3


@dataclass
class Episode:
    """One env's episode, as one would follow it by hand."""

    steps: int = 0
    rewards: list[float] = field(default_factory=list)
    total: float = 0.0
    outcome: Outcome = Outcome.RUNNING
    end: int = -1
    first: dict[str, int] = field(default_factory=dict)

    def see(self, entries: dict[str, bool]) -> None:
        for name, value in entries.items():
            if value and name not in self.first:
                self.first[name] = self.steps

    def step(self, reward: float, entries: dict[str, bool], limit: bool) -> None:
        self.steps += 1
        self.rewards.append(reward)
        if self.end < 0:
            self.total += reward
        self.see(entries)
        if self.end < 0 and (entries["success"] or entries["fail"] or limit):
            self.end = self.steps
            self.outcome = (
                Outcome.SUCCESS
                if entries["success"]
                else Outcome.FAIL
                if entries["fail"]
                else Outcome.TRUNCATED
            )


def result(
    steps: list[int], rewards: list[float], entries: list[dict[str, bool]], limits: list[bool]
) -> StepResult:
    _, poses = table_scene(N)
    values = {name: np.array([entry[name] for entry in entries]) for name in entries[0]}
    return StepResult(
        elapsed_steps=np.array(steps, np.int32),
        reward=np.array(rewards, np.float32),
        terminated=values["success"] | values["fail"],
        truncated=np.array(limits),
        evaluate={**values, "distance": np.zeros(N, np.float32)},
        poses=poses,
    )


def past() -> History:
    """Of a scene that was just built: it keeps the table."""
    geometry, poses = table_scene(N)
    first = step_of(poses, success=np.zeros(N, bool), fail=np.zeros(N, bool))
    first = replace(first, elapsed_steps=np.zeros(N, np.int32))
    return History(EnvTable(geometry, first, 0.05, "dense", OUTLIER_FINDINGS), 10**9)


NO = {"success": False, "fail": False, "near": False}
entry = st.fixed_dictionaries({"success": st.booleans(), "fail": st.booleans(), "near": st.booleans()})
each = lambda strategy: st.lists(strategy, min_size=N, max_size=N)  # noqa: E731
event = st.one_of(
    st.tuples(st.just("step"), each(st.integers(-5, 5)), each(entry), each(st.booleans())),
    st.tuples(st.just("reset"), each(st.booleans()).filter(any), each(entry), st.none()),
    st.tuples(
        st.just("back"),
        each(st.booleans()).filter(any),
        st.integers(0, 40),
        st.none() | st.integers(0, N - 1),
    ),
)


@settings(max_examples=60)
@given(st.lists(event, max_size=40))
def test_rows_are_what_following_each_env_by_itself_and_back_in_time_gives(events: list[tuple]) -> None:
    history = past()
    begin = result([0] * N, [0] * N, [NO] * N, [False] * N)
    history.add(Stepped(begin, np.ones(N, bool)))
    episodes = [Episode() for _ in range(N)]
    last: list[Episode | None] = [None] * N
    seen = [deepcopy((episodes, last))]
    ended, succeeded, ticks = [0] * N, [0] * N, 0
    for kind, first, entries, limits in events:
        restored = None
        if kind == "back":
            origin, who = entries % len(seen), limits
            for env in np.flatnonzero(first).tolist():
                if episodes[env].end >= 0:
                    last[env] = episodes[env]
                then, last_then = deepcopy(seen[origin])
                episodes[env] = then[env if who is None else who]
                if who is None or who == env:
                    last[env] = last_then[env]
            mask, envs = np.array(first), tuple(np.flatnonzero(first).tolist())
            restored = Restored(envs, envs if who is None else (who,) * len(envs), origin, None, {})
            step = result([e.steps for e in episodes], [0] * N, [NO] * N, [False] * N)
        elif kind == "reset":
            for env in range(N):
                if first[env]:
                    if episodes[env].end >= 0:
                        last[env] = episodes[env]
                    episodes[env] = Episode()
                    episodes[env].see(entries[env])
            mask = np.array(first)
            step = result([e.steps for e in episodes], [0] * N, entries, [False] * N)
        else:
            ticks += 1
            for env, episode in enumerate(episodes):
                running = episode.end < 0
                episode.step(first[env], entries[env], limits[env])
                if running and episode.end >= 0:
                    ended[env] += 1
                    succeeded[env] += episode.outcome == Outcome.SUCCESS
            mask = np.zeros(N, bool)
            step = result([e.steps for e in episodes], first, entries, limits)
        moment = history.add(Stepped(step, mask, restored=restored))
        for name, flag in (("success", SUCCESS), ("fail", FAIL)):
            now = [kind == "step" and e.first.get(name) == e.steps for e in episodes]
            assert ((moment.event_flags & flag) > 0).tolist() == now
        seen.append(deepcopy((episodes, last)))

    rows = history.env_rows()
    assert history.steps.count == ticks
    assert rows.steps.tolist() == [e.steps for e in episodes]
    assert rows.outcome.tolist() == [e.outcome for e in episodes]
    assert rows.end.tolist() == [e.end for e in episodes]
    assert rows.total.tolist() == [e.total for e in episodes]
    assert (rows.ended.tolist(), rows.succeeded.tolist()) == (ended, succeeded)
    assert "distance" not in rows.first_true
    for name, steps in rows.first_true.items():
        assert steps.tolist() == [e.first.get(name, -1) for e in episodes]
    for env, episode in enumerate(episodes):
        kept = rows.rewards[env]
        assert kept[np.isfinite(kept)].tolist() == episode.rewards[-KEPT_REWARDS:]
        episode_backwards = [
            (m.serial, int(m.step.elapsed_steps[of]))
            for m, of in history.episode_backwards(env, history.last)
        ]
        assert [step for _, step in episode_backwards] == list(range(episode.steps, -1, -1))
    assert rows.last.steps.tolist() == [-1 if e is None else e.end for e in last]
    assert rows.last.outcome.tolist() == [0 if e is None else e.outcome for e in last]
    assert rows.last.total.tolist() == [0 if e is None else e.total for e in last]


def test_only_the_newest_rewards_of_a_long_episode_are_kept() -> None:
    history = past()
    for step in range(1, KEPT_REWARDS + 31):
        history.add(Stepped(result([step] * N, [step, 0, 0], [NO] * N, [False] * N), np.zeros(N, bool)))
    assert history.env_rows().rewards[0].tolist() == list(range(31, KEPT_REWARDS + 31))


@pytest.mark.parametrize("said", [True, False], ids=["said to be a reset", "only seen in the steps"])
def test_an_env_that_was_put_back_nobody_knows_where_from_does_not_claim_to_know_its_return(
    said: bool,
) -> None:
    history = past()
    for step in (1, 2, 3):
        history.add(Stepped(result([step] * N, [1] * N, [NO] * N, [False] * N), np.zeros(N, bool)))
    back = result([1, 3, 3], [0] * N, [NO] * N, [False] * N)
    mask = np.array([True, False, False]) if said else np.array([False, False, False])
    history.add(Stepped(back if said else result([1, 4, 4], [1] * N, [NO] * N, [False] * N), mask))
    rows = history.env_rows()
    assert np.isnan(rows.total[0]) and rows.steps[0] == 1
    assert rows.total[1:].tolist() == ([3, 3] if said else [4, 4])


def test_rows_that_were_taken_do_not_change_with_later_steps() -> None:
    history = past()
    rows = history.env_rows()
    taken = [np.copy(values) for values in (rows.steps, rows.total, rows.rewards, rows.end)]
    history.add(
        Stepped(result([1] * N, [1] * N, [{**NO, "success": True}] * N, [False] * N), np.zeros(N, bool))
    )
    for before, after in zip(taken, (rows.steps, rows.total, rows.rewards, rows.end), strict=True):
        np.testing.assert_array_equal(before, after)


def test_a_worker_that_comes_back_at_the_same_moment_begins_no_episode() -> None:
    history = past()
    for step in (1, 2, 3):
        history.add(Stepped(result([step] * N, [1] * N, [NO] * N, [False] * N), np.zeros(N, bool)))
    again = Stepped(result([3] * N, [1] * N, [NO] * N, [False] * N), np.ones(N, bool), resumed=True)
    history.add(again)
    rows = history.env_rows()
    assert rows.total.tolist() == [3] * N and rows.followed.all()
    assert np.nanmax(rows.rewards) == 1 and np.isfinite(rows.rewards).sum() == 3 * N
    history.add(replace(again, resumed=False))
    assert np.isnan(history.env_rows().total).all(), (
        "what was reset to a moment was not followed from its start"
    )


def odd(steps: list[int], envs: tuple[int, ...]) -> StepResult:
    """A step in which the cube of these envs is thrown, and lies where it lay in the others."""
    step = result(steps, [1] * N, [NO] * N, [False] * N)
    poses = step.poses.copy()
    poses[list(envs), 3, 0] += 100.0 * np.array(steps)[list(envs)]
    return StepResult(**{**step.__dict__, "poses": poses})


def followed(*steps: tuple[StepResult, tuple[int, ...], Restored | None]) -> History:
    """What was told of these: result, envs that jumped, and where to."""
    history = past()
    first = Stepped(result([0] * N, [0] * N, [NO] * N, [False] * N), np.ones(N, bool))
    for one in (first, *(told(*step) for step in steps)):
        history.add(one)
    return history


def told(step: StepResult, jumped: tuple[int, ...], restored: Restored | None) -> Stepped:
    mask = np.zeros(N, bool)
    mask[list(jumped)] = True
    if not jumped:
        step = StepResult(**{**step.__dict__, "action": np.zeros((N, 2), np.float32)})
    return Stepped(step, mask, restored=restored)


def outlier_steps(history: History) -> dict[int, list[int]]:
    return {env: [o.step for o in seen] for env, seen in history.env_rows().outliers.items()}


def test_a_body_that_a_reset_puts_elsewhere_has_not_moved() -> None:
    geometry, poses = table_scene(2)
    table = History(EnvTable(geometry, step_of(poses), 0.05, "dense", OUTLIER_FINDINGS), 10**9)
    there = poses.copy()
    there[0, 3, 0] += 100.0
    moved = replace(step_of(there), elapsed_steps=np.array([0, 7], np.int32))
    table.add(Stepped(moved, np.array([True, False])))
    table.add(Stepped(replace(moved, elapsed_steps=np.array([1, 8], np.int32)), np.zeros(2, bool)))
    assert not table.env_rows().outliers
    back = replace(step_of(poses), elapsed_steps=np.array([2, 9], np.int32))
    table.add(Stepped(back, np.zeros(2, bool)))
    assert [o.kind for o in table.env_rows().outliers[0]] == [OutlierKind.FAST]


def test_a_rule_that_is_off_flags_no_env_and_one_that_is_on_is_a_finding() -> None:
    only = {"reward-finite": OUTLIER_FINDINGS["reward-finite"]}
    geometry, poses = table_scene(3)
    table = EnvTable(geometry, step_of(poses), 0.05, "dense", only)
    far, lost = poses.copy(), np.array([0, np.nan, np.nan], np.float32)
    far[0, 3, 0] += 100.0
    history = History(table, 10**9)
    for number in (1, 2):
        steps = np.full(3, number, np.int32)
        history.add(Stepped(replace(step_of(far), reward=lost, elapsed_steps=steps), np.zeros(3, bool)))
    assert {env: [o.kind.rule for o in seen] for env, seen in history.env_rows().outliers.items()} == {
        1: ["reward-finite"],
        2: ["reward-finite"],
    }
    (finding,) = history.findings
    assert (finding.rule, finding.count, finding.first_step) == ("reward-finite", 4, 0)
    assert finding.message == "the reward is NaN, in env 1 at step 1 of its episode"
    history.begin_version({})
    assert history.findings == () and len(history.env_rows().outliers) == 2


def test_what_was_odd_goes_with_the_moment_that_an_env_is_put_to() -> None:
    history = followed(
        (odd([1, 1, 1], ()), (), None),
        (odd([2, 2, 2], (1,)), (), None),
        (odd([3, 3, 3], (1,)), (), None),
        # Env 0 goes on from env 1's second step, env 1 from its own first, which was well.
        (odd([2, 1, 3], (0,)), (0, 1), Restored((0, 1), (1, 1), 2, None, {})),
    )
    assert outlier_steps(history) == {0: [2], 1: [2]}
    put = Restored((1,), (1,), 1, None, {})
    back = told(odd([2, 1, 3], (0,)), (1,), put)
    history.add(back)
    assert outlier_steps(history) == {0: [2]}
    more = told(odd([3, 2, 4], (0, 1)), (), None)
    history.add(more)
    assert outlier_steps(history) == {0: [2], 1: [2]}, "once for env 0, and anew for env 1"
    assert history.env_rows().total.tolist() == [3, 2, 4]


def test_an_episode_that_was_odd_and_is_left_while_it_runs_is_the_last_one_with_its_steps() -> None:
    history = followed(
        (odd([1, 1, 1], ()), (), None),
        (odd([2, 2, 2], (1,)), (), None),
        (odd([3, 3, 3], (1,)), (), None),
        (odd([0, 0, 3], ()), (0, 1), None),
    )
    rows = history.env_rows()
    assert rows.last.steps.tolist() == [-1, 3, -1] and rows.last.total.tolist() == [0, 3, 0]
    assert rows.last.outcome.tolist() == [Outcome.RUNNING] * N
    assert list(rows.last.outliers) == [1] and rows.outliers == {}
    assert rows.ended.tolist() == [0] * N


def test_the_episode_before_stays_an_envs_own_whoevers_moment_it_is_put_to() -> None:
    history = followed(
        (odd([1, 1, 1], (0, 1)), (), None),
        (odd([0, 0, 1], ()), (0, 1), None),
        (odd([1, 1, 2], (0,)), (), None),
        (odd([0, 1, 2], ()), (0,), None),
        (odd([1, 1, 2], ()), (0, 1), Restored((0, 1), (0, 0), 3, None, {})),
    )
    rows = history.env_rows()
    assert rows.last.steps.tolist() == [1, 1, -1]
    assert {env: [o.step for o in seen] for env, seen in rows.last.outliers.items()} == {0: [1], 1: [1]}
    assert outlier_steps(history) == {0: [1], 1: [1]}


def test_the_rewards_of_a_long_episode_that_was_gone_back_in_are_its_newest() -> None:
    history = past()
    steps = [result([k] * N, [k, 0, 0], [NO] * N, [False] * N) for k in range(1, KEPT_REWARDS + 51)]
    for step in steps:
        history.add(told(step, (), None))
    history.add(told(steps[118], (0,), Restored((0,), (0,), 118, None, {})))
    history.add(told(steps[119], (), None))
    assert history.env_rows().rewards[0].tolist() == [*range(21, 120), 120]


def test_a_success_that_is_no_bool_counts_and_other_numbers_do_not() -> None:
    history = past()
    step = result([1] * N, [0] * N, [NO] * N, [False] * N)
    values = {
        "success": np.array([[0.0], [1.0], [0.0]]),
        "distance": np.ones(N),
        "each": np.ones((N, 2), bool),
    }
    moment = history.add(
        told(replace(step, evaluate=values, terminated=values["success"][:, 0] > 0), (), None)
    )
    rows = history.env_rows()
    assert rows.first_true["success"].tolist() == [-1, 1, -1] and not {"distance", "each"} & {*rows.first}
    assert (moment.event_flags & SUCCESS > 0).tolist() == [False, True, False]
    assert rows.outcome.tolist() == [Outcome.RUNNING, Outcome.SUCCESS, Outcome.RUNNING]


def test_outcomes_are_places_in_an_array_of_what_the_page_sorts_by() -> None:
    assert [int(outcome) for outcome in Outcome] == [0, 1, 2, 3]
    assert EnvRows.bytes_a_step(10) - EnvRows.bytes_a_step(9) == 8, "what a step adds is one array of returns"
