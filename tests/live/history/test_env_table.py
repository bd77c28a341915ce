"""The table of envs against a simple reference implementation for one env."""

# The views are of a session whose task is loaded: what may be None before is not here.
# pyright: reportOptionalMemberAccess=false

from __future__ import annotations

from collections.abc import Iterator
from copy import deepcopy
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.drive.session import FakeWorkerSession, fake_worker_session, moment
from workbench.envs.outliers import OutlierKind
from workbench.live.events import MomentShown
from workbench.live.history.env_table import KEPT_REWARDS, Outcome
from workbench.live.history.moments import FAIL, SUCCESS
from workbench.task.description import Pulled

N = 3


@dataclass
class Episode:
    """One env's episode, tracked in the simplest way."""

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
        self.total += reward if self.end < 0 else 0
        self.see(entries)
        if self.end < 0 and (entries["success"] or entries["fail"] or limit):
            self.end = self.steps
            ended = Outcome.FAIL if entries["fail"] else Outcome.TRUNCATED
            self.outcome = Outcome.SUCCESS if entries["success"] else ended


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


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[FakeWorkerSession]:
    with fake_worker_session(tmp_path_factory.mktemp("recordings")) as fake:
        yield fake


def entries_in_event(entries: list[dict[str, bool]]) -> dict[str, Any]:
    """`evaluate` entries in a worker's event."""
    values = {name: np.array([entry[name] for entry in entries]) for name in entries[0]}
    found: dict[str, Any] = {"evaluate": {**values, "distance": np.zeros(N, np.float32)}}
    return found | {name: tuple(np.flatnonzero(values[name])) for name in ("success", "fail")}


@settings(max_examples=40)
@given(events=st.lists(event, max_size=25))
def test_rows_equal_the_reference_for_each_env_and_in_the_past(
    shared: FakeWorkerSession, events: list[tuple]
) -> None:
    session = shared.session
    shared.load("rebuilt")
    shared.reset()
    base, tick = session.view().timeline.last, 0
    episodes = [Episode() for _ in range(N)]
    last: list[Episode | None] = [None] * N
    seen = [deepcopy((episodes, last))]
    ended, succeeded, failed = [0] * N, [0] * N, [0] * N
    flags: list[dict[int, int]] = [{} for _ in range(N)]
    for kind, first, entries, limits in events:
        if kind == "back":
            envs = tuple(np.flatnonzero(first).tolist())
            origin, who = entries % len(seen), limits
            then, last_then = deepcopy(seen[origin])
            for env in envs:
                if episodes[env].end >= 0:
                    last[env] = episodes[env]
                episodes[env] = deepcopy(then[env if who is None else who])
                if who is None or who == env:
                    last[env] = last_then[env]
            shared.back(envs, envs if who is None else (who,) * len(envs), base + origin)
        elif kind == "reset":
            for env in np.flatnonzero(first):
                if episodes[env].end >= 0:
                    last[env] = episodes[env]
                episodes[env] = Episode()
                episodes[env].see(entries[env])
            shared.reset(np.flatnonzero(first).tolist(), **entries_in_event(entries))
        else:
            tick += 1
            for env, episode in enumerate(episodes):
                running = episode.end < 0
                episode.step(first[env], entries[env], limits[env])
                if running and episode.end >= 0:
                    ended[env] += 1
                    succeeded[env] += episode.outcome == Outcome.SUCCESS
                    failed[env] += episode.outcome == Outcome.FAIL
                for name, flag in (("success", SUCCESS), ("fail", FAIL)):
                    ends = running and episode.end >= 0 and episode.outcome == Outcome.FAIL and flag == FAIL
                    if episode.first.get(name) == episode.steps or ends:
                        flags[env][tick] = flags[env].get(tick, 0) | flag
            shared.step(reward=first, truncated=tuple(np.flatnonzero(limits)), **entries_in_event(entries))
        seen.append(deepcopy((episodes, last)))

    assert session.view().timeline.last_tick == tick
    for env in range(N):
        session.change(selected_env=env)
        found = {
            at: what & (SUCCESS | FAIL) for at, what in session.look(lambda run: run.strip(0, 10**6)).events
        }
        assert {at: what for at, what in found.items() if what} == flags[env]
    for place in (None, base + len(seen) // 2):  # now, and as it was
        session.dispatch(MomentShown(place))
        at = session.view().step_serial - base
        now, before = seen[at]
        rows = session.env_rows()
        assert rows.steps.tolist() == [e.steps for e in now]
        assert rows.outcome.tolist() == [e.outcome for e in now]
        assert rows.end.tolist() == [e.end for e in now]
        assert rows.total.tolist() == [e.total for e in now]
        assert "distance" not in rows.first_true
        for name, steps in rows.first_true.items():
            assert steps.tolist() == [e.first.get(name, -1) for e in now]
        for env, episode in enumerate(now):
            kept = rows.rewards[env]
            assert kept[np.isfinite(kept)].tolist() == episode.rewards[-KEPT_REWARDS:]
        assert rows.last.steps.tolist() == [-1 if e is None else e.end for e in before]
        assert rows.last.outcome.tolist() == [0 if e is None else e.outcome for e in before]
        assert rows.last.total.tolist() == [0 if e is None else e.total for e in before]
        if place is None:
            assert (rows.ended.tolist(), rows.succeeded.tolist()) == (ended, succeeded)
            assert rows.failed.tolist() == failed
    session.dispatch(MomentShown(None))


def test_an_env_restored_from_an_unknown_moment_has_no_return(
    played: FakeWorkerSession,
) -> None:
    played.back((0,), (0,), -7)
    rows = played.session.env_rows()
    assert (
        np.isnan(rows.total[0])
        and rows.total[1:].tolist() == [6, 6]
        and rows.followed.tolist() == [False, True, True]
    )
    played.reset((0,))
    played.step()
    rows = played.session.env_rows()
    assert rows.total.tolist() == [1, 10, 10] and rows.followed.all(), "a reset makes it known again"


def test_a_worker_that_resumes_at_the_same_moment_starts_no_episode(played: FakeWorkerSession) -> None:
    taken = played.session.env_rows()
    before = np.copy(taken.total), np.copy(taken.rewards)
    played.resume()
    played.step()
    rows = played.session.env_rows()
    assert (
        rows.total.tolist() == [10] * N and rows.followed.all() and np.isfinite(rows.rewards).sum() == 4 * N
    )
    np.testing.assert_array_equal(before[0], taken.total, "rows that were taken do not change")
    np.testing.assert_array_equal(before[1], taken.rewards)


def test_after_going_back_in_a_long_episode_its_newest_rewards_are_kept(fake: FakeWorkerSession) -> None:
    fake.play(KEPT_REWARDS + 50)
    assert fake.session.env_rows().rewards[1].tolist() == [*range(51, KEPT_REWARDS + 51)]
    fake.back((0,), (0,), 119)
    fake.step()
    assert fake.session.env_rows().rewards[0].tolist() == [*range(21, 121)]


def test_a_numeric_success_counts_and_other_numbers_do_not(fake: FakeWorkerSession) -> None:
    fake.play(0)
    numbers = {
        "success": np.array([[0.0], [1.0], [0.0]]),
        "distance": np.ones(N),
        "each": np.ones((N, 2), bool),
    }
    fake.step(success=(1,), evaluate=numbers)
    rows = fake.session.env_rows()
    assert rows.first_true["success"].tolist() == [-1, 1, -1] and not {"distance", "each"} & {*rows.first}
    assert rows.outcome.tolist() == [Outcome.RUNNING, Outcome.SUCCESS, Outcome.RUNNING]


def test_a_task_without_a_reward_has_no_returns(fake: FakeWorkerSession) -> None:
    fake.load(reward_mode="none")
    fake.reset()
    for reset in (False, True):
        if reset:
            fake.reset((1,))
        fake.step(reward=(1, 2, 3))
        rows = fake.session.env_rows()
        assert not rows.followed.any() and np.isnan(rows.rewards).all()


def test_a_body_that_a_person_pulls_is_not_too_fast(fake: FakeWorkerSession) -> None:
    def step(x: float, env: int, **more: Any) -> None:
        event = moment(np.full(N, fake.view.timeline.last_tick + 1), number=fake.view.timeline.last, **more)
        poses = event.step.poses.copy()
        poses[env, 3, 0] += x
        fake.tell(replace(event, step=replace(event.step, poses=poses)))

    fake.play(0)
    step(0.0, 1)
    step(100.0, 1, pulled=Pulled(1, "cube", 3.0))
    step(100.0, 2)
    found = {env: [one.kind for one in seen] for env, seen in fake.session.env_rows().outliers.items()}
    assert found == {2: [OutlierKind.FAST]}


# --- outliers -------------------------------------------------------------------------------------------


def outlier_steps(fake: FakeWorkerSession) -> dict[int, list[int]]:
    return {env: [o.step for o in seen] for env, seen in fake.session.env_rows().outliers.items()}


def test_an_env_takes_over_the_outliers_of_the_moment_it_goes_back_to_and_a_left_episode_keeps_its_own(
    fake: FakeWorkerSession,
) -> None:
    def lost(*envs: int) -> list[float]:
        return [np.nan if env in envs else 1.0 for env in range(N)]

    fake.play(1)
    for _ in range(2):
        fake.step(reward=lost(1))  # moments 2 and 3
    # Env 0 continues from env 1's second step, env 1 from its own first, which has no outlier.
    fake.back((0, 1), (1, 1), 2)
    assert outlier_steps(fake) == {0: [2], 1: [2]}, "once"
    fake.back((1,), (1,), 1)
    assert outlier_steps(fake) == {0: [2]}
    fake.step(reward=lost(0, 1))
    assert outlier_steps(fake) == {0: [2], 1: [2]}, "once for env 0, and again for env 1"
    fake.reset((0, 1))
    rows = fake.session.env_rows()
    assert rows.outliers == {} and {
        env: [o.step for o in seen] for env, seen in rows.last.outliers.items()
    } == {0: [2], 1: [2]}
    assert rows.last.outcome.tolist() == [Outcome.RUNNING] * N and rows.ended.tolist() == [0] * N
    fake.step(reward=lost())
    fake.reset((0,))
    assert [*fake.session.env_rows().last.outliers] == [0, 1], "a left episode without outliers is not listed"


def test_a_disabled_rule_flags_no_env_and_an_enabled_one_is_a_finding(fake: FakeWorkerSession) -> None:
    rules = rules_of(fake)
    fake.load("rebuilt", outlier_rules={"reward-finite": rules["reward-finite"]})
    fake.reset()
    for _ in range(2):
        fake.step(reward=(0, np.nan, np.nan))
    outliers = fake.session.env_rows().outliers
    assert {env: [o.kind for o in seen] for env, seen in outliers.items()} == {
        1: [OutlierKind.REWARD_NOT_FINITE],
        2: [OutlierKind.REWARD_NOT_FINITE],
    }
    (found,) = fake.view.odd
    assert (found.rule, found.count, found.first_step) == ("reward-finite", 4, 0)
    assert "env 1" in found.message and "step 1" in found.message
    fake.load("patched", source_hash="b", outlier_rules={})
    assert fake.view.odd == () and len(fake.session.env_rows().outliers) == 2


def rules_of(fake: FakeWorkerSession) -> dict[str, Any]:
    fake.load()
    return dict(fake.view.task.outlier_rules)
