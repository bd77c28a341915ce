"""The comparison of record and judgement, against one that is worked out plainly, env by env and step by step."""

from __future__ import annotations

import gc
import threading
import weakref
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.session.moments import table
from workbench.core.capture.recorded_run import pose_distances
from workbench.core.env.step_result import StepResult
from workbench.jobs.task import Stepped, TaskOptions
from workbench.session.history.history import History
from workbench.session.process.askers import Background
from workbench.session.protocol.messages import Load
from workbench.session.rescore.background import StoppedBy
from workbench.session.rescore.past import PastRescorer, RescoredPast

BODIES = 2


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


def recorded(steps: list[StepResult], jumped: np.ndarray, snapshots: list[bytes] | None = None) -> History:
    history = History(table(steps[0]), 10**9)
    for row, step in enumerate(steps):
        body = b"body" if snapshots is None else snapshots[row]
        keys, parts = ((1,), {1: b"part"}) if row == 0 else (None, {})
        history.add(Stepped(step, jumped[row], (), None, body, keys, parts, row))
    return history


def drawn(seed: int, rows: int, envs: int) -> tuple[list[StepResult], list[StepResult], np.ndarray]:
    """A record, what is said of it now, and its jumps."""
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


@settings(max_examples=60)
@given(st.integers(0, 10**6), st.integers(2, 30), st.integers(1, 4), st.floats(0, 1))
def test_differences_are_those_that_plain_loops_find(seed: int, rows: int, envs: int, part: float) -> None:
    old, new, jumped = drawn(seed, rows, envs)
    rescored = RescoredPast(recorded(old, jumped))
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
                looked_at(old, new, inside, others, env, parted),
            )
    found = {
        (v.of.env, int(v.of.serials[0])): (
            v.success,
            v.returns,
            v.length,
            v.first_difference,
            None if v.look_at is None else v.of.at(v.look_at),
        )
        for v in rescored.verdicts()
    }
    assert found == wanted
    names = set()
    if any(v.differs for v in rescored.verdicts()):
        names = {name for v in rescored.verdicts() for name in v.differing}
        assert names & {"reward", "success"}
    assert rescored.names()[1] == names


def looked_at(
    old: list[StepResult],
    new: list[StepResult],
    inside: list[int],
    others: list[int],
    env: int,
    parted: list[int],
) -> int | None:
    """The moment that shows most: success, else the largest change of the reward, else the first difference."""
    then, now = (next((r for r in inside if side[r].evaluate["success"][env]), None) for side in (old, new))
    if then != now:
        return then if now is None else now
    if others:
        return max(others, key=lambda r: (abs(old[r].reward[env] - new[r].reward[env]), -r))
    return min(parted, default=None)


def test_the_run_in_sight_is_judged_first_then_the_newest_and_each_begins_with_a_jump_of_all() -> None:
    old, _, _ = drawn(0, 9, 2)
    jumped = np.zeros((9, 2), bool)
    jumped[[0, 6]] = True
    jumped[3, 1] = True
    rescored = RescoredPast(recorded(old, jumped))
    assert rescored.runs() == [range(6, 9), range(6)]
    assert RescoredPast(recorded(old, jumped), seen=4).runs() == [range(6), range(6, 9)]
    jump = rescored.moment_to_rescore(3)
    assert jump.snapshot is not None and jump.env_idx == (1,) and jump.action is None
    assert rescored.moment_to_rescore(4).snapshot is None
    assert rescored.steps == 6


def test_the_record_ends_at_a_jump_that_cannot_be_put_back() -> None:
    old, _, _ = drawn(2, 6, 2)
    jumped = np.zeros((6, 2), bool)
    jumped[[0, 4]] = True
    assert RescoredPast(recorded(old, jumped, [b"b"] * 4 + [b""] * 2)).runs() == [range(4)]
    assert RescoredPast(recorded(old, jumped, [b""] * 6)).steps == 0


def test_a_moment_that_is_judged_anew_is_compared_anew_and_not_a_number_is_a_difference() -> None:
    old, _, _ = drawn(3, 5, 2)
    jumped = np.zeros((5, 2), bool)
    jumped[0] = True
    rescored = RescoredPast(recorded(old, jumped))
    for row in range(5):
        rescored.add(row, old[row])
    assert [verdict.differing for verdict in rescored.verdicts()] == [(), ()]
    assert rescored.names() == (("reward", "success", "height"), frozenset())
    rescored.add(3, replace(old[3], reward=np.array([np.nan, old[3].reward[1]], np.float32)))
    first, second = rescored.verdicts()
    assert rescored.verdicts()[0] is first, "what nothing was added to is not compared again"
    assert first.of.env == 0 and first.differing == ("reward",) and np.isinf(first.largest)
    assert first.look_at is not None and first.of.at(first.look_at) == 3
    assert second.of.name == "env 1" and not second.differs
    assert rescored.names() == (("reward", "success", "height"), frozenset({"reward"}))


def test_an_entry_that_is_called_reward_is_told_apart_from_the_reward() -> None:
    old, _, _ = drawn(3, 5, 2)
    jumped = np.zeros((5, 2), bool)
    jumped[0] = True
    said = [replace(step, evaluate={"reward": np.full(2, 7.0)}) for step in old]
    rescored = RescoredPast(recorded(said, jumped))
    for row in range(5):
        rescored.add(row, replace(said[row], evaluate={"reward": np.full(2, 8.0)}))
    assert rescored.names() == (("reward", "evaluate/reward"), frozenset({"evaluate/reward"}))
    for env, verdict in enumerate(rescored.verdicts()):
        np.testing.assert_array_equal(verdict.old_reward, [step.reward[env] for step in old[1:]])
        np.testing.assert_array_equal(verdict.new_reward, verdict.old_reward)
        assert verdict.differing == verdict.others == ("evaluate/reward",) and not verdict.differs
    curve = rescored.curve("reward", 0)
    assert curve is not None and curve.new.tolist() == [step.reward[0] for step in old[1:]]


def test_a_judgement_that_is_stopped_before_its_turn_keeps_nothing_of_the_past() -> None:
    """The one before it hangs where it is told of: what waits behind it is never begun."""
    begun, goes_on = threading.Event(), threading.Event()

    def on_change() -> None:
        if threading.current_thread().name == "rescore":
            begun.set()
            goes_on.wait(30)

    process = Background()
    rescore = PastRescorer(on_change, process)
    old, _, jumped = drawn(1, 6, 2)
    load = Load("Nothing-v1", TaskOptions())
    try:
        rescore.rescore(load, RescoredPast(recorded(old, jumped)))
        assert begun.wait(30)
        history = recorded(old, jumped)
        moment = weakref.ref(history.at(0))
        rescore.rescore(load, RescoredPast(history))
        del history
        gc.collect()
        assert moment() is not None
        rescore.stop(StoppedBy.HAND)
        gc.collect()
        assert moment() is None and rescore.curve("reward", 0) is not None
    finally:
        goes_on.set()
        rescore.rescoring.close()
        process.end()


def test_an_entry_that_only_one_version_has_differs_and_comes_first() -> None:
    old, _, jumped = drawn(3, 5, 2)
    rescored = RescoredPast(recorded(old, jumped))
    assert rescored.names() == (("reward", "success", "height"), frozenset())
    for row in rescored.runs()[0]:
        rescored.add(row, replace(old[row], evaluate={**old[row].evaluate, "width": old[row].reward}))
    assert rescored.names() == (("reward", "width", "success", "height"), frozenset({"width"}))
    assert not any(verdict.differing for verdict in rescored.verdicts())
    curve = rescored.curve("width", 1)
    assert curve is not None and np.isnan(curve.old).all() and np.isfinite(curve.new).all()


def test_drift_is_that_of_each_env_in_its_own_run() -> None:
    old, _, _ = drawn(1, 6, 2)
    jumped = np.zeros((6, 2), bool)
    jumped[0] = True
    rescored = RescoredPast(recorded(old, jumped))
    for row in range(6):
        poses = old[row].poses.copy()
        poses[1, 0, 0] += 0.1 * (row == 3)
        poses[1, 1, 3:] = (np.cos(0.1), np.sin(0.1), 0, 0)
        rescored.add(row, replace(old[row], poses=poses))
    still, moved = rescored.verdicts()
    assert (still.metres, still.radians, still.drift_at) == (0, 0, None)
    assert moved.metres == pytest.approx(0.1) and moved.radians == pytest.approx(0.2, rel=1e-5)
    assert moved.drift_at == 3


def test_what_is_not_judged_yet_has_no_new_value() -> None:
    old, new, _ = drawn(4, 5, 2)
    jumped = np.zeros((5, 2), bool)
    jumped[0] = True
    rescored = RescoredPast(recorded(old, jumped))
    for row in range(3):
        rescored.add(row, new[row])
    curve = rescored.curve("height", 1)
    assert curve is not None and curve.serial.tolist() == [1, 2, 3, 4]
    np.testing.assert_array_equal(curve.old, [step.reward[1] + 1 for step in old[1:]])
    np.testing.assert_array_equal(curve.new, [new[1].reward[1] + 1, new[2].reward[1] + 1, np.nan, np.nan])
    assert rescored.curve("pose", 0) is None
    assert rescored.curve("reward", 2) is None and rescored.curve("reward", -1) is None


def test_drift_is_the_furthest_body_in_metres_and_radians() -> None:
    was = np.zeros((3, 2, 7), np.float32)
    was[..., 3] = 1
    now = was.copy()
    now[0, 1, :3] = (0.03, 0.04, 0)
    angle = 1e-4  # below what an arc cosine tells in single precision
    now[1, 0, 3:] = (-np.cos(angle / 2), -np.sin(angle / 2), 0, 0)
    was[2, 0] = now[2, 0] = np.nan  # a body that this env does not have
    metres, radians = pose_distances(now, was)
    np.testing.assert_allclose(metres, [[0, 0.05], [0, 0], [0, 0]], rtol=1e-6)
    np.testing.assert_allclose(radians, [[0, 0], [angle, 0], [0, 0]], rtol=1e-2)
    now[2, 1, 0] = np.nan
    assert np.isinf(pose_distances(now, was)).sum() == 2
    was[2, 1] = np.nan
    assert not np.isinf(pose_distances(now, was)).any()
