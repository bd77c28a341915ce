"""Moving and pulling bodies by hand, in a session with a real worker."""

# A session that has a task has a step.
# pyright: reportOptionalMemberAccess=false

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from tests.drive.session import jump, live_session, moment_at, start_over, step
from workbench.app.session import Session
from workbench.hands.state import BodyMoved, BodyPulled
from workbench.live.commands import PauseRun
from workbench.live.events import MomentShown, SlidersMoved
from workbench.live.history.moments import BY_HAND
from workbench.live.messages import PullBody
from workbench.live.timeline_commands import ContinueFromHere, UndoReset

N = 3
AWAY = (0.1, 0.25, 0.3, 1.0, 0.0, 0.0, 0.0)
STILL = (0.0,) * 8


@pytest.fixture(scope="module")
def session(child_process: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Session]:
    with live_session("PickCube-v1", tmp_path_factory.mktemp("recordings"), num_envs=N) as session:
        yield session


def fresh(session: Session) -> int:
    """Pause at the first moment of seed 0's episodes; return the moment's serial."""
    session.do(PauseRun())
    session.change(episode_end="continue", action_source="sliders", selected_env=1)
    session.dispatch(SlidersMoved(tuple(range(8)), STILL))
    return start_over(session, 0).timeline.last


def body(session: Session, name: str) -> np.ndarray:
    """(N, 7) shown poses of a body."""
    view = session.view()
    return view.step.poses[:, view.task.geometry.body_names.index(name)]


def move(session: Session, *env_idx: int) -> None:
    jump(session, lambda: session.dispatch(BodyMoved("cube", env_idx, AWAY)))


def test_a_moved_body_is_at_its_pose_in_these_envs_only_and_falls_from_there(session: Session) -> None:
    fresh(session)
    before = session.view().step.poses
    move(session, 1)
    now, cube = session.view().step.poses, session.view().task.geometry.body_names.index("cube")
    np.testing.assert_allclose(now[1, cube], AWAY, atol=1e-6)
    others = np.ones(now.shape[:2], bool)
    others[1] = False
    np.testing.assert_array_equal(now[others], before[others])
    assert np.isnan(session.view().step.reward[1]), "no action led to this state"
    step(session, 1)
    assert body(session, "cube")[1, 2] < AWAY[2]
    move(session, 0, 2)
    np.testing.assert_allclose(body(session, "cube")[[0, 2]], [AWAY, AWAY], atol=1e-6)


def test_a_move_is_undone_and_is_an_event_of_the_same_episode(session: Session) -> None:
    start = fresh(session)
    step(session, 2)
    before = session.view().step.poses
    move(session, 1)
    moved = session.view().timeline
    assert moved.undo == "move of cube of env 1" and "cube was moved by hand" in moved.arrived
    moment = moment_at(session, moved.last)
    assert moment is not None and moment.event_flags[1] == BY_HAND and not moment.event_flags[[0, 2]].any()
    assert session.view().step.elapsed_steps[1] == 2
    step(session, 1)
    episode = session.look(lambda run: run.past.history.episode(1, run.past.history.last))
    assert episode[0][0].serial == start and len(episode) == 4
    jump(session, lambda: session.do(UndoReset()))
    np.testing.assert_array_equal(session.view().step.poses[1], before[1])


def test_what_happens_after_a_move_is_repeated_to_the_last_bit(session: Session) -> None:
    fresh(session)
    move(session, 1)
    step(session, 4)
    after = session.view().timeline.last
    kept = session.view().step.poses.copy()
    step(session, 3)
    session.dispatch(MomentShown(after))
    jump(session, lambda: session.do(ContinueFromHere()))
    np.testing.assert_array_equal(session.view().step.poses[1], kept[1])


def test_a_spring_lifts_the_body_to_the_pointer_and_lets_go(session: Session) -> None:
    start = fresh(session)
    height = body(session, "cube")[:, 2].copy()
    at = body(session, "cube")[1, :2]
    pull = PullBody("cube", 1, (0.0, 0.0, 0.0), (float(at[0]), float(at[1]), 0.2))
    session.dispatch(BodyPulled(pull))
    step(session, 25)
    raised = body(session, "cube")[:, 2]
    assert 0.15 < raised[1] < 0.2 and np.allclose(raised[[0, 2]], height[[0, 2]], atol=1e-3)
    pulled = session.view().pulled
    assert pulled is not None and (pulled.env, pulled.body) == (1, "cube")
    assert pulled.newtons == pytest.approx(0.064 * 9.81, rel=0.1), "its weight"
    history = session.look(lambda run: run.past.history)
    marks = [flags for _, flags in history.events(1, start, history.last) if flags & BY_HAND]
    assert len(marks) == 1, "one mark for one pull"
    assert history.replay_path(1, history.last, 400) is None, "its actions alone do not lead there"
    assert history.replay_path(0, history.last, 400) is not None
    session.dispatch(BodyPulled(PullBody()))
    step(session, 20)
    assert body(session, "cube")[1, 2] < 0.05 and session.view().pulled is None


def test_a_body_that_is_held_at_a_corner_swings_and_is_not_shaken(session: Session) -> None:
    fresh(session)
    x, y, _ = (float(value) for value in body(session, "cube")[1, :3])
    session.dispatch(BodyPulled(PullBody("cube", 1, (0.02, 0.02, 0.02), (x, y, 0.3))))
    step(session, 20)
    newtons = []
    for _ in range(20):
        step(session)
        newtons.append(session.view().pulled.newtons)
    session.dispatch(BodyPulled(PullBody()))
    assert body(session, "cube")[1, 2] > 0.2 and max(newtons) < 2 * 0.064 * 9.81, "about its weight"


def test_a_body_that_a_hand_throws_is_no_mistake_of_the_task(session: Session) -> None:
    fresh(session)
    session.dispatch(BodyPulled(PullBody("cube", 1, (0.0, 0.0, 0.0), (0.0, 30.0, 10.0))))
    step(session, 3)
    before = body(session, "cube")[1, 1]
    step(session)
    session.dispatch(BodyPulled(PullBody()))
    step(session)
    assert body(session, "cube")[1, 1] - before > 1.0, "faster than 20 m/s"
    assert not session.view().odd and not session.view().env_table.outliers


def test_a_link_is_pulled_with_the_weight_of_its_arm(session: Session) -> None:
    fresh(session)
    hand = "panda/panda_hand"
    before = body(session, hand)[:, :3].copy()
    x, y, z = (float(value) for value in before[1])
    session.dispatch(BodyPulled(PullBody(hand, 1, (0.0, 0.0, 0.0), (x, y, z + 0.3))))
    step(session, 10)
    session.dispatch(BodyPulled(PullBody()))
    raised = body(session, hand)[:, 2] - before[:, 2]
    assert raised[1] > 0.1 and abs(raised[0]) < 0.02
