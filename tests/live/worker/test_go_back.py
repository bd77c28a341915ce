"""Going back to a moment: replayed to the last byte, or restored where the replay differs."""

# pyright: reportOptionalMemberAccess=false, reportOptionalSubscript=false

from __future__ import annotations

import pickle
from collections.abc import Iterator
from itertools import count
from typing import Any

import numpy as np
import pytest
import torch

from workbench.envs import action_vector as actions
from workbench.envs.snapshots.snapshot import Snapshot
from workbench.live.messages import ReplayPath, Restore
from workbench.live.worker import go_back
from workbench.task.description import TaskOptions
from workbench.task.load import load_task
from workbench.task.open import OpenedTask, Opening, build_task
from workbench.task.problem import Interrupted, TaskError

N = 3
T = 12
LATER = [0, 100, 200]


class EnvMoment:
    """A humanoid's fall, moment by moment."""

    def __init__(self, opened: OpenedTask) -> None:
        self.opened, self.told = opened, []
        task, rng = opened.env, np.random.default_rng(0)
        task.reset(2)
        # As if each episode had started at a different time.
        opened.env.env._elapsed_steps += torch.tensor(LATER)
        self.snapshots: list[Snapshot] = [task.snapshot()]
        self.actions: list[np.ndarray] = []
        self.packs: list[list[bytes]] = [self.packed()]
        for _ in range(2 * T):
            self.step(actions.random_action(task.parts, N, rng))
            self.snapshots.append(task.snapshot())

    def packed(self) -> list[bytes]:
        scene: Any = self.opened.env.env.scene
        return list(scene.px.packs())

    def step(self, action: np.ndarray) -> None:
        self.opened.env.step(action)
        self.actions.append(action)
        self.packs.append(self.packed())

    def back(
        self, moment: int, begins: dict[int, int], source: dict[int, int] | None = None
    ) -> go_back.Restored:
        """Go back to `moment`; `begins` has the start of each env's replay."""
        source = source or {i: i for i in begins}
        ways = {
            i: ReplayPath(at, source[i], np.stack([a[source[i]] for a in self.actions[at:moment]]))
            for i, at in begins.items()
        }
        starts = {at: pickle.dumps(self.snapshots[at]) for at in set(begins.values())}
        request = Restore(
            pickle.dumps(self.snapshots[moment]),
            tuple(begins),
            tuple(source.values()),
            moment,
            None,
            ways,
            starts,
        )
        self.told.clear()
        return go_back.go_back(self.opened, request, lambda *done: self.told.append(done))[1]


@pytest.fixture(scope="module")
def lived() -> Iterator[EnvMoment]:
    options = TaskOptions(num_envs=N, env_kwargs={"obs_mode": "state", "render_backend": "none"})
    opened = build_task(
        load_task("MS-HumanoidStand-v1"), options, Opening(on_finding=lambda finding: None, begins_anew=True)
    )
    yield EnvMoment(opened)
    opened.env.close()


@pytest.mark.thorough
def test_a_humanoid_repeats_its_run_to_the_last_byte(lived: EnvMoment) -> None:
    did = lived.back(T, dict.fromkeys(range(N), 0))
    assert did.replayed == tuple(range(N)) and not did.not_carried
    assert lived.told == [(done, T) for done in range(1, T + 1)]
    assert lived.opened.env.env.elapsed_steps.tolist() == [T + later for later in LATER]
    for after in range(T, 2 * T):
        assert lived.packed() == lived.packs[after]
        lived.opened.env.step(lived.actions[after])
    assert lived.packed() == lived.packs[2 * T]


def test_one_env_goes_back_alone_or_as_another_env_without_affecting_the_others(lived: EnvMoment) -> None:
    before = lived.packed()
    did = lived.back(T, {1: 0}, {1: 2})
    assert did.replayed == (1,)
    now = lived.packed()
    assert now[1] == lived.packs[T][2] and lived.opened.env.env.elapsed_steps[1] == T + LATER[2]
    assert [now[0], now[2]] == [before[0], before[2]]


def test_replays_of_different_lengths_end_together(lived: EnvMoment) -> None:
    """Moment T, once restored, is an exact state: the run from there differs, and is repeatable."""
    go_back.go_back(
        lived.opened, Restore(pickle.dumps(lived.snapshots[T]), (0,), (0,), T), lambda *done: None
    )
    middle = lived.opened.env.snapshot()
    assert lived.back(T, {1: 0, 2: 0}).replayed == (1, 2)
    for after in range(T, T + 3):
        lived.opened.env.step(lived.actions[after])
    wanted, end = lived.packed(), lived.opened.env.snapshot()
    ways = {
        0: ReplayPath(100, 0, np.stack([a[0] for a in lived.actions[T : T + 3]])),
        1: ReplayPath(0, 1, np.stack([a[1] for a in lived.actions[: T + 3]])),
        2: ReplayPath(0, 2, np.stack([a[2] for a in lived.actions[: T + 3]])),
    }
    starts = {100: pickle.dumps(middle), 0: pickle.dumps(lived.snapshots[0])}
    every = tuple(range(N))
    request = Restore(pickle.dumps(end), every, every, 0, None, ways, starts)
    _, did = go_back.go_back(lived.opened, request, lambda *done: None)
    assert did.replayed == every and lived.packed() == wanted


def test_the_moment_is_restored_where_the_replay_differs(lived: EnvMoment) -> None:
    kept = lived.actions[3]
    lived.actions[3] = kept * np.array([[1.0], [0.5], [1.0]], np.float32)  # as an edited hook would
    try:
        did = lived.back(T, dict.fromkeys(range(N), 0))
    finally:
        lived.actions[3] = kept
    assert did.replayed == (0, 2)
    wanted, now = lived.packs[T], lived.packed()
    assert [now[0], now[2]] == [wanted[0], wanted[2]]
    np.testing.assert_allclose(
        np.frombuffer(now[1], np.float32), np.frombuffer(wanted[1], np.float32), atol=1e-6
    )


def test_an_interrupt_ends_a_replay_and_another_failure_does_not(
    lived: EnvMoment, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails_in_the_fifth_step(error: BaseException) -> None:
        steps = count(1)

        def hook() -> None:
            if next(steps) == 5:
                raise error

        monkeypatch.setattr(lived.opened.env.env, "_after_control_step", hook)

    fails_in_the_fifth_step(KeyError("edited"))
    did = lived.back(T, dict.fromkeys(range(N), 0))
    assert did.replayed == () and len(lived.told) == 4
    assert lived.opened.env.env.elapsed_steps.tolist() == [T + later for later in LATER], (
        "the moment was restored"
    )
    fails_in_the_fifth_step(Interrupted("stopped by the user"))
    with pytest.raises(TaskError) as ended:
        lived.back(T, dict.fromkeys(range(N), 0))
    assert isinstance(ended.value.__cause__, Interrupted) and len(lived.told) == 4
    monkeypatch.undo()
    assert lived.back(T, dict.fromkeys(range(N), 0)).replayed == tuple(range(N)), "the next replay is exact"


def test_a_replay_that_takes_too_long_is_given_up(lived: EnvMoment, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(go_back, "MAX_REPLAY_SECONDS", 0.0)
    did = lived.back(T, dict.fromkeys(range(N), 0))
    assert did.replayed == () and did.how == "" and len(lived.told) == 1
    np.testing.assert_allclose(
        np.frombuffer(b"".join(lived.packed()), np.float32),
        np.frombuffer(b"".join(lived.packs[T]), np.float32),
        atol=1e-6,
    )
