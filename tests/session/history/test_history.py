"""The log of moments: what it keeps, what it lets go, and what it says happened."""

# pyright: reportOptionalMemberAccess=false

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.session.moments import N, mask_of, stepped, table
from workbench.core.camera_data import CameraKind, Picture
from workbench.jobs.task import NO_MOMENT, Restored
from workbench.session.history.history import (
    FAIL,
    RESET,
    REWARD_NONFINITE,
    SUCCESS,
    TRUNCATED,
    WENT_BACK,
    History,
)
from workbench.session.protocol.messages import PastPictures, Pictures
from workbench.session.rescore.past import RescoredPast


def picture(env: int, size: int = 64, kind: CameraKind = "sensor", name: str = "eye") -> Picture:
    return Picture(name, kind, env, np.zeros(7, np.float32), np.zeros((size, size, 3), np.uint8))


def filled(count: int, limit: int = 10**9, part: int = 0) -> History:
    history = History(table(), limit)
    history.add(stepped(0, jumped=(0, 1, 2), keys=(1,), new={1: bytes(part)}))
    for number in range(1, count):
        history.add(stepped(number))
    return history


def test_memory_is_bounded_and_the_oldest_goes_first() -> None:
    limit = 60_000
    history = filled(500, limit)
    assert history.used <= limit
    assert 5 < len(history) < 500
    assert history.last == 499 and history.first == 500 - len(history)
    assert history.at(history.first - 1) is None
    kept = [moment.serial for moment in history.between(0, 10**6)]
    assert kept == list(range(history.first, 500))
    assert history.rewards(0, history.first, history.last).tolist() == kept


def test_a_part_is_kept_and_counted_as_long_as_a_moment_needs_it() -> None:
    history = History(table(), 40_000)
    history.add(stepped(0, keys=(1, 2), new={1: bytes(3000), 2: bytes(500)}))
    with_both = history.used
    second = history.add(stepped(1, keys=(2, 3), new={3: bytes(100)}))
    assert history.used - with_both == second.size + 100
    assert history.snapshot_at(0) is not None and b"body 1" in (history.snapshot_at(1) or b"")
    for number in range(2, 100):
        history.add(stepped(number))
    size = sum(m.size for m in history.between(history.first, history.last))
    assert history.used == size + 600  # parts 2 and 3


def test_a_snapshot_whose_parts_never_came_is_none() -> None:
    history = filled(2)
    history.add(stepped(2, keys=(1, 99)))
    assert history.snapshot_at(1) is not None
    assert history.snapshot_at(2) is None
    assert history.at(2) is not None


def test_pictures_belong_to_the_moment_that_they_show_and_fill_half_at_most() -> None:
    limit = 400_000
    history = filled(30, limit)
    history.add_pictures(Pictures((picture(1),), 5.0, 12))
    moment = history.at(12)
    assert moment is not None and list(moment.pictures) == [(1, "sensor", "eye")]
    for serial in range(29):
        history.add_pictures(PastPictures(serial, (picture(0),)))
    pictured = [m.serial for m in history.between(0, 29) if m.pictures]
    assert 0 < len(pictured) < 29 and pictured[-1] == 28
    assert len(history) == 30, "steps are not dropped for pictures"
    assert sum(64 * 64 * 3 for _ in pictured) <= limit / 2


def test_a_camera_that_moved_outdates_its_own_pictures_and_not_those_of_its_namesake() -> None:
    history = filled(4)
    kinds: tuple[CameraKind, ...] = ("sensor", "human")
    for serial in (1, 2):
        shown = tuple(picture(env, kind=kind) for env in (0, 1) for kind in kinds)
        history.add_pictures(PastPictures(serial, (*shown, picture(0, name="hand"))))
    history.camera_moved("human", "eye")
    for serial in (1, 2):
        assert history.at(serial).outdated == {(0, "human", "eye"), (1, "human", "eye")}
    history.add_pictures(PastPictures(1, (picture(1, kind="human"),)))
    assert history.at(1).outdated == {(0, "human", "eye")}
    assert history.at(2).outdated == {(0, "human", "eye"), (1, "human", "eye")}


def test_a_picture_that_takes_the_place_of_another_is_counted_once_and_with_its_moment_not_at_all() -> None:
    history = filled(3)
    empty = history.used
    history.add_pictures(PastPictures(1, (picture(0), picture(1))))
    two = history.used - empty
    history.add_pictures(PastPictures(1, (picture(0, 32),)))
    assert two == 2 * (300 + 64 * 64 * 3) and history.used - empty == two - 3 * (64 * 64 - 32 * 32)
    history.limit = 1
    history.add(stepped(3))
    assert (len(history), history.first, history.last) == (1, 3, 3)
    assert history.used == history.at(3).size, "the newest stays, and nothing of what went is counted"


def test_pictures_come_some_steps_late_and_belong_to_the_step_of_their_number() -> None:
    history = filled(300)
    for env, number in enumerate((299, 100, 98)):
        history.add_pictures(Pictures((picture(env),), 5.0, number))
    assert [m.serial for m in history.between(0, 299) if m.pictures] == [100, 299]
    assert list(history.at(100).pictures) == [(1, "sensor", "eye")]
    history.add_pictures(PastPictures(5000, (picture(0),)))


def test_the_oldest_pictures_go_first_and_are_gone_for_good() -> None:
    history = filled(10, 200_000)
    for serial in (5, 2, 7, 8):
        for env in range(N):
            history.add_pictures(PastPictures(serial, (picture(env),)))
    assert [m.serial for m in history.between(0, 9) if m.pictures] == [7, 8]
    assert all(len(history.at(serial).pictures) == N for serial in (7, 8))
    history.add_pictures(PastPictures(2, (picture(1),)))
    assert list(history.at(2).pictures) == [(1, "sensor", "eye")]


def test_a_moment_that_is_gone_back_to_has_the_reward_and_its_terms_of_its_record_in_each_env() -> None:
    reach = "reward_terms/reach"
    history = filled(1)
    for number in (1, 2, 3):
        step = stepped(number)
        step.step.reward[:] = [10 * number, 10 * number + 1, 10 * number + 2]
        step.step.evaluate[reach] = step.step.reward / 2
        history.add(step)
    jump = stepped(4, jumped=(0, 2), restored=Restored((2, 0), (1, 2), 2, None, {}))
    moment = history.add(jump)
    assert moment.step.reward.tolist() == [22, 31, 21]
    assert moment.step.evaluate[reach].tolist() == [11, 15.5, 10.5]
    gone = stepped(5, jumped=(1,), restored=Restored((1,), (0,), -7, None, {}))
    step = history.add(gone).step
    assert np.array_equal(step.reward, [22, np.nan, 21], equal_nan=True)
    assert np.array_equal(step.evaluate[reach], step.reward / 2, equal_nan=True)
    assert reach not in history.add(stepped(0, jumped=(0, 1, 2))).step.evaluate, "no env has a term"


def test_a_worker_that_came_back_with_the_moment_at_which_the_last_one_died_keeps_its_reward() -> None:
    history = filled(4)
    again = stepped(3, jumped=(0, 1, 2))
    assert history.add(replace(again, resumed=True)).step.reward.tolist() == [3, 3, 3]
    assert np.isnan(history.add(again).step.reward).all(), "a reset to a moment has no reward"


def test_a_moment_put_there_that_has_success_already_is_none_anew() -> None:
    history = filled(1)
    history.add(stepped(1, success=(0,)))
    history.add(stepped(2))
    back = Restored((0, 2), (0, 0), 1, None, {})
    history.add(stepped(1, jumped=(0, 2), success=(0, 2), restored=back))
    history.add(stepped(2, success=(0, 1, 2), truncated=(2,)))
    assert history.events(0, 1, 9) == [(1, SUCCESS), (3, WENT_BACK)]
    assert history.events(1, 1, 9) == [(4, SUCCESS)]
    assert history.events(2, 1, 9) == [(3, WENT_BACK), (4, TRUNCATED)]


def test_what_was_judged_anew_counts_its_bytes_once() -> None:
    history = filled(3)
    before, first = history.used, history.at(2).step
    for reward in (7.0, 8.0):
        history.replace_last(replace(first, reward=np.full(N, reward, np.float32)))
    grown = history.used - before
    assert 0 < grown < 2500
    history.limit = 1
    history.add(stepped(3))
    assert history.used == history.at(3).size


def test_the_newest_reset_has_no_reward_whatever_a_newer_version_says() -> None:
    history = filled(1)
    renewed = history.replace_last(replace(history.at(0).step, reward=np.ones(N, np.float32)))
    assert np.isnan(renewed.reward).all() and np.isnan(history.rewards(0, 0, 0)).all()
    empty = History(table(), 10**9)
    assert empty.replace_last(renewed) is renewed and len(empty) == 0


def test_the_rewards_of_an_episode_come_through_what_it_was_put_back_to() -> None:
    history = filled(5)
    back = Restored((0,), (1,), 2, None, {})
    for step, elapsed in (
        (stepped(5, jumped=(0,), restored=back), [2, 4, 4]),
        (stepped(6), [3, 5, 5]),
        (stepped(0, jumped=(2,)), [3, 5, 0]),
    ):
        step.step.elapsed_steps[:] = elapsed
        history.add(step)
    rewards = history.env_rows().rewards
    assert [of[np.isfinite(of)].tolist() for of in rewards] == [[1, 2, 6], [1, 2, 3, 4, 6], []]


def test_a_step_of_the_curves_is_the_moment_after_it_or_the_nearest_that_is_kept() -> None:
    history = filled(4)
    history.add(stepped(0, jumped=(0,)))
    history.add(stepped(1))
    assert [history.at(history.serial_of_tick(tick)).tick for tick in (1, 2, 3, 4)] == [1, 2, 3, 4]
    assert history.serial_of_tick(3) == 3, "the step, and not the reset after it"
    assert (history.serial_of_tick(-5), history.serial_of_tick(99)) == (0, history.last)
    short = filled(500, 60_000)
    assert short.serial_of_tick(1) == short.first
    assert short.serial_of_tick(short.at(short.last - 2).tick) == short.last - 2
    empty = History(table(), 10**9)
    assert empty.serial_of_tick(3) == empty.last


def test_serials_go_on_from_the_history_before() -> None:
    history = History(table(), 10**9, first_serial=70)
    assert (history.first, history.last, len(history)) == (70, 69, 0)
    assert history.at(70) is None and history.segments(0) == []
    history.add(stepped(0, jumped=(0, 1, 2), keys=(1,), new={1: b"p"}))
    history.add(stepped(1, success=(2,)))
    assert history.at(69) is None and history.at(72) is None and history.at(71).number == 1
    assert history.events(2, 0, 99) == [(70, RESET), (71, SUCCESS)]
    assert history.rewards(2, 71, 99).tolist() == [1.0]


def test_events_are_the_first_success_of_an_episode_truncations_and_jumps() -> None:
    history = filled(1)
    history.add(stepped(1, success=(1,)))
    history.add(stepped(2, success=(1,)))
    history.add(stepped(3, truncated=(1,)))
    history.add(stepped(0, jumped=(1,)))
    history.add(stepped(1, success=(1,)))
    back = Restored((1,), (1,), 2, None, {})
    history.add(stepped(2, jumped=(1,), success=(1,), restored=back))
    history.add(stepped(3, success=(1,)))
    assert history.events(1, 0, 99) == [
        (0, RESET),
        (1, SUCCESS),
        (3, TRUNCATED),
        (4, RESET),
        (5, SUCCESS),
        (6, WENT_BACK),
    ]
    assert history.events(0, 1, 99) == []
    assert FAIL not in {flag for _, flag in history.events(1, 0, 99)}
    assert history.jumps_back(1) == [(6, 2)]


def test_a_stretch_is_what_an_env_lived_through_without_a_jump() -> None:
    history = filled(4)
    history.add(stepped(0, jumped=(1,)))
    history.add(stepped(1))
    assert history.segments(1) == [(0, 3), (4, 5)]
    assert history.segments(0) == [(0, 5)]
    assert history.segment_at(1, 2) == (0, 3)
    assert history.segment_at(1, 5) == (4, 5)


def test_a_stretch_whose_start_was_dropped_is_what_is_kept_of_it() -> None:
    history = filled(100, 60_000)
    assert history.first > 0 and history.segments(0) == [(history.first, 99)]
    assert history.episode(0, 99)[0][0].serial == history.first


def test_undo_goes_back_through_the_jumps_one_by_one() -> None:
    history = filled(3)
    history.add(stepped(0, jumped=(0, 1, 2)))
    history.add(stepped(0, jumped=(1,)))
    last = history.last_jump(1)
    assert last is not None and last.serial == 4
    history.add(stepped(0, jumped=(1,), restored=Restored((1,), (1,), 3, 4, {})))
    before = history.last_jump(1)
    assert before is not None and before.serial == 3
    other = history.last_jump(0)
    assert other is not None and other.serial == 3 and history.envs_still_at(other) == (0, 1, 2)
    history.add(stepped(0, jumped=(0, 1, 2), restored=Restored((0, 1, 2), (0, 1, 2), 2, 3, {})))
    assert history.last_jump(1) is None, "what it did in the future that was left is none of what it lives"


def test_what_was_before_the_oldest_moment_cannot_be_returned_to() -> None:
    history = filled(1)
    assert history.last_jump(0) is None


def test_a_reset_of_others_is_no_reward_of_zero() -> None:
    history = filled(3)
    history.add(stepped(0, jumped=(1,)))
    assert history.rewards(0, 1, 99).tolist() == [1, 2, 2]
    assert history.rewards(1, 1, 2).tolist() == [1, 2] and np.isnan(history.rewards(1, 3, 3)).all()


def test_what_a_newer_version_says_of_a_moment_is_not_its_record() -> None:
    history = filled(3)
    first = history.at(2).step  # type: ignore[union-attr]
    for reward in (7.0, 8.0):
        history.replace_last(replace(first, reward=np.full(N, reward, np.float32)))
    moment = history.at(2)
    assert moment is not None and moment.as_recorded is first and moment.step.reward[0] == 8.0
    assert history.rewards(0, 2, 2).tolist() == [8.0]
    rescored = RescoredPast(history).curve("reward", 0)
    assert rescored is not None and rescored.old.tolist() == [1.0, 2.0]


def test_the_first_reward_of_an_episode_that_is_no_number_is_an_event() -> None:
    history = filled(2)
    for number in (2, 3):
        step = stepped(number)
        step.step.reward[1] = np.nan
        history.add(step)
    history.add(stepped(0, jumped=(0, 1, 2)))
    history.add(stepped(1))
    assert history.events(1, 1, 99) == [(2, REWARD_NONFINITE), (4, RESET)]
    assert history.events(0, 1, 99) == [(4, RESET)]


@pytest.mark.parametrize("count", [1, 1023, 1024, 1025, pytest.param(5000, marks=pytest.mark.slow)])
def test_rows_stay_with_their_moments_however_many_there_are(count: int) -> None:
    history = filled(count, 3_000_000)
    expected = [float(m.step.reward[0]) for m in history.between(0, count)]
    assert np.array_equal(history.rewards(0, 0, count), expected, equal_nan=True)


def test_the_moments_of_an_episode_are_its_steps_through_what_it_was_put_back_to() -> None:
    history = filled(6)  # a reset and steps 1 to 5
    origin = 3
    history.add(stepped(6, jumped=(0,), restored=Restored((0,), (1,), origin, None, {})))
    history.add(stepped(7))
    history.add(stepped(8, jumped=(2,)))  # another env's reset is no step
    history.add(stepped(9))
    episode_backwards = history.episode(0, 7, 100)
    # Before it was put where env 1 was at moment 3, it was env 1.
    assert [(moment.serial, env) for moment, env in episode_backwards] == [
        (0, 1),
        (1, 1),
        (2, 1),
        (3, 1),
        (7, 0),
        (9, 0),
    ]
    assert [moment.serial for moment, _ in history.episode(0, 7, 3)] == [0, 2, 9]
    assert [moment.serial for moment, _ in history.episode(1, 2, 100)] == [*range(6), 7, 9]
    assert [moment.serial for moment, _ in history.episode(2, 9)] == [8, 9]


def test_the_way_to_a_moment_begins_at_the_last_exact_point() -> None:
    history = filled(6)  # a reset and steps 1 to 5
    assert way(history, 0, 5) == (0, 0, 5)
    assert history.replay_path(0, 0, 100) is None, "the reset itself is put there"
    history.add(stepped(6, jumped=(0,), restored=Restored((0,), (1,), 3, None, {})))
    history.add(stepped(7))
    assert way(history, 0, 7) == (6, 0, 1), "a moment that was put there is an exact point"
    assert way(history, 1, 7) == (0, 1, 6)
    episode_backwards = Restored((0,), (1,), 3, None, {}, replayed=(0,))
    history.add(stepped(8, jumped=(0,), restored=episode_backwards))
    history.add(stepped(9))
    assert way(history, 0, 9) == (0, 1, 4), "one that was lived up to is none: on from where it began"
    assert history.replay_path(0, 9, 3) is None, "more steps than may be made"
    history.add(stepped(10, jumped=(0,), restored=Restored((0,), (0,), NO_MOMENT, None, {}, "a recording")))
    history.add(stepped(11))
    assert history.replay_path(0, 11, 100) is None and way(history, 2, 11) == (0, 2, 8)


def way(history: History, env: int, serial: int) -> tuple[int, int, int]:
    """Its beginning, the env then, and how many steps it has."""
    found = history.replay_path(env, serial, 100)
    assert found is not None
    return found.start, found.source, len(found.actions)


def test_pictures_of_moments_that_went_are_no_trouble_to_those_that_are_kept() -> None:
    history = filled(30, 400_000)
    history.add_pictures(PastPictures(2, (picture(0),)))
    for number in range(30, 300):
        history.add(stepped(number))
    assert history.at(2) is None
    for serial in range(260, 300):
        history.add_pictures(PastPictures(serial, (picture(0),)))
    pictured = [moment.serial for moment in history.between(0, 300) if moment.pictures]
    assert pictured == list(range(pictured[0], 300)) and 260 < pictured[0] and history.used <= history.limit


def test_a_going_back_that_was_dropped_is_told_no_more() -> None:
    history = filled(3, 60_000)
    for origin in (1, 2):
        history.add(stepped(1, jumped=(0,), restored=Restored((0,), (0,), origin, None, {})))
    assert history.jumps_back(0) == [(3, 1), (4, 2)]
    for number in range(2, 300):
        history.add(stepped(number))
    assert history.first > 4 and history.jumps_back(0) == []


def test_there_is_no_way_from_a_point_that_cannot_be_put_there() -> None:
    history = filled(2)
    history.add(stepped(2, jumped=(0, 1, 2), keys=(1, 99)))
    history.add(stepped(3))
    assert history.replay_path(0, 3, 100) is None and way(history, 0, 1) == (0, 0, 1)


def test_what_may_happen_can_happen_at_once() -> None:
    flags = (RESET, WENT_BACK, SUCCESS, FAIL, TRUNCATED, REWARD_NONFINITE)
    assert all(sum(bool(one & other) for other in flags) == 1 for one in flags)


def test_the_newest_moment_is_kept_whatever_it_takes_and_only_that() -> None:
    history = filled(3, limit=0)
    assert (history.first, history.last, len(history)) == (2, 2, 1)


def test_pictures_that_fill_just_the_half_are_all_kept() -> None:
    history = filled(5)
    before = history.used
    history.add_pictures(PastPictures(0, (picture(0),)))
    each = history.used - before
    assert each > 64 * 64 * 3
    exact, less = History(table(), 8 * each), History(table(), 8 * each - 2)
    for one in (exact, less):
        one.add(stepped(0))
        for env in range(4):
            one.add_pictures(PastPictures(0, (replace(picture(0), env=env),)))
    assert [len(moment.pictures) for one in (exact, less) for moment in one.between(0, 0)] == [4, 0]


def test_a_picture_is_counted_once_and_given_back_with_its_moment() -> None:
    history = filled(2)
    without = history.used
    history.add_pictures(PastPictures(0, (picture(0),)))
    with_one = history.used
    for _ in range(3):
        history.add_pictures(PastPictures(0, (picture(0),)))
    assert history.used == with_one, "one in the place of another"
    history.add_pictures(PastPictures(0, (picture(0, 128),)))
    assert history.used - with_one == 3 * (128**2 - 64**2)
    history.limit = 2 * (history.used - without)  # room for the picture, until its moment is dropped
    for number in range(2, 50):
        history.add(stepped(number))
    assert history.first > 0
    assert history.used == sum(moment.size for moment in history.between(0, 99))


def test_the_step_of_a_task_without_a_robot_keeps_its_reward() -> None:
    history = filled(1)
    for number in (1, 2):
        step = stepped(number)
        history.add(replace(step, step=replace(step.step, action=None)))
    assert history.rewards(0, 1, 2).tolist() == [1, 2]


def test_a_task_that_only_fails_has_its_failures_told() -> None:
    history = filled(1)
    step = stepped(1)
    history.add(replace(step, step=replace(step.step, evaluate={"fail": mask_of((1,))})))
    assert (history.events(1, 1, 1), history.events(0, 1, 1)) == ([(1, FAIL)], [])
