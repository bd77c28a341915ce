"""The moment that is shown, what is asked of the worker for it, and what a going back is told to put."""

# pyright: reportOptionalMemberAccess=false

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.session.moments import N, stepped, table
from workbench.core.camera_data import CameraKind, Picture
from workbench.jobs.task import Restored, Stepped
from workbench.session.history.history import RESET, SUCCESS, WENT_BACK
from workbench.session.live.timeline import Timeline
from workbench.session.protocol.messages import CameraRequest, PastPictures, Pictures

EYE, HAND = CameraRequest("eye", "sensor", ("rgb",)), CameraRequest("hand", "sensor", ("rgb",))
PEOPLE = CameraRequest("eye", "human", ("rgb",))


def moment(number: int, jumped: tuple[int, ...] = (), **more: object) -> Stepped:
    """With poses and actions that tell moments and envs apart."""
    one = stepped(number, jumped, **more)  # type: ignore[arg-type]
    poses = np.arange(N * 4 * 7, dtype=np.float32).reshape(N, 4, 7) + 1000 * number
    action = None if jumped else np.arange(N * 2, dtype=np.float32).reshape(N, 2) + 100 * number
    return replace(one, step=replace(one.step, poses=poses, action=action))


def played(steps: int, limit: int = 10**9, first_serial: int = 0) -> Timeline:
    timeline = Timeline(table(), limit, first_serial)
    timeline.add(moment(0, (0, 1, 2), keys=(1,), new={1: b"part"}))
    for number in range(1, steps + 1):
        timeline.add(moment(number))
    return timeline


def picture(env: int, name: str = "eye", kind: CameraKind = "sensor", depth: bool = False) -> Picture:
    rgb = np.full((4, 6, 3), env, np.uint8)
    seen = np.zeros((4, 6), np.float32) if depth else None
    return Picture(name, kind, env, np.zeros(7, np.float32), rgb, seen)


def test_every_env_is_asked_for_its_own_pictures_of_a_past_moment_and_once() -> None:
    timeline = played(5)
    timeline.seek(2)
    for env in (0, 1, 2, 0):
        asked = timeline.draw(env, (EYE,))
        assert asked is not None and (asked.env, asked.origin) == (env, 2)
        assert np.array_equal(asked.poses, timeline.history.at(2).step.poses[env])
        assert timeline.draw(env, (EYE,)) is None
    other = timeline.draw(0, (EYE, HAND))
    assert other is not None and other.cameras == (EYE, HAND)
    timeline.seek(3)
    assert timeline.draw(0, (EYE, HAND)).origin == 3
    timeline.seek(None)
    assert timeline.draw(0, (EYE,)) is None


def test_a_moment_that_was_drawn_fast_is_drawn_exactly_unless_fast_pictures_are_chosen() -> None:
    timeline = played(3)
    number = timeline.history.at(1).number
    timeline.history.add_pictures(Pictures((replace(picture(1), degree="fast"),), 5.0, number))
    timeline.seek(1)
    assert not timeline.view(1, (EYE,), "fast").wants_pictures and timeline.draw(1, (EYE,), "fast") is None
    assert timeline.view(1, (EYE,)).wants_pictures
    assert list(timeline.pictures(1)) == [("sensor", "eye")], "the fast one is seen meanwhile"
    asked = timeline.draw(1, (EYE,))
    assert asked is not None and (asked.origin, asked.cameras) == (1, (EYE,))
    timeline.history.add_pictures(PastPictures(1, (picture(1),)))
    assert not timeline.view(1, (EYE,)).wants_pictures and timeline.draw(1, (EYE,)) is None


def test_only_what_is_lacking_is_asked_for() -> None:
    timeline = played(3)
    timeline.seek(1)
    timeline.history.add_pictures(PastPictures(1, (picture(1), picture(0, "hand"))))
    assert timeline.draw(1, (EYE,)) is None and not timeline.view(1, (EYE,)).wants_pictures
    assert timeline.view(0, (EYE,)).wants_pictures
    assert timeline.draw(1, (EYE, HAND, PEOPLE)).cameras == (HAND, PEOPLE)
    deeper = EYE._replace(modalities=("rgb", "depth"))
    assert timeline.draw(1, (deeper,)).cameras == (deeper,)
    assert list(timeline.pictures(1)) == [("sensor", "eye")]
    timeline.camera_moved("human", "eye")
    assert timeline.draw(1, (EYE,)) is None
    timeline.camera_moved("sensor", "eye")
    assert timeline.draw(1, (EYE,)).cameras == (EYE,), "it shows what the camera does not see now"


def test_a_camera_that_moves_is_asked_again_at_the_same_moment() -> None:
    timeline = played(2)
    timeline.seek(1)
    assert timeline.draw(0, (EYE,)) is not None and timeline.draw(0, (EYE,)) is None
    timeline.camera_moved("sensor", "eye")
    assert timeline.draw(0, (EYE,)) is not None


def test_a_moment_is_pinned_and_left_for_live() -> None:
    timeline = played(5, first_serial=40)
    assert (timeline.at, timeline.shown) == (45, None)
    timeline.seek_by(0, -2)
    assert timeline.at == 43 and timeline.shown.serial == 43
    timeline.add(moment(6))
    assert timeline.at == 43, "what comes does not move it"
    timeline.seek(0)
    assert timeline.at == 40
    timeline.seek_by(0, 5)
    assert timeline.at == 45 and timeline.shown is not None
    timeline.seek_by(0, 1)
    assert timeline.shown is None and timeline.at == 46
    timeline.seek(46)
    assert timeline.shown is None, "the newest is live"


def test_a_pinned_moment_that_has_to_go_gives_way_to_the_oldest() -> None:
    timeline = played(2, limit=60_000)
    timeline.seek(1)
    for number in range(3, 100):
        timeline.add(moment(number))
    assert timeline.history.first > 1 and timeline.at == timeline.history.first
    assert timeline.shown is not None


def test_the_next_and_the_last_event_of_an_env() -> None:
    timeline = played(1)
    timeline.add(moment(2, success=(1,)))
    timeline.add(moment(3))
    timeline.add(moment(0, (1,)))
    timeline.add(moment(5))
    for env, expected in ((1, [4, 2, 0, 0]), (0, [0, 0])):
        timeline.seek(None)
        seen = []
        for _ in expected:
            timeline.seek_event(env, -1)
            seen.append(timeline.at)
        assert seen == expected
    timeline.seek_event(1, 1)
    assert timeline.at == 2
    timeline.seek_event(1, 1)
    timeline.seek_event(1, 1)
    assert timeline.shown is None


def test_a_step_of_the_episode_is_found_through_resets() -> None:
    timeline = played(3)
    timeline.add(moment(0, (1,)))
    timeline.add(moment(1))
    timeline.add(moment(2))
    timeline.seek_step(1, 1)
    assert timeline.at == 5
    timeline.seek_step(1, 3)
    assert timeline.shown is None
    timeline.seek_step(0, 3)
    assert timeline.at == 3


def test_a_step_back_passes_the_resets_of_other_envs_by() -> None:
    timeline = played(2)
    for env in (0, 2):
        timeline.add(moment(0, (env,)))
    timeline.add(moment(3))
    ways = {}
    for env in range(N):
        timeline.seek(None)
        ways[env] = []
        for _ in range(3):
            timeline.seek_by(env, -1)
            ways[env].append(timeline.at)
    assert ways == {0: [3, 2, 1], 1: [2, 1, 0], 2: [4, 2, 1]}
    timeline.seek_by(1, 2)
    assert timeline.at == 5 - 0 and timeline.shown is None


def test_steps_are_counted_in_one_way_and_a_reset_is_none() -> None:
    timeline = Timeline(table(), 10**9, 7)
    timeline.add(moment(0, (0, 1, 2)))
    view = timeline.view(0, ())
    assert (view.steps, view.steps_ago, view.moments) == (0, 0, 1)
    for number in (1, 2, 3):
        timeline.add(moment(number))
    timeline.add(moment(0, (0, 1, 2)))
    for number in (1, 2):
        timeline.add(moment(number))
    curves = timeline.history.steps.curves(0)
    assert timeline.view(0, ()).steps == curves.serial == 5 and len(timeline.history) == 7
    timeline.seek_tick(4)
    view = timeline.view(0, ())
    assert (view.tick, view.steps_ago) == (4, 1) and timeline.shown.step.elapsed_steps[0] == 1
    strip = timeline.strip(0, view.first_tick, view.last_tick)
    assert (strip.low, strip.high) == (0, 5)
    assert np.isnan(strip.reward[0]) and np.isfinite(strip.reward[1:]).all()
    # At tick 3 is the last step of the first episode and the reset after it; of the second episode it is the reset.
    timeline.seek_tick(3)
    assert timeline.shown.step.elapsed_steps[0] == 3
    timeline.seek(13)
    timeline.seek_tick(3, episode_of=0)
    assert timeline.shown.step.elapsed_steps[0] == 0 and timeline.view(0, ()).steps_ago == 2
    assert [timeline.tick_of(serial) for serial in timeline.episode(0)] == [3, 5]


def test_an_episode_holds_what_was_undone_too() -> None:
    timeline = played(3)
    timeline.add(moment(0, (0, 1, 2)))
    timeline.add(moment(1))
    timeline.add(moment(3, (0, 1, 2), restored=Restored((0, 1, 2), (0, 1, 2), 3, 4, {})))
    assert timeline.episode(0) == (0, 6)


def test_a_reset_that_the_task_asked_for_is_named_so() -> None:
    timeline = played(2)
    over = moment(3)
    timeline.add(replace(over, step=replace(over.step, truncated=np.array([True, False, True]))))
    timeline.add(moment(0, (0, 2)))
    assert timeline.view(0, ()).undo == "reset at the end"
    timeline.add(moment(0, (1,)))
    assert timeline.view(1, ()).undo == "reset of env 1"


def test_in_the_past_the_table_of_envs_is_of_the_past() -> None:
    timeline = played(3)
    timeline.add(moment(0, (1,)))
    timeline.add(moment(1))
    assert timeline.env_rows().steps.tolist() == moment(1).step.elapsed_steps.tolist()
    timeline.seek(2)
    then = timeline.env_rows()
    assert then.steps.tolist() == [2, 2, 2]
    assert [np.isfinite(row).sum() for row in then.rewards] == [2, 2, 2]


def test_a_strip_is_of_one_env_between_two_steps() -> None:
    timeline = played(2)
    timeline.add(moment(3, success=(1,)))
    timeline.add(moment(0, (1,), restored=Restored((1,), (2,), 1, None, {})))
    timeline.add(moment(4))
    whole = timeline.strip(1, -10, 99)
    assert (whole.low, whole.high) == (0, 4)
    assert dict(whole.events) == {0: RESET, 3: SUCCESS | WENT_BACK}
    assert whole.branches == ((3, 1),) and whole.segments == ((0, 3, False), (3, 4, True))
    assert len(whole.reward) == 5
    part = timeline.strip(1, 1, 2)
    assert (part.low, part.high, part.branches) == (1, 2, ()) and part.segments == ((1, 2, False),)
    assert timeline.strip(0, 0, 5).segments == ((0, 4, False),) and timeline.strip(0, 0, 5).branches == ()


@pytest.mark.parametrize(
    ("scope", "envs", "source"),
    [("this", (2,), (2,)), ("all", (0, 1, 2), (0, 1, 2)), ("into all", (0, 1, 2), (2, 2, 2))],
)
def test_who_goes_back_and_to_whose_moment(scope, envs: tuple[int, ...], source: tuple[int, ...]) -> None:
    timeline = played(4)
    assert timeline.continue_from_shown(2, scope) is None, "there is nothing to go back to while live"
    timeline.seek(3)
    asked = timeline.continue_from_shown(2, scope)
    assert asked is not None and (asked.env_idx, asked.source, asked.origin) == (envs, source, 3)
    assert asked.undoes is None and timeline.shown is None
    assert asked.snapshot == timeline.history.snapshot_at(3)
    assert asked.ways.keys() == set(envs) and asked.starts.keys() == {0}
    for env, of in zip(envs, source, strict=True):
        made = [[of * 2 + 100 * step, of * 2 + 1 + 100 * step] for step in (1, 2, 3)]
        assert np.array_equal(asked.ways[env].actions, made), env


def test_a_jump_is_taken_back_in_the_envs_that_it_brought_where_they_are() -> None:
    timeline = played(3)
    assert timeline.undo(0) is None
    timeline.add(moment(0, (0, 1, 2)))
    timeline.add(moment(0, (1,)))
    words = {env: timeline.view(env, ()).undo for env in range(N)}
    assert words == {0: "reset of 2 envs", 1: "reset of env 1", 2: "reset of 2 envs"}
    timeline.seek(2)
    back = timeline.undo(2)
    assert (back.env_idx, back.source, back.origin, back.undoes) == ((0, 2), (0, 2), 3, 4)
    assert timeline.shown is None
    assert timeline.undo(1).origin == 4


def test_what_a_going_back_could_not_put_back_is_told_of_its_env_and_episode_alone() -> None:
    timeline = played(3)
    put = Restored((1,), (1,), 2, None, {"actor ball": "the snapshot has none"}, how="put there")
    timeline.add(moment(2, (1,), restored=put))
    timeline.add(moment(3))
    view = timeline.view(1, ())
    assert view.not_carried == ("actor ball: the snapshot has none",) and view.arrived == "put there"
    assert timeline.view(0, ()).not_carried == () and timeline.view(0, ()).arrived == ""
    timeline.seek(1)
    assert timeline.view(1, ()).not_carried == (), "before it went back"
    timeline.seek(None)
    timeline.add(moment(0, (0,)))
    assert timeline.view(1, ()).not_carried, "another env was reset"
    timeline.add(moment(0, (1,)))
    assert timeline.view(1, ()).not_carried == ()


def test_the_view_is_of_the_moment_that_is_shown() -> None:
    timeline = played(4)
    assert timeline.view(0, (EYE,)).tick == 4 and not timeline.view(0, (EYE,)).wants_pictures
    timeline.seek(1)
    view = timeline.view(0, (EYE,))
    assert (view.first, view.last, view.shown, view.tick, view.moments) == (0, 4, 1, 1, 5)
    assert view.can_continue and view.used == timeline.history.used and view.limit == 10**9
