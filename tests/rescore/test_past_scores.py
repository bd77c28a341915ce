"""The comparison of recorded and new scores, checked against plain loops over envs and steps."""

from __future__ import annotations

import asyncio
import gc
import weakref
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.drive.session import FakeWorkerSession, fake_worker_session, history_of
from workbench.envs.step_result import StepResult
from workbench.live.history.moments import History
from workbench.live.messages import Load
from workbench.live.process.ask import Background
from workbench.live.process.background_jobs import Job
from workbench.machine import loop
from workbench.rescore.past_jobs import PastRescorer
from workbench.rescore.past_scores import RescoredPast
from workbench.rescore.state import BeginRescoring, EndRescoring, RescoreView
from workbench.task.description import Stepped, TaskOptions

BODIES = 4


def a_step(reward: np.ndarray, success: np.ndarray, elapsed: np.ndarray) -> StepResult:
    count = len(reward)
    poses = np.zeros((count, BODIES, 7), np.float32)
    poses[..., 3] = 1
    return StepResult(
        elapsed.astype(np.int32),
        reward.astype(np.float32),
        success.astype(bool),
        np.zeros(count, bool),
        {"success": success.astype(bool), "height": reward.astype(np.float64) + 1, "pose": poses},
        poses,
    )


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[FakeWorkerSession]:
    with fake_worker_session(tmp_path_factory.mktemp("recordings")) as fake:
        yield fake


def recorded(
    fake: FakeWorkerSession, steps: list[StepResult], jumped: np.ndarray, snapshots: list[bytes] | None = None
) -> History:
    """The history of a session whose worker has sent these steps."""
    fake.load("rebuilt", num_envs=len(steps[0].reward))
    for row, step in enumerate(steps):
        body = b"body" if snapshots is None else snapshots[row]
        keys, parts = ((1,), {1: b"part"}) if row == 0 else (None, {})
        action = None if jumped[row].any() else np.zeros((len(step.reward), 2), np.float32)
        fake.tell(Stepped(replace(step, action=action), jumped[row], (), None, body, keys, parts, row))
    return history_of(fake.session)


def random_record(seed: int, rows: int, envs: int) -> tuple[list[StepResult], list[StepResult], np.ndarray]:
    """Random recorded steps, rescored steps, and jumps (rows, envs)."""
    rng = np.random.default_rng(seed)
    jumped = np.zeros((rows, envs), bool)
    jumped[0] = True
    for row in range(1, rows):
        if rng.random() < 0.3:
            jumped[row] = rng.random(envs) < rng.choice([0.4, 1.0])
    elapsed = np.zeros(envs, int)
    old, new = [], []
    for row in range(rows):
        is_step = not jumped[row].any()
        elapsed = np.where(jumped[row], 0, elapsed + is_step)
        values = [np.where(is_step, rng.integers(0, 3, envs), 0) for _ in range(2)]
        flags = [rng.random(envs) < 0.2 for _ in range(2)]
        old.append(a_step(values[0], flags[0], elapsed))
        new.append(a_step(values[1], flags[1], elapsed))
    return old, new, jumped


@settings(max_examples=40)
@given(seed=st.integers(0, 10**6), rows=st.integers(2, 30), envs=st.integers(1, 4), part=st.floats(0, 1))
def test_differences_equal_those_found_by_plain_loops(
    shared: FakeWorkerSession, seed: int, rows: int, envs: int, part: float
) -> None:
    old, new, jumped = random_record(seed, rows, envs)
    history = recorded(shared, old, jumped)
    rescored = RescoredPast(history)
    chosen = [row for run in rescored.runs() for row in run][: max(1, int(part * rows))]
    for row in chosen:
        rescored.add(row, new[row])

    wanted = {}
    for env in range(envs):
        begins = [row for row in range(rows) if jumped[row, env]]
        for begin, end in zip(begins, [*begins[1:], rows], strict=True):
            inside = [r for r in range(begin, end) if r in chosen and (r == begin or not jumped[r].any())]
            steps = [r for r in inside if not jumped[r].any()]
            if not steps:
                continue
            success = tuple(
                next(
                    (int(side[r].elapsed_steps[env]) for r in inside if side[r].evaluate["success"][env]),
                    None,
                )
                for side in (old, new)
            )
            flags = [[bool(side[r].evaluate["success"][env]) for r in inside] for side in (old, new)]
            others = [r for r in steps if old[r].reward[env] != new[r].reward[env]]
            parted = others + [r for r, a, b in zip(inside, *flags, strict=True) if a != b]
            wanted[env, begin] = (
                success,
                tuple(float(sum(side[r].reward[env] for r in steps)) for side in (old, new)),
                len(steps),
                int(old[min(parted)].elapsed_steps[env]) if parted else None,
                expected_moment(old, new, inside, others, env, parted),
            )
    found = {
        (v.of.env, int(v.of.serials[0]) - history.first): (
            v.success,
            v.returns,
            v.length,
            v.first_difference,
            None if v.look_at is None else v.of.at(v.look_at) - history.first,
        )
        for v in rescored.verdicts()
    }
    assert found == wanted
    names = set()
    if any(v.differs for v in rescored.verdicts()):
        names = {name for v in rescored.verdicts() for name in v.differing}
        assert names & {"reward", "success"}
    assert rescored.names()[1] == names


def expected_moment(
    old: list[StepResult],
    new: list[StepResult],
    inside: list[int],
    others: list[int],
    env: int,
    parted: list[int],
) -> int | None:
    """The most telling moment: a changed success, else the largest change of the reward, else the first difference."""
    then, now = (next((r for r in inside if side[r].evaluate["success"][env]), None) for side in (old, new))
    if then != now:
        return then if now is None else now
    if others:
        return max(others, key=lambda r: (abs(old[r].reward[env] - new[r].reward[env]), -r))
    return min(parted, default=None)


def test_the_record_ends_at_a_jump_that_cannot_be_restored(shared: FakeWorkerSession) -> None:
    old, _, _ = random_record(2, 6, 2)
    jumped = np.zeros((6, 2), bool)
    jumped[[0, 4]] = True
    assert RescoredPast(recorded(shared, old, jumped, [b"b"] * 4 + [b""] * 2)).runs() == [range(4)]
    assert RescoredPast(recorded(shared, old, jumped, [b""] * 6)).steps == 0


def test_a_moment_scored_again_is_compared_again_and_nan_is_a_difference(shared: FakeWorkerSession) -> None:
    old, _, _ = random_record(3, 5, 2)
    jumped = np.zeros((5, 2), bool)
    jumped[0] = True
    history = recorded(shared, old, jumped)
    rescored = RescoredPast(history)
    for row in range(5):
        rescored.add(row, old[row])
    assert [verdict.differing for verdict in rescored.verdicts()] == [(), ()]
    assert rescored.names() == (("reward", "success", "height"), frozenset())
    rescored.add(3, replace(old[3], reward=np.array([np.nan, old[3].reward[1]], np.float32)))
    first, second = rescored.verdicts()
    assert rescored.verdicts()[0] is first, "a run without new moments is not compared again"
    assert first.of.env == 0 and first.differing == ("reward",) and np.isinf(first.largest)
    assert first.look_at is not None and first.of.at(first.look_at) - history.first == 3
    assert second.of.name == "env 1" and not second.differs
    assert rescored.names() == (("reward", "success", "height"), frozenset({"reward"}))


def test_a_rescoring_stopped_before_it_starts_keeps_no_reference_to_the_past(
    shared: FakeWorkerSession,
) -> None:
    process = Background()
    rescorer = PastRescorer(process, lambda event: None)
    old, _, jumped = random_record(1, 6, 2)
    goes_on = loop.do(asyncio.Event)

    async def other_job() -> None:
        await goes_on.wait()

    loop.do(lambda: loop.begin(process.in_turns(Job("another one"), other_job)))
    try:
        history = recorded(shared, old, jumped)
        moment = weakref.ref(history.at(history.first))
        rescored = RescoredPast(history)
        begin = BeginRescoring(1, RescoreView(), Load("Nothing-v1", TaskOptions()), rescored)
        loop.do(lambda: rescorer.perform(begin))
        del history
        shared.load("rebuilt")  # the session drops the old history
        gc.collect()
        assert moment() is not None
        loop.do(lambda: rescorer.perform(EndRescoring()))
        loop.do(gc.collect)
        assert moment() is None and rescored.curve("reward", 0) is not None
    finally:
        loop.do(goes_on.set)
        rescorer.close()
        process.close()


def test_an_entry_that_only_one_version_has_differs_and_comes_first(shared: FakeWorkerSession) -> None:
    old, _, jumped = random_record(3, 5, 2)
    rescored = RescoredPast(recorded(shared, old, jumped))
    assert rescored.names() == (("reward", "success", "height"), frozenset())
    for row in rescored.runs()[0]:
        rescored.add(row, replace(old[row], evaluate={**old[row].evaluate, "width": old[row].reward}))
    assert rescored.names() == (("reward", "width", "success", "height"), frozenset({"width"}))
    assert not any(verdict.differing for verdict in rescored.verdicts())
    curve = rescored.curve("width", 1)
    assert curve is not None and np.isnan(curve.old).all() and np.isfinite(curve.new).all()


def test_drift_is_measured_per_env_and_run(shared: FakeWorkerSession) -> None:
    old, _, _ = random_record(1, 6, 2)
    jumped = np.zeros((6, 2), bool)
    jumped[0] = True
    rescored = RescoredPast(recorded(shared, old, jumped))
    for row in range(6):
        poses = old[row].poses.copy()
        poses[1, 0, 0] += 0.1 * (row == 3)
        poses[1, 1, 3:] = (np.cos(0.1), np.sin(0.1), 0, 0)
        rescored.add(row, replace(old[row], poses=poses))
    still, moved = rescored.verdicts()
    assert (still.metres, still.radians, still.drift_at) == (0, 0, None)
    assert moved.metres == pytest.approx(0.1) and moved.radians == pytest.approx(0.2, rel=1e-5)
    assert moved.drift_at == 3
