"""The shown moment, the requests to the worker for it, and the requests of a jump back."""

# The views are of a session whose task is loaded: what may be None before is not here.
# pyright: reportOptionalMemberAccess=false

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.drive.session import FakeWorkerSession, camera, draw_past, fake_worker_session, seek, seek_by
from tests.drive.waiting import until
from workbench.envs.camera_data import CameraKind, Picture
from workbench.live.commands import PlayRun, ResetAll, Step
from workbench.live.events import EnvEventShown, EpisodeStepShown, MomentShown, PagesCounted
from workbench.live.history.moments import RESET, SUCCESS, TRUNCATED, WENT_BACK
from workbench.live.messages import CameraRequest, DrawPast, PastPictures, Pictures, Placed, Restore
from workbench.live.past import Strip
from workbench.live.run import Run
from workbench.live.timeline_commands import ContinueFromHere, NextEvent, PreviousEvent, Seek, UndoReset
from workbench.page.command import Refused

EYE, HAND = CameraRequest("base_camera", "sensor", ("rgb",)), CameraRequest("hand", "sensor", ("rgb",))
PEOPLE = CameraRequest("base_camera", "human", ("rgb",))


def picture(env: int, name: str = "base_camera", kind: CameraKind = "sensor", **more: Any) -> Picture:
    return Picture(name, kind, env, np.zeros(7, np.float32), np.full((4, 6, 3), env, np.uint8), **more)


def drawn(fake: FakeWorkerSession, env: int, *cameras: CameraRequest, degree: str = "auto") -> list[DrawPast]:
    """The requests when the page shows this env and wants pictures of the shown moment."""
    fake.session.change(selected_env=env, cameras=cameras, pictures=degree)
    fake.asked(object)
    draw_past(fake.session)
    return fake.asked(DrawPast)


def at(fake: FakeWorkerSession) -> int:
    """Serial of the shown moment."""
    return fake.view.step_serial


def test_pictures_of_a_past_moment_are_requested_once_per_env(played: FakeWorkerSession) -> None:
    played.session.dispatch(MomentShown(2))
    for env in (0, 1, 2, 0):
        (asked,) = drawn(played, env, EYE)
        assert (asked.env, asked.origin) == (env, 2)
        np.testing.assert_array_equal(asked.poses, played.view.step.poses[env])
        assert drawn(played, env, EYE) == []
    assert [one.cameras for one in drawn(played, 0, EYE, HAND)] == [(EYE, HAND)]
    played.session.dispatch(MomentShown(1))
    assert [one.origin for one in drawn(played, 0, EYE, HAND)] == [1]
    played.session.dispatch(MomentShown(None))
    assert drawn(played, 0, EYE) == []


def test_a_moment_gets_pictures_when_the_slider_rests_and_none_during_a_drag(
    played: FakeWorkerSession,
) -> None:
    played.session.dispatch(PagesCounted(1))
    played.session.change(cameras=(EYE,))
    played.asked(object)
    seek(played.session, 1)
    seek(played.session, 2)
    (asked,) = until(lambda: played.asked(DrawPast), "the pictures")
    assert asked.origin == 2
    seek(played.session, 1)
    seek(played.session, None)
    seek(played.session, 2)
    seek(played.session, 0)
    (asked,) = until(lambda: played.asked(DrawPast), "the pictures of where it stands at last")
    assert asked.origin == 0


def test_only_missing_or_outdated_pictures_are_requested(played: FakeWorkerSession) -> None:
    played.session.dispatch(MomentShown(1))
    played.tell(PastPictures(1, (picture(1), picture(0, "hand"))))
    assert drawn(played, 1, EYE) == [] and not played.view.timeline.wants_pictures
    assert list(played.view.pictures) == [EYE.key]
    assert drawn(played, 0, EYE) and played.view.timeline.wants_pictures
    assert [one.cameras for one in drawn(played, 1, EYE, HAND, PEOPLE)] == [(HAND, PEOPLE)]
    deeper = EYE._replace(modalities=("rgb", "depth"))
    assert [one.cameras for one in drawn(played, 1, deeper)] == [(deeper,)]
    # A moved camera's picture is outdated; that of another camera with the same name is not.
    info = replace(camera(played.session, EYE.key).info, kind="human")
    played.tell(Placed(PEOPLE.key, None, info))
    assert drawn(played, 1, EYE) == []
    for _ in range(2):
        played.tell(Placed(EYE.key, None, camera(played.session, EYE.key).info))
        assert [one.cameras for one in drawn(played, 1, EYE)] == [(EYE,)] and drawn(played, 1, EYE) == []
    played.tell(PastPictures(1, (picture(1),)))
    assert drawn(played, 1, EYE) == [] and not played.view.timeline.wants_pictures


def test_a_fast_picture_is_redrawn_exactly_unless_fast_pictures_are_chosen(played: FakeWorkerSession) -> None:
    played.tell(Pictures((picture(1, degree="fast"),), 5.0, 1))
    played.session.dispatch(MomentShown(1))
    assert drawn(played, 1, EYE, degree="fast") == [] and not played.view.timeline.wants_pictures
    assert [one.cameras for one in drawn(played, 1, EYE)] == [(EYE,)] and played.view.timeline.wants_pictures
    assert list(played.view.pictures) == [EYE.key], "the fast picture is shown meanwhile"
    played.tell(PastPictures(1, (picture(1, degree="exact"),)))
    assert drawn(played, 1, EYE) == []


def test_a_moment_is_pinned_until_the_view_returns_to_live(played: FakeWorkerSession) -> None:
    session = played.session
    assert played.view.timeline.shown is None and at(played) == 3
    seek_by(session, -2)
    played.step()
    view = played.view
    assert (view.timeline.shown, at(played), view.timeline.last) == (1, 1, 4), "new steps do not move it"
    assert view.slider_action is view.step.action and view.timeline.can_continue
    assert (view.timeline.tick, view.timeline.steps, view.timeline.steps_ago) == (1, 4, 3)
    seek(session, -5)
    assert at(played) == 0
    seek_by(session, 3)
    assert played.view.timeline.shown == 3
    seek_by(session, 1)
    assert played.view.timeline.shown is None and at(played) == 4
    for asked in (PlayRun(), Step(), ResetAll()):
        seek(session, 1)
        session.do(asked)
        assert played.view.timeline.shown is None
    seek(session, 4)
    assert played.view.timeline.shown is None, "the newest is live"


def test_when_a_pinned_moment_is_dropped_the_oldest_is_shown(tmp_path: Path) -> None:
    with fake_worker_session(tmp_path, history_bytes=60_000) as fake:
        fake.play(2)
        fake.session.dispatch(MomentShown(1))
        fake.step(97)
        timeline = fake.view.timeline
        assert timeline.first > 1 and timeline.shown == timeline.first == at(fake)


def test_keys_move_through_events_steps_and_moments_of_an_env(fake: FakeWorkerSession) -> None:
    session = fake.session
    fake.play(1)
    fake.step(success=(1,))
    fake.step()
    fake.reset((1,))  # moment 4
    fake.step()
    for env, expected in ((1, [4, 2, 0, 0]), (0, [0, 0])):
        fake.session.change(selected_env=env)
        seek(session, None)
        seen = []
        for _ in expected:
            session.do(PreviousEvent())
            seen.append(at(fake))
        assert seen == expected
    fake.session.change(selected_env=1)
    session.do(NextEvent())
    assert at(fake) == 2
    session.do(NextEvent())
    session.do(NextEvent())
    assert fake.view.timeline.shown is None
    # Within the shown episode, across resets of other envs.
    session.dispatch(EpisodeStepShown(1, 0))
    assert at(fake) == 4
    session.dispatch(EpisodeStepShown(0, 3))
    assert at(fake) == 3
    # A step back skips resets of other envs.
    ways = {}
    for env in (0, 1):
        fake.session.change(selected_env=env)
        seek(session, None)
        ways[env] = []
        for _ in range(3):
            seek_by(session, -1)
            ways[env].append(at(fake))
    assert ways == {0: [3, 2, 1], 1: [4, 3, 2]}


def test_steps_are_counted_consistently_and_a_reset_is_not_one(played: FakeWorkerSession) -> None:
    session = played.session
    played.reset()
    played.step(2)  # moments 4 to 6
    view = played.view
    assert view.timeline.steps == view.timeline.last_tick == 5 and view.timeline.moments == 7
    session.do(Seek(step=4))
    view = played.view
    assert (view.timeline.tick, view.timeline.steps_ago, at(played)) == (4, 1, 5)
    strip = session.look(lambda run: run.strip(-9, 99))
    assert (strip.low, strip.high) == (0, 5)
    assert np.isnan(strip.values[0]) and strip.values[1:].tolist() == [1, 2, 3, 1, 2]
    # Tick 3 is the last step of the first episode, and the reset that starts the second.
    session.do(Seek(step=3))
    assert at(played) == 3 and session.look(Run.episode_ticks) == (0, 3)
    seek(session, 6)
    session.do(Seek(step=3, episode_only=True))
    assert (
        at(played) == 4 and session.look(Run.episode_ticks) == (3, 5) and session.look(Run.segment) == (4, 6)
    )
    assert [played.view.timeline.steps_ago, played.view.timeline.tick] == [2, 3]


def test_in_the_past_the_table_of_envs_shows_the_past(played: FakeWorkerSession) -> None:
    played.reset((1,))
    played.step()
    assert played.session.env_rows().steps.tolist() == [4, 1, 4]
    played.session.dispatch(MomentShown(2))
    then = played.session.env_rows()
    assert then.steps.tolist() == [2, 2, 2] and then.total.tolist() == [3, 3, 3]
    assert [np.isfinite(row).sum() for row in then.rewards] == [2, 2, 2]


def test_an_event_of_an_env_is_found_in_earlier_episodes_too(played: FakeWorkerSession) -> None:
    session = played.session
    played.step(fail=(1,))
    failed = played.view.timeline.last
    played.reset((1,))
    played.step(reward=(1, np.nan, 1))
    lost = played.view.timeline.last
    played.reset((1,))
    played.step(2)
    session.dispatch(MomentShown(1))
    session.dispatch(EnvEventShown(1, "failed"))
    assert (at(played), session.view().selected_env) == (failed, 1)
    session.dispatch(EnvEventShown(1, "flagged"))
    assert at(played) == lost
    session.dispatch(EnvEventShown(2, "failed"))
    assert (at(played), session.view().selected_env) == (lost, 2), "env 2 has not failed"
    played.step(fail=(1,))
    played.reset((1,))
    played.step(2)
    session.dispatch(EnvEventShown(1, "failed"))
    assert at(played) == played.view.timeline.last - 3, "the newest of two"
    assert session.view().env_table is not None and session.view().env_table.failed.tolist() == [0, 2, 0]


def test_an_end_at_the_time_limit_is_no_fail(fake: FakeWorkerSession) -> None:
    session = fake.session
    fake.play(1)
    fake.step(fail=(1,))
    failed = fake.view.timeline.last
    fake.reset((1,))
    fake.step(truncated=(1,))
    limit = fake.view.timeline.last
    session.dispatch(EnvEventShown(1, "failed"))
    assert at(fake) == failed
    session.dispatch(EnvEventShown(1, "limit"))
    assert at(fake) == limit


@pytest.mark.parametrize("driven", [False, True])
def test_the_time_limit_does_not_end_a_driven_episode(fake: FakeWorkerSession, driven: bool) -> None:
    if driven:
        fake.session.change(action_source="sliders", episode_end="continue")
    fake.play(1)
    for _ in range(2):
        fake.step(truncated=(1,), reward=(1, 1, 1))
    table = fake.session.env_rows()
    assert (table.end[1], table.ended[1]) == ((-1, 0) if driven else (2, 1))
    assert (table.total[1] == table.total[0]) == driven, "the return goes on"
    fake.session.change(selected_env=1)
    found = dict(fake.session.look(lambda run: run.strip(0, 9)).events)
    assert found == ({0: RESET} if driven else {0: RESET, 2: TRUNCATED, 3: TRUNCATED})
    fake.step(fail=(1,))
    assert fake.session.env_rows().failed.tolist() == [0, int(driven), 0]


def test_an_episode_that_the_task_ends_by_its_own_rule_counts_as_failed(fake: FakeWorkerSession) -> None:
    fake.play(1)
    fake.step(evaluate={}, fail=(2,))
    fake.reset((2,))
    fake.session.dispatch(EnvEventShown(2, "failed"))
    assert at(fake) == fake.view.timeline.last - 1
    strip = fake.session.look(lambda run: run.strip(0, 9))
    assert strip is not None and [ending for *_, ending in strip.segments] == ["fail", ""]


def test_a_strip_covers_one_env_between_two_steps(fake: FakeWorkerSession) -> None:
    fake.play(2)
    fake.step(success=(1,))
    fake.back((1,), (2,), 1)
    fake.step()
    fake.session.change(selected_env=1)

    def strip(low: int, high: int) -> Strip:
        found = fake.session.look(lambda run: run.strip(low, high))
        assert found is not None
        return found

    whole = strip(-10, 99)
    assert (whole.low, whole.high) == (0, 4) and dict(whole.events) == {0: RESET, 3: SUCCESS | WENT_BACK}
    assert whole.branches == ((3, 1),) and whole.segments == ((0, 3, False, "success"), (3, 4, True, ""))
    part = strip(1, 2)
    assert (part.low, part.high, part.branches) == (1, 2, ()) and part.segments == ((1, 2, False, ""),)
    assert part.values.tolist() == [1, 2]
    fake.session.change(selected_env=0)
    other = strip(0, 5)
    assert (
        other.segments == ((0, 4, False, ""),) and other.branches == () and dict(other.events) == {0: RESET}
    )


# --- going back --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("scope", "envs", "source"),
    [("this", (2,), (2,)), ("all", (0, 1, 2), (0, 1, 2)), ("into all", (0, 1, 2), (2, 2, 2))],
)
def test_which_envs_go_back_to_which_moment_by_which_steps(
    played: FakeWorkerSession, scope: Any, envs: tuple[int, ...], source: tuple[int, ...]
) -> None:
    session = played.session
    played.session.change(selected_env=2)
    with pytest.raises(Refused):  # there is no moment to go back to while live
        session.do(ContinueFromHere(scope=scope))
    assert played.asked(Restore) == []
    seek(session, 2)
    actions = []
    for serial in (1, 2):
        seek(session, serial)
        actions.append(played.view.step.action)
    session.do(ContinueFromHere(scope=scope))
    (asked,) = played.asked(Restore)
    assert (asked.env_idx, asked.source, asked.origin, asked.undoes) == (envs, source, 2, None)
    assert b"body 2" in asked.snapshot and played.view.timeline.shown is None
    assert asked.ways.keys() == set(envs) and asked.starts.keys() == {0} and b"body 0" in asked.starts[0]
    for env, of in zip(envs, source, strict=True):
        np.testing.assert_array_equal(asked.ways[env].actions, [action[of] for action in actions])


def test_a_replay_to_a_moment_starts_at_the_last_exact_state(played: FakeWorkerSession) -> None:
    """A restored moment is an exact state; a replayed one is not."""

    def replay(env: int, serial: int) -> tuple[int, int, int] | None:
        played.asked(object)
        played.session.change(selected_env=env)
        played.session.dispatch(MomentShown(serial))
        played.session.do(ContinueFromHere(scope="this"))
        (asked,) = played.asked(Restore)
        found = asked.ways.get(env)
        return found and (found.start, found.source, len(found.actions))

    played.step(3)  # a reset, and steps at moments 1 to 6
    assert replay(0, 5) == (0, 0, 5) and replay(0, 0) is None, "the reset itself is restored"
    played.back((0,), (1,), 3)  # 7
    played.step()
    played.step()
    assert replay(0, 8) == (7, 0, 1) and replay(1, 8) == (0, 1, 7)
    played.back((0,), (1,), 3, replayed=(0,))  # 10
    played.step(2)
    assert replay(0, 11) == (0, 1, 4)
    played.reset(snapshot=b"")  # 13: a state that could not be stored
    played.step(2)
    assert replay(0, 14) is None and replay(2, 9) == (0, 2, 8)


def test_a_jump_is_undone_in_the_envs_that_are_still_in_it(played: FakeWorkerSession) -> None:
    session = played.session

    def words() -> list[str | None]:
        found = []
        for env in range(3):
            session.change(selected_env=env)
            found.append(played.view.timeline.undo)
        return found

    def undone(env: int) -> tuple[tuple[int, ...], int, int | None]:
        session.change(selected_env=env)
        session.dispatch(MomentShown(1))
        played.asked(object)
        session.do(UndoReset())
        (asked,) = played.asked(Restore)
        assert asked.source == asked.env_idx and played.view.timeline.shown is None
        return asked.env_idx, asked.origin, asked.undoes

    assert words() == [None] * 3, "nothing before the oldest moment can be restored"
    played.reset()  # 4
    played.reset((1,))  # 5
    assert words() == ["reset of 2 envs", "reset of env 1", "reset of 2 envs"]
    assert undone(2) == ((0, 2), 3, 4) and undone(1) == ((1,), 4, 5)
    played.back((1,), (1,), 4, undoes=5)  # 6
    assert words() == ["reset of all"] * 3 and undone(1) == ((0, 1, 2), 3, 4)
    played.back((0, 1, 2), (0, 1, 2), 3, undoes=4)
    assert words() == [None] * 3, "jumps in an abandoned future cannot be undone"
    played.step(truncated=(0, 2))
    played.reset((0, 2))
    played.back((1,), (1,), 2)
    assert words() == ["reset at the end", "jump of env 1", "reset at the end"]
    played.step(truncated=(0,))
    played.reset((0, 2))
    assert words()[0] == "reset of 2 envs", "one of them was reset by a person"


def test_state_that_a_jump_could_not_restore_is_reported_only_for_its_env_and_episode(
    played: FakeWorkerSession,
) -> None:
    def report_of(env: int) -> tuple[tuple[str, ...], str]:
        played.session.change(selected_env=env)
        view = played.view.timeline
        return view.not_carried, view.arrived

    played.back((1,), (1,), 2, not_carried={"actor ball": "the snapshot has none"}, how="restored")
    played.step()
    missing = ("actor ball: the snapshot has none",), "restored"
    assert report_of(1) == missing and report_of(0) == ((), "")
    played.session.dispatch(MomentShown(1))
    assert report_of(1) == ((), ""), "before the jump"
    played.session.dispatch(MomentShown(None))
    played.reset((0,))
    assert report_of(1) == missing, "another env was reset"
    played.reset((1,))
    assert report_of(1) == ((), "")
