"""The history of a session: its size, its rewards and its events."""

# The views are of a session whose task is loaded: what may be None before is not here.
# pyright: reportOptionalMemberAccess=false

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from tests.drive.session import FakeWorkerSession, fake_worker_session, moment, moments_of
from workbench.envs.camera_data import CameraKind, Picture
from workbench.live.events import MomentShown
from workbench.live.history.moments import FAIL, RESET, REWARD_NONFINITE, SUCCESS, TRUNCATED, WENT_BACK
from workbench.live.messages import CameraRequest, PastPictures, Pictures
from workbench.live.timeline_commands import Seek

EYE = CameraRequest("eye", "sensor")


def picture(env: int, size: int = 64, kind: CameraKind = "sensor", name: str = "eye") -> Picture:
    return Picture(name, kind, env, np.zeros(7, np.float32), np.zeros((size, size, 3), np.uint8))


def pictured(fake: FakeWorkerSession) -> list[int]:
    """Serials of the moments that have a picture of the selected env."""
    session, found = fake.session, []
    session.change(cameras=(EYE,))
    for serial in range(fake.view.timeline.first, fake.view.timeline.last):
        session.happen(MomentShown(serial))
        found += [serial] if fake.view.pictures else []
    session.happen(MomentShown(None))
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
        fake.session.happen(MomentShown(2))
        assert not fake.view.timeline.can_continue, "a part never arrived"
        fake.session.happen(MomentShown(1))
        assert fake.view.timeline.can_continue
        fake.session.happen(MomentShown(None))
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


def test_rewards_of_an_episode_follow_where_it_went_back_to(fake: FakeWorkerSession) -> None:
    fake.play(4)
    fake.back((0,), (1,), 2)
    fake.step()
    fake.reset((2,))
    assert rewards(fake) == [[1, 2, 3], [1, 2, 3, 4, 5], []]
    fake.step()
    fake.session.happen(MomentShown(6))
    assert rewards(fake) == [[1, 2, 3], [1, 2, 3, 4, 5], [1, 2, 3, 4, 5]]


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
