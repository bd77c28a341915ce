"""What a person does by hand as a state machine: four envs that differ, two robots, and the requests to the worker."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import pytest

from tests.drive.session import DEATH, FakeWorkerSession, fake_worker_session, moment
from workbench.envs.robots import Joint, JointTarget, RobotDescription, RobotKeyframe, RobotLink
from workbench.hands.commands import (
    BeginAgain,
    ChooseMovedEnvs,
    DiscardEpisode,
    DragJoint,
    KeepEpisode,
    SetJoint,
    ToggleDriving,
    ToggleReach,
    UseKeyframe,
    WriteQpos,
)
from workbench.hands.drive_keys import SHARE
from workbench.hands.reach import ArmDragged, Reach, stepped
from workbench.hands.start_edit import PlanStart, RobotQpos
from workbench.hands.state import BodyMoved, BodyPulled, Driven, DrivingDue, Hands, apply
from workbench.live.events import MomentShown, PagesCounted, SettingsChanged, WorkerDied
from workbench.live.messages import (
    MoveBody,
    MoveJoints,
    Play,
    PullBody,
    Reached,
    ReachPose,
    SetSliderAction,
    Status,
)
from workbench.page.command import Command, Refused
from workbench.task.description import ActionDimension, ArmDescription, Restored

ENVS = 4
HERE = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
ROOT = (1.0, 2.0, 3.0, 1.0, 0.0, 0.0, 0.0)
TIP, FAR = "arm/hand", (0.4, 0.2, 0.1, 1.0, 0.0, 0.0, 0.0)
LEFT = RobotDescription(
    "left",
    (Joint("base", False, -1.0, 1.0, 0, JointTarget(3, 2.0, 0.25)), Joint("lift", True, 0.0, 0.5, 2)),
    (RobotLink(0, -1, -1, HERE, HERE),),
    (RobotKeyframe("rest", (0.5, 0.1), None), RobotKeyframe("up", (0.25, 0.2), ROOT)),
)
RIGHT = RobotDescription("right", (Joint("wrist", False, -2.0, 2.0, 1),), (RobotLink(1, -1, -1, HERE, HERE),))
MOVES = tuple(ActionDimension(f"arm/{axis}", -1.0, 1.0) for axis in ("x", "y", "z"))
ACTIONS = (*MOVES, ActionDimension("gripper/finger", -1.0, 1.0, zero_holds=False))
ABSOLUTE = tuple(replace(one, zero_holds=False) for one in ACTIONS)
QPOS = np.arange(3 * ENVS, dtype=np.float32).reshape(ENVS, 3) / 16


@pytest.fixture
def fake(tmp_path: Path) -> Iterator[FakeWorkerSession]:
    """Paused at a moment of four envs; env 2 is selected."""
    with fake_worker_session(tmp_path, num_envs=ENVS) as fake:
        load(fake)
        fake.reset()
        first = moment(np.ones(ENVS, np.int32), number=1)
        fake.tell(replace(first, step=replace(first.step, qpos=QPOS)))
        fake.session.change(selected_env=2, action_source="hold", episode_end="pause")
        fake.asked(object)
        yield fake


def load(fake: FakeWorkerSession, level: str | None = None, **changes: Any) -> None:
    arms = (ArmDescription(TIP, ("base",)),)
    fake.load(level, ENVS, **{"robots": (LEFT, RIGHT), "actions": ACTIONS, "arms": arms, **changes})


def play(fake: FakeWorkerSession) -> None:
    fake.tell(Status(True, 20.0, 1.0))


def hands(fake: FakeWorkerSession) -> Hands:
    return fake.view.of(Hands)


@pytest.mark.parametrize(("all_envs", "envs"), [(False, (2,)), (True, (0, 1, 2, 3))])
def test_a_paused_body_joint_or_keyframe_moves_in_one_request(
    fake: FakeWorkerSession, all_envs: bool, envs: tuple[int, ...]
) -> None:
    session, last = fake.session, fake.view.timeline.last
    session.do(ChooseMovedEnvs(all_envs=all_envs))
    session.do(DragJoint(robot="left", joint=1, to=0.3))
    assert not fake.asked(MoveJoints), "only the page shows it"
    session.do(SetJoint(robot="left", joint=0, to=math.degrees(0.5)))
    session.do(SetJoint(robot="left", joint=0, to=90.0))
    session.do(SetJoint(robot="left", joint=1, to=0.3))
    session.do(UseKeyframe(robot="left", name="up"))
    session.do(UseKeyframe(robot="left", name="rest"))
    asked = fake.asked(MoveJoints)
    assert {(one.robot, one.env_idx, one.origin) for one in asked} == {("left", envs, last)}
    assert [(one.joints, one.positions, one.root) for one in asked] == [
        ((0,), (pytest.approx(0.5),), None),
        ((0,), (1.0,), None),
        ((1,), (0.3,), None),
        ((0, 1), (0.25, 0.2), ROOT),
        ((0, 1), (0.5, 0.1), None),
    ]
    session.dispatch(BodyMoved("cube", envs, FAR))
    assert fake.asked(MoveBody) == [MoveBody("cube", envs, FAR, last)]


def test_what_cannot_be_moved_now_is_refused_and_changes_nothing(fake: FakeWorkerSession) -> None:
    fake.session.do(ToggleReach())
    before, nan = hands(fake), (math.nan,) * 7

    def refuse(*wrong: Any) -> None:
        for one in wrong:
            with pytest.raises(Refused):
                fake.session.do(one) if isinstance(one, Command) else fake.session.dispatch(one)
        assert hands(fake) == before
        assert not fake.asked(MoveJoints | MoveBody | PullBody | ReachPose | SetSliderAction)  # type: ignore[arg-type]

    refuse(
        *(KeepEpisode(), DiscardEpisode(), BeginAgain()),
        SetJoint(robot="left", joint=2, to=0.0),
        SetJoint(robot="middle", joint=0, to=0.0),
        WriteQpos("middle"),
    )
    refuse(
        UseKeyframe(robot="right", name="rest"),
        *(BodyMoved(name, (0,), FAR) for name in ("ground", TIP, "nothing")),
        *(BodyMoved("cube", (0,), pose) for pose in ((math.inf,) * 7, (0.0,) * 7, nan)),
        *(ArmDragged(TIP, 1, pose) for pose in ((0.4, 0.2, 0.1, 0.0, 0.0, 0.0, 0.0), nan)),
        BodyPulled(PullBody("table", 1)),
    )
    fake.session.dispatch(MomentShown(0))
    refuse(
        DragJoint(robot="left", joint=0, to=0.0),
        SetJoint(robot="left", joint=0, to=0.0),
        UseKeyframe(robot="left", name="rest"),
        BodyMoved("cube", (0,), FAR),
        BodyPulled(PullBody("cube")),
    )
    fake.session.dispatch(MomentShown(None))
    play(fake)
    refuse(UseKeyframe(robot="left", name="rest"), BodyMoved("cube", (0,), FAR))
    refuse(SetJoint(robot="right", joint=0, to=0.0), DragJoint(robot="left", joint=1, to=0.1))
    load(fake, "rebuilt", actions=(), robots=(), arms=())
    fake.reset()
    before = hands(fake)
    assert before.reach == Reach(), "there is no arm"
    refuse(ToggleDriving(), ToggleReach(), WriteQpos("left"))
    load(fake, "rebuilt", actions=ABSOLUTE)
    fake.reset()
    refuse(ToggleDriving(), WriteQpos("left"))
    fake.session.dispatch(Driven(("w",), 0.0))
    assert hands(fake) == before, "keys count only for one who drives"


def test_links_are_pulled_where_forces_reach_them(fake: FakeWorkerSession) -> None:
    pull = PullBody(TIP, 2, target=(0.0, 0.0, 1.0))
    fake.session.dispatch(BodyPulled(pull))
    assert fake.asked(PullBody) == [pull]
    load(fake, "rebuilt", backend="gpu")
    fake.reset()
    with pytest.raises(Refused):
        fake.session.dispatch(BodyPulled(pull))
    fake.session.dispatch(BodyPulled(PullBody("cube", 2)))
    assert fake.asked(PullBody) == [PullBody("cube", 2)]


def test_the_joint_positions_of_the_selected_env_and_robot_are_those_to_write(
    fake: FakeWorkerSession, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun: list[Any] = []
    monkeypatch.setattr(
        "workbench.hands.start_jobs.StartJobs.perform", lambda _, effect: begun.append(effect)
    )
    for robot, columns in (("left", [0, 2]), ("right", [1])):
        fake.session.do(WriteQpos(robot))
        assert isinstance(begun[-1], PlanStart)
        assert begun[-1].wanted == RobotQpos(robot, tuple(QPOS[2, columns].tolist()))


def test_a_dragged_joint_is_shown_until_the_env_or_the_page_has_gone_on(fake: FakeWorkerSession) -> None:
    events = [moment(np.full(ENVS, 2, np.int32), number=2), PagesCounted(0), WorkerDied(DEATH, "")]
    run = fake.session.look(lambda run: run)
    for event in events:
        fake.session.do(DragJoint(robot="left", joint=1, to=0.3))
        dragged = hands(fake)
        assert dragged.dragged is not None and dragged.dragged.env_idx == (2,)
        assert apply(dragged, event, run)[0].dragged is None
    assert apply(dragged, SettingsChanged({"speed": 2.0}), run)[0] == dragged


def test_a_slider_drives_its_joint_through_the_action_within_its_bounds(fake: FakeWorkerSession) -> None:
    play(fake)
    for position, value in ((0.5, 0.5), (-0.25, -1.0), (1.0, 1.0), (-1.0, -1.0)):
        fake.session.do(DragJoint(robot="left", joint=0, to=math.degrees(position)))
        (asked,) = fake.asked(SetSliderAction)
        assert (asked.env_idx, asked.dimensions, asked.values) == ((2,), (3,), (pytest.approx(value),))
        assert fake.view.settings.action_source == "sliders" and hands(fake).dragged is None


def test_driving_holds_all_envs_and_gives_back_what_it_took(fake: FakeWorkerSession) -> None:
    for _ in range(2):
        fake.asked(object)
        fake.session.do(ToggleDriving())
        assert fake.asked(SetSliderAction)[0] == SetSliderAction((0, 1, 2, 3), (), ())
        settings = fake.view.settings
        assert (settings.action_source, settings.episode_end) == ("sliders", "continue")
        fake.session.dispatch(Driven(("w", "g"), 0.0))
        assert hands(fake).keys == ("w", "g") and hands(fake).closes
        fake.session.do(ToggleDriving())
        settings = fake.view.settings
        assert (settings.action_source, settings.episode_end) == ("hold", "pause")
        assert not hands(fake).driving and hands(fake).keys == ()
    fake.session.do(ToggleDriving())
    assert not hands(fake).closes, "the gripper is open again"
    fake.asked(object)
    load(fake, "patched")
    assert hands(fake).driving
    load(fake, "rebuilt", actions=ABSOLUTE)
    assert not hands(fake).driving and fake.view.settings.action_source == "hold"


def test_driving_starts_to_play(fake: FakeWorkerSession) -> None:
    fake.session.do(ToggleDriving())
    assert [one.playing for one in fake.asked(Play)] == [True]


def test_an_expired_timer_releases_keys_and_sticks_and_a_stale_timer_does_not(
    fake: FakeWorkerSession,
) -> None:
    run = fake.session.look(lambda run: run)
    for held in (Driven(("w",), 0.0), Driven((), 0.0, (0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0))):
        moves, effects = apply(Hands(driving=True), held, run)
        assert any(sent(effects, SetSliderAction)[0].values)
        late, effects = apply(moves, DrivingDue(moves.number - 1), run)
        assert (late, effects) == (moves, [])
        still, effects = apply(moves, DrivingDue(moves.number), run)
        assert still.keys == still.sticks == () and not any(sent(effects, SetSliderAction)[0].values)
        assert apply(still, DrivingDue(still.number), run) == (still, [])


def sent(effects: list[Any], kind: type) -> list[Any]:
    requests = [getattr(effect, "request", None) for effect in effects]
    return [request for request in requests if isinstance(request, kind)]


def led(*envs: int, why: str = "") -> Reach:
    keys = [(env, TIP) for env in envs]
    answers = {key: Reached(key[0], TIP, "follow", 0.1, 0.0, why) for key in keys}
    return Reach(True, MappingProxyType(dict.fromkeys(keys, FAR)), MappingProxyType(answers))


def test_keys_take_only_the_arms_of_their_env_out_of_the_handles(fake: FakeWorkerSession) -> None:
    run = fake.session.look(lambda run: run)
    driving = Hands(driving=True, reach=led(1, 2))
    for keys, left in ((("g",), {1, 2}), (("w",), {1})):
        after, effects = apply(driving, Driven(keys, 0.0), run)
        assert {env for env, _ in after.reach.targets} == {env for env, _ in after.reach.reached} == left
        assert [one.env for one in sent(effects, ReachPose)] == [2] * (2 not in left)
        (action,) = sent(effects, SetSliderAction)
        moves = [SHARE if keys == ("w",) else 0.0, 0.0, 0.0]
        assert action.env_idx == (2,) and list(action.values[:3]) == moves
    after, effects = apply(driving, SettingsChanged({"action_source": "random"}), run)
    assert not after.driving and not after.reach.targets and after.reach.shown
    assert sorted(one.env for one in sent(effects, ReachPose)) == [1, 2]


def test_a_slider_takes_only_the_arms_of_its_envs_out_of_the_handles(fake: FakeWorkerSession) -> None:
    fake.session.do(ToggleReach())
    play(fake)
    for env in (1, 2):
        fake.session.dispatch(ArmDragged(TIP, env, FAR))
    assert [(one.env, one.how, one.pose) for one in fake.asked(ReachPose)] == [
        (1, "follow", FAR),
        (2, "follow", FAR),
    ]
    fake.session.do(SetJoint(robot="left", joint=0, to=0.0))
    assert {env for env, _ in hands(fake).reach.targets} == {1}
    assert [one.env for one in fake.asked(ReachPose)] == [2]
    fake.session.do(ToggleReach())
    assert hands(fake).reach == Reach() and [one.env for one in fake.asked(ReachPose)] == [1]


def test_a_paused_arm_is_tried_until_the_drag_ends(fake: FakeWorkerSession) -> None:
    fake.session.do(ToggleReach())
    for ends in (False, True):
        fake.session.dispatch(ArmDragged(TIP, 1, FAR, ends))
    asked = fake.asked(ReachPose)
    assert [(one.how, one.origin) for one in asked] == [("try", 1), ("set", 1)] and not hands(fake).driving
    fake.tell(Reached(3, TIP, "try", 0.0, 0.0, ""), Reached(1, TIP, "try", 0.5, 0.0, "far"))
    assert {env: one.metres for (env, _), one in hands(fake).reach.reached.items()} == {1: 0.5}


def test_a_reset_lets_go_of_the_arms_of_its_envs_and_a_short_move_keeps_its_reason() -> None:
    elapsed = np.zeros(ENVS, np.int32)
    after = stepped(led(0, 1, 3, why="too far"), moment(elapsed, (1, 2)))
    assert {env for env, _ in after.targets} == {env for env, _ in after.reached} == {0, 3}
    by_hand = Restored((1,), (1,), 5, None, {}, moved=TIP)
    for why, kept in (("too far", {0, 1, 3}), ("", {0, 3})):
        after = stepped(led(0, 1, 3, why=why), moment(elapsed, (1,), restored=by_hand))
        assert {env for env, _ in after.targets} == {0, 3} and {env for env, _ in after.reached} == kept
    other = replace(by_hand, moved="cube")
    assert {
        env for env, _ in stepped(led(1, why="far"), moment(elapsed, (1,), restored=other)).reached
    } == set()
