"""The history of a session: its size, its rewards and its events."""

# The views are of a session whose task is loaded: what may be None before is not here.
# pyright: reportOptionalMemberAccess=false

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from tests.drive.session import FakeWorkerSession, fake_worker_session, moment, moment_at, moments_of
from workbench.envs.camera_data import CameraKind, Picture
from workbench.live.events import MomentShown
from workbench.live.history.curves import REWARD, Column, Group
from workbench.live.history.env_table import Outcome
from workbench.live.history.moments import (
    BY_HAND,
    FAIL,
    RESET,
    REWARD_NONFINITE,
    SUCCESS,
    TRUNCATED,
    WENT_BACK,
)
from workbench.live.messages import CameraRequest, PastPictures, Pictures
from workbench.live.timeline_commands import Seek
from workbench.task.description import NO_MOMENT, Pulled

EYE = CameraRequest("eye", "sensor")


def picture(env: int, size: int = 64, kind: CameraKind = "sensor", name: str = "eye") -> Picture:
    return Picture(name, kind, env, np.zeros(7, np.float32), np.zeros((size, size, 3), np.uint8))


def pictured(fake: FakeWorkerSession) -> list[int]:
    """Serials of the moments that have a picture of the selected env."""
    session, found = fake.session, []
    session.change(cameras=(EYE,))
    for serial in range(fake.view.timeline.first, fake.view.timeline.last):
        session.dispatch(MomentShown(serial))
        found += [serial] if fake.view.pictures else []
    session.dispatch(MomentShown(None))
    return found


def events(fake: FakeWorkerSession, env: int) -> list[tuple[int, int]]:
    fake.session.change(selected_env=env)
    return list(fake.session.look(lambda run: run.strip(0, 10**6)).events)


def rewards(fake: FakeWorkerSession) -> list[list[float]]:
    """Rewards of each env's running episode."""
    return [row[np.isfinite(row)].tolist() for row in fake.session.env_rows().rewards]


def test_memory_is_bounded_and_the_oldest_goes_first(tmp_path: Path) -> None:
    with fake_worker_session(tmp_path, history_bytes=60_000) as fake:
        fake.play(499)
        timeline = fake.view.timeline
        assert timeline.used <= timeline.limit == 60_000 and 5 < timeline.moments < 500
        assert timeline.last == 499 and timeline.first == 500 - timeline.moments
        assert timeline.first_tick == timeline.first and timeline.steps == timeline.moments - 1
        assert [one.serial for one in moments_of(fake.session)] == [*range(timeline.first, 500)]
        strip = fake.session.look(lambda run: run.strip(0, 499))
        assert strip.values.tolist() == [*range(timeline.first, 500)] == [*range(strip.low, 500)]
        fake.session.do(Seek(step=1))
        assert fake.view.timeline.shown == timeline.first, "the nearest kept moment"


def test_snapshot_parts_are_kept_and_counted_while_a_moment_needs_them(tmp_path: Path) -> None:
    with fake_worker_session(tmp_path, history_bytes=40_000) as fake:
        fake.load()
        fake.reset(part_keys=(1, 2), new_parts={1: bytes(3000), 2: bytes(500)})
        with_both = fake.view.timeline.used
        fake.step(part_keys=(2, 3), new_parts={3: bytes(100)})
        second = fake.view.timeline.used - with_both - 100
        fake.step(part_keys=(2, 99))
        fake.session.dispatch(MomentShown(2))
        assert not fake.view.timeline.can_continue, "a part never arrived"
        fake.session.dispatch(MomentShown(1))
        assert fake.view.timeline.can_continue
        fake.session.dispatch(MomentShown(None))
        fake.step(part_keys=(2, 3))
        fake.step(100)
        timeline = fake.view.timeline
        assert timeline.first > 2 and timeline.used <= 40_000
        assert abs(timeline.used - timeline.moments * second - 600) < 0.1 * second, "parts 2 and 3 are left"


def test_the_newest_moment_alone_is_kept_at_any_size(tmp_path: Path) -> None:
    with fake_worker_session(tmp_path, history_bytes=1) as fake:
        fake.play(2)
        alone = fake.view.timeline.used
        fake.tell(Pictures((picture(0),), 5.0, 2))
        fake.load("patched", source_hash="b")
        fake.step(2)
        timeline = fake.view.timeline
        assert (timeline.first, timeline.last, timeline.used) == (4, 4, alone), (
            "dropped moments are not counted"
        )


def test_pictures_belong_to_the_moment_they_show_and_fill_at_most_half(tmp_path: Path) -> None:
    with fake_worker_session(tmp_path, history_bytes=400_000) as fake:
        fake.play(29)
        empty = fake.view.timeline.used
        fake.tell(Pictures((picture(0),), 5.0, 12), Pictures((picture(1),), 5.0, 13))
        assert pictured(fake) == [12], "a late picture belongs to the step with its number"
        each = (fake.view.timeline.used - empty) // 2
        assert each >= 64 * 64 * 3
        fake.tell(PastPictures(12, (picture(0, 32),)))
        smaller = fake.view.timeline.used
        assert smaller - empty == 2 * each - 3 * (64 * 64 - 32 * 32), "one replaces another"
        fake.tell(PastPictures(5000, (picture(0),)))
        for serial in (5, 2, *range(14, 29)):
            fake.tell(PastPictures(serial, (picture(0),)))
        kept = pictured(fake)
        assert 12 not in kept and kept == list(range(29 - len(kept), 29)), "the oldest pictures are dropped"
        timeline = fake.view.timeline
        assert timeline.moments == 30, "no step is dropped for pictures"
        assert timeline.used - empty == len(kept) * each <= 200_000 < (len(kept) + 1) * each
        fake.step(300)
        assert fake.view.timeline.used <= 400_000 and pictured(fake) == []


def test_after_going_back_each_env_has_the_recorded_reward_and_terms(
    fake: FakeWorkerSession,
) -> None:
    reach = "reward_terms/reach"
    fake.play(0)
    assert np.isnan(fake.view.step.reward).all()
    for number in (1, 2, 3):
        values = np.array([10.0 * number, 10 * number + 1, 10 * number + 2], np.float32)
        fake.step(reward=values.tolist(), evaluate={"success": np.zeros(3, bool), reach: values / 2})
    fake.back((2, 0), (1, 2), 2)
    assert fake.view.step.reward.tolist() == [22, 31, 21]
    assert fake.view.step.evaluate[reach].tolist() == [11, 15.5, 10.5]
    fake.back((1,), (0,), -7)
    step = fake.view.step
    np.testing.assert_array_equal(step.reward, [22, np.nan, 21])
    np.testing.assert_array_equal(step.evaluate[reach], step.reward / 2)
    fake.reset()
    assert np.isnan(fake.view.step.evaluate[reach]).all(), (
        "no env has a term, but the entry stays on the page"
    )


def test_a_partial_reset_adds_no_zero_reward_and_a_resumed_env_keeps_its_reward(
    played: FakeWorkerSession,
) -> None:
    played.reset((1,))
    np.testing.assert_array_equal(played.view.step.reward, [3, np.nan, 3])
    played.resume()
    np.testing.assert_array_equal(played.view.step.reward, [3, np.nan, 3])
    played.load("patched", source_hash="b")
    np.testing.assert_array_equal(
        played.view.step.reward, [3, np.nan, 3], "a moment without an action has none"
    )
    played.step()
    assert rewards(played) == [[1, 2, 3, 4], [1], [1, 2, 3, 4]]


def test_a_rescored_moment_keeps_its_recorded_reward(played: FakeWorkerSession) -> None:
    recorded, used = played.view.step, played.view.timeline.used
    for version in ("b", "c"):
        played.load("patched", source_hash=version)
    (newest,) = moments_of(played.session)[-1:]
    assert newest.as_recorded is recorded and newest.step is played.view.step is not recorded
    assert 0 < played.view.timeline.used - used < 2500, "its bytes are counted once"


def test_each_env_that_went_back_has_the_past_of_its_own_source(fake: FakeWorkerSession) -> None:
    fake.play(0)
    for number in (10.0, 20.0, 30.0):
        fake.step(reward=[number, number + 1, number + 2])
    fake.back((2, 0), (1, 2), 2)
    fake.step(reward=[1.0, 2.0, 3.0])
    assert rewards(fake) == [[12, 22, 1], [11, 21, 31, 2], [11, 21, 3]]
    paths = fake.session.look(
        lambda run: [run.past.history.episode(env, run.past.history.last) for env in range(3)]
    )
    assert [[at for _, at in path] for path in paths] == [[2, 2, 2, 0], [1] * 5, [1, 1, 1, 2]]


def test_events_are_first_successes_truncations_and_jumps(fake: FakeWorkerSession) -> None:
    fake.play(0)
    fake.step(success=(1,))
    fake.step(success=(1,))
    fake.step(truncated=(1,))
    fake.reset((1,))  # at tick 3
    fake.step(success=(1,))
    fake.back((1,), (1,), 2, success=(1,))
    fake.step(success=(1,))
    expected = [(0, RESET), (1, SUCCESS), (3, TRUNCATED | RESET), (4, SUCCESS | WENT_BACK)]
    assert events(fake, 1) == expected
    assert events(fake, 0) == [(0, RESET)]
    fake.reset()
    fake.step(reward=(1, np.nan, 1))
    fake.step(reward=(1, np.inf, 1), evaluate={"fail": np.array([True, False, False])})
    assert events(fake, 1)[4:] == [(5, RESET), (6, REWARD_NONFINITE)]
    assert events(fake, 0)[1:] == [(5, RESET), (7, FAIL)]
    fake.load("rebuilt")
    fake.reset()
    assert events(fake, 1) == [(0, RESET)], "no event from another scene's past"


def test_a_task_without_a_robot_has_steps_with_rewards(fake: FakeWorkerSession) -> None:
    fake.play(0)
    for number in (1, 2):
        event = moment(np.full(3, number))
        fake.tell(replace(event, step=replace(event.step, action=None)))
    assert fake.view.timeline.last_tick == 2 and rewards(fake) == [[1, 2]] * 3


# --- episodes, for curves --------------------------------------------------------------------------------


def lived(fake: FakeWorkerSession) -> None:
    """The reward of env k at tick t is 10 t + k, and so is its entry height but for the sign."""
    fake.play(0)
    step(fake, 2)  # moments 1 and 2
    fake.reset((1,))  # 3
    step(fake, 2)  # 4 and 5
    fake.reset((1,))  # 6
    fake.reset((1,))  # 7: an episode without a step
    step(fake, 1)  # 8
    fake.back((0,), (1,), 4)  # 9: env 0 goes on from the first step of env 1's second episode
    step(fake, 1)  # 10


def step(fake: FakeWorkerSession, count: int) -> None:
    for _ in range(count):
        reward = 10.0 * (fake.view.timeline.last_tick + 1) + np.arange(3, dtype=np.float32)
        entries = {"success": np.zeros(3, bool), "height": -reward}
        fake.step(reward=reward.tolist(), evaluate=entries)


HEIGHT = Column(Group.EVALUATE, "height")


def episodes(
    fake: FakeWorkerSession, env: int, before: int, *columns: Column, last: int | None = None
) -> list[tuple[list[int], ...]]:
    """Steps of the shown episode and those before it, and the numbers of each column."""
    newest = fake.view.timeline.last if last is None else last
    found = fake.session.look(lambda run: run.episodes(env, newest, columns, before))
    return [(one.steps.tolist(), *(one.values[each].tolist() for each in columns)) for one in found]


def test_an_episode_has_the_steps_and_numbers_of_its_own_env_and_of_where_it_went_back_to(
    fake: FakeWorkerSession,
) -> None:
    lived(fake)
    assert episodes(fake, 2, 5, REWARD, HEIGHT) == [
        ([1, 2, 3, 4, 5, 6], [12, 22, 32, 42, 52, 62], [-12, -22, -32, -42, -52, -62])
    ]
    own = [([1, 2], [51, 61]), ([1, 2], [31, 41]), ([1, 2], [11, 21])]
    for count in (0, 1, 2, 9):  # an earlier question must not answer a later one
        assert episodes(fake, 1, count, REWARD) == own[: count + 1]
    assert episodes(fake, 1, 1, HEIGHT, REWARD)[1] == ([1, 2], [-31, -41], [31, 41])
    assert episodes(fake, 0, 5, REWARD) == [([1, 2], [31, 60]), ([1, 2], [10, 20])]
    assert episodes(fake, 1, 0, REWARD, last=8) == [([1], [51])], "the view is older than the history"
    fake.session.dispatch(MomentShown(4))
    assert episodes(fake, 1, 5, REWARD) == own[1:], "the whole shown episode, and those before it"
    assert episodes(fake, 1, 0, REWARD, last=4) == [([1], [31])]


def test_a_strip_can_show_any_number_of_the_selected_env(fake: FakeWorkerSession) -> None:
    lived(fake)
    for env in range(3):
        fake.session.change(selected_env=env)
        height = fake.session.look(lambda run: run.strip(2, 4, HEIGHT))
        assert height.values.tolist() == [-20 - env, -30 - env, -40 - env]
        assert fake.session.look(lambda run: run.strip(2, 4)).values.tolist() == [
            20 + env,
            30 + env,
            40 + env,
        ]


def test_a_moment_keeps_what_a_recording_needs_of_it(played: FakeWorkerSession) -> None:
    played.reset(seeds=np.array([4, 5, 6]))
    played.step(acted_by="policy a.py:act")
    reset, stepped = moments_of(played.session)[-2:]
    assert reset.seeds is not None and reset.seeds.tolist() == [4, 5, 6] and stepped.seeds is None
    assert (reset.acted_by, stepped.acted_by) == ("", "policy a.py:act")
    assert reset.number + 1 == stepped.number and reset.as_recorded is reset.step


def test_the_first_end_of_an_episode_is_that_of_its_block_and_of_its_row(fake: FakeWorkerSession) -> None:
    fake.play(0)
    fake.step(success=(0, 1), fail=(1, 2))
    fake.step(fail=(0,))
    blocks = []
    for env in range(3):
        fake.session.change(selected_env=env)
        blocks.append(fake.session.look(lambda run: run.strip(0, 9)).segments[-1][-1])
    outcomes = [Outcome(int(one)).name.lower() for one in fake.session.env_rows().outcome]
    assert blocks == outcomes == ["success", "success", "fail"]


# --- what a person does to bodies ------------------------------------------------------------------------


def test_a_move_by_hand_is_an_event_without_a_reward_and_can_be_undone(fake: FakeWorkerSession) -> None:
    fake.play(3)
    fake.back((1,), (1,), 3, moved="cube")
    assert events(fake, 1) == [(0, RESET), (3, BY_HAND)] and events(fake, 0) == [(0, RESET)]
    np.testing.assert_array_equal(fake.view.step.reward, [3, np.nan, 3])
    fake.session.change(selected_env=1)
    assert fake.view.timeline.undo == "move of cube of env 1"
    strip = fake.session.look(lambda run: run.strip(0, 3))
    assert strip.branches == () and [branch for _, _, branch, _ in strip.segments] == [False, False]
    assert by_hand(fake) == [False, True, False]


def by_hand(fake: FakeWorkerSession) -> list[bool]:
    rows = fake.session.env_rows().by_hand.tolist()
    history = fake.session.look(lambda run: run.past.history)
    (newest,) = moments_of(fake.session)[-1:]
    assert [fake.session.look(lambda run, env=env: history.by_hand(newest, env)) for env in range(3)] == rows
    return rows


def test_a_pull_marks_its_first_step_and_its_env_until_the_next_episode(fake: FakeWorkerSession) -> None:
    fake.play(1)
    for body in ("cube", "cube", "peg"):
        fake.step(pulled=Pulled(1, body, 3.0))
    fake.step()
    fake.step(pulled=Pulled(2, "peg", 3.0))
    assert events(fake, 1) == [(0, RESET), (2, BY_HAND), (4, BY_HAND)]
    assert events(fake, 2) == [(0, RESET), (6, BY_HAND)]
    assert by_hand(fake) == [False, True, True]
    fake.back((2,), (2,), 3)
    assert by_hand(fake) == [False, True, False], "it went back to before the pull"
    fake.back((2,), (1,), 5)
    assert by_hand(fake) == [False, True, True], "it goes on from a state that a pull led to"
    fake.reset((1,))
    assert by_hand(fake) == [False, False, True]

    def replay(env: int, serial: int, most: int = 99) -> int | None:
        path = fake.session.look(lambda run: run.past.history.replay_path(env, serial, most))
        return None if path is None else len(path.actions)

    assert [replay(env, 2) for env in range(3)] == [2, None, 2], "only this env was pulled"
    assert replay(0, 5, 5) == 5 and replay(0, 5, 4) is None, "too long"


def test_envs_that_entered_a_recording_cannot_be_replayed_and_say_so(fake: FakeWorkerSession) -> None:
    fake.play(2)
    fake.back((1,), (1,), NO_MOMENT, recording="a.rrd, step 9", number=5)
    fake.step()
    fake.session.change(selected_env=1)
    assert fake.view.timeline.undo == "going live of env 1" and fake.view.timeline.entered == 5
    assert events(fake, 1) == [(0, RESET), (2, WENT_BACK)]
    assert fake.session.look(lambda run: run.strip(0, 9)).branches == ()
    last = fake.view.timeline.last
    path = fake.session.look(lambda run: [run.past.history.replay_path(env, last, 99) for env in (0, 1)])
    assert len(path[0].actions) == 3 and path[1] is None
    fake.back((1,), (1,), 1)
    assert fake.view.timeline.entered == 5, "the number of the last one that was entered"


def test_pictures_of_a_camera_that_moved_are_drawn_again_at_each_moment(played: FakeWorkerSession) -> None:
    human = replace(picture(0), kind="human")
    for serial in (1, 2):
        played.tell(PastPictures(serial, (picture(0), human)))
    history = played.session.look(lambda run: run.past.history)
    history.camera_moved("sensor", "eye")
    assert [moment_at(played.session, at).outdated for at in (1, 2)] == [{(0, "sensor", "eye")}] * 2
    played.tell(PastPictures(2, (picture(0),)))
    assert [len(moment_at(played.session, at).outdated) for at in (1, 2)] == [1, 0]
