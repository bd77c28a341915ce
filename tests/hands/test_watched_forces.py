"""Contact forces between two bodies that a person watches."""

# A session that has a task has a step.
# pyright: reportOptionalMemberAccess=false, reportOptionalSubscript=false, reportArgumentType=false

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from tests.drive.envs import batched, stock
from tests.drive.session import FakeWorkerSession, live_session, start_over, step, wait_until
from workbench.app.session import Session
from workbench.envs.contact_forces import pair_forces
from workbench.hands.commands import WatchForce
from workbench.hands.state import BodyMoved
from workbench.live.commands import ChoosePauseEntry, ChoosePauseTest, PlayRun, SetPauseLevel
from workbench.live.history.curves import columns_of, force_column
from workbench.page.command import Refused

N = 3
CUBE, TABLE = "cube", "table-workspace"
PAIR = (CUBE, TABLE)
FORCE = force_column(*PAIR)


def test_the_force_of_a_pair_is_that_of_maniskills_call_in_each_env() -> None:
    ours, theirs = batched("PickCube-v1", N), stock("PickCube-v1")
    ours.reset(seed=5)
    assert np.isnan(pair_forces(ours, [PAIR], np.zeros(N, bool))[PAIR]).all(), (
        "the contacts are those of another state"
    )
    theirs.reset(seed=5)
    action = np.zeros((N, 8), np.float32)
    for _ in range(4):
        ours.step(action)
        theirs.step(action[0])
    newtons = pair_forces(ours, [PAIR, (CUBE, "panda/panda_hand"), (CUBE, "gone")], np.ones(N, bool))
    assert (
        newtons.keys() == {PAIR, (CUBE, "panda/panda_hand")} and not newtons[CUBE, "panda/panda_hand"].any()
    )
    for env in (ours, theirs):
        actors = env.scene.actors
        expected = env.scene.get_pairwise_contact_forces(actors[CUBE], actors[TABLE]).norm(dim=1).numpy()
        assert (expected > 0.1).all()
        np.testing.assert_allclose(newtons[PAIR][: len(expected)], expected, rtol=1e-3)
    ours.close()
    theirs.close()


@pytest.fixture(scope="module")
def session(child_process: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Session]:
    with live_session("PickCube-v1", tmp_path_factory.mktemp("recordings"), num_envs=N) as session:
        yield session


def test_a_watched_force_has_a_curve_and_pauses_the_run_at_the_first_contact(session: Session) -> None:
    session.change(episode_end="continue", action_source="hold", selected_env=1)
    start_over(session, 0)
    session.do(WatchForce(body=TABLE, other=CUBE, on=True))
    assert session.view().settings.watched_forces == (PAIR,)
    cube = session.view().task.geometry.body_names.index(CUBE)
    resting = columns_of(step(session, 2).step)[FORCE]
    assert (resting > 0.1).all()
    session.dispatch(BodyMoved(CUBE, (1,), (0.1, 0.2, 0.4, 1.0, 0.0, 0.0, 0.0)))
    view = wait_until(session, lambda v: v.step.poses[1, cube, 2] > 0.3, "the move")
    assert np.isnan(columns_of(view.step)[FORCE]).all(), "contacts after a move are not known"
    falling = columns_of(step(session, 1).step)[FORCE]
    assert falling[1] == 0 and falling[0] == pytest.approx(resting[0], rel=0.1)
    for command in (
        ChoosePauseEntry(entry=FORCE.label),
        ChoosePauseTest(test="rises above"),
        SetPauseLevel(level=0.1),
        PlayRun(),
    ):
        session.do(command)
    view = wait_until(session, lambda v: v.paused_at is not None and not v.playing, "the first contact")
    assert columns_of(view.step)[FORCE][1] > 0.1 and view.step.elapsed_steps[1] > 4
    session.do(WatchForce(body=CUBE, other=TABLE, on=False))
    assert FORCE not in columns_of(step(session, 1).step)


def test_a_watched_pair_has_two_bodies_of_the_scene(fake: FakeWorkerSession) -> None:
    fake.load()
    assert fake.view.task is not None
    names = fake.view.task.geometry.body_names
    for body, other in ((names[0], names[0]), (names[0], "gone")):
        with pytest.raises(Refused):
            fake.session.do(WatchForce(body=body, other=other, on=True))
    assert fake.view.settings.watched_forces == ()
