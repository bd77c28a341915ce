"""Events, curves, outcome and pictures of an episode, and what the panels make of them."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.drive.episodes import BODY, made, poses_of
from tests.drive.panels import Panels
from tests.drive.scenes import camera
from tests.review.recordings import after, aligned, opened, review_of, three
from workbench.episodes.episode import CameraTrack, Episode
from workbench.episodes.reader.reader_process import ReaderBusy
from workbench.live.messages import CameraRequest
from workbench.live.timeline_commands import Seek
from workbench.page.command import Refused
from workbench.page.widgets.templates import colour
from workbench.review.body_panel import body_html
from workbench.review.commands import (
    AlignRecordings,
    ArrangeRecordings,
    ChooseReviewCurve,
    ChooseTolerance,
    CompareWith,
    ContinueLive,
    SelectRecording,
    ToggleOverlaid,
)
from workbench.review.compare_panel import ReviewComparePanel, headline, notes
from workbench.review.curves_panel import ReviewCurves, step_of
from workbench.review.differences import difference
from workbench.review.panel import ReviewPanel, assignments, local_time
from workbench.review.view import (
    ACTION,
    MAX_LINES,
    REWARD,
    TERMS,
    Opened,
    PictureReader,
    curves,
    find_events,
    outcome_text,
)

NAN = np.nan
PERSON: Any = SimpleNamespace(name="")


def test_events_are_where_something_becomes_true_and_in_the_order_of_time() -> None:
    episode = made(6)
    episode.evaluate = {
        "grasped": np.array([0, 1, 0, 1, 1, 0, 1], bool),
        "success": np.array([0, 0, 0, 1, 1, 0, 0], bool),
        "fail": np.array([NAN, 0, 1, 1, 0, 0, 0]),  # not known at the reset
        "reward_terms/near": np.array([0, 0, 1, 1, 0, 0, 0], bool),
        "distance": np.arange(7.0),
        "both": np.ones((7, 2), bool),
        "one": np.array([[False]] * 5 + [[True]] * 2),
    }
    episode.truncated = np.array([0, 0, 0, 0, 1, 1], bool)
    episode.reward = np.array([0, NAN, NAN, 0, np.inf, 0], np.float32)
    events = [(event.state, event.name.split()[0], event.style) for event in find_events(episode)]
    assert events == [
        (0, "reset", "reset"),
        (1, "grasped", "other"),
        (2, "fail", "fail"),
        (2, "reward", "odd"),
        (3, "success", "success"),
        (3, "grasped", "other"),
        (5, "time", "limit"),
        (5, "reward", "odd"),
        (5, "one", "other"),
        (6, "grasped", "other"),
    ]
    episode = made(100)
    episode.evaluate = {"flicker": np.arange(101) % 2 == 1, "success": np.zeros(101, bool)}
    episode.truncated[:] = False
    assert [event.state for event in find_events(episode) if event.name == "flicker"] == [1]


def test_each_number_has_a_line_at_its_states() -> None:
    episode = made(3)
    many = np.arange(4 * 20.0).reshape(4, 20)
    episode.evaluate |= {
        "reward": np.array([5, 6, 7, 8]),
        "corner": np.array([[1, 2]] * 4),
        "many": many,
        "name": np.array(["a"] * 4),
        "reward_terms/vector": np.ones((4, 2)),
    }
    episode.batch = {"mean": np.arange(4.0)}
    episode.action = np.array([[0, 3], [1, 4], [2, 5]], np.float32)
    found = curves(episode)
    lines = {(entry, line): column for entry, all in found.items() for line, column in all.items()}

    def line(entry: str, of: str = "") -> tuple[list[int], list[float]]:
        states, values = lines[entry, of or entry]
        return states.tolist(), values.tolist()

    assert line(REWARD) == ([1, 2, 3], [1, 2, 3]), "no step led to the first state"
    assert line("distance")[0] == [0, 1, 2, 3]
    assert line(TERMS, "reach") == ([1, 2, 3], [0.5, 1, 1.5]) and set(found[TERMS]) == {"reach"}
    assert line(ACTION, "gripper") == ([1, 2, 3], [3, 4, 5]) and list(found[ACTION]) == list(
        episode.action_names
    )
    assert line("corner", "corner[1]") == ([0, 1, 2, 3], [2, 2, 2, 2])
    assert len(found["many"]) == MAX_LINES and line("many", "many[3]")[1] == many[:, 3].tolist()
    assert "name" not in found
    (own,) = (all["reward"] for entry, all in found.items() if entry != REWARD and "reward" in all)
    assert own[1].tolist() == [5, 6, 7, 8], "an entry of evaluate with the name of the reward"
    (batch,) = (all for entry, all in found.items() if entry.startswith("mean"))
    assert next(iter(batch.values()))[1].tolist() == [0, 1, 2, 3]
    episode.info = replace(episode.info, env_kwargs={"reward_mode": "none"})
    episode.action = np.zeros((3, 0), np.float32)
    assert not {REWARD, ACTION} & set(curves(episode))


@pytest.mark.parametrize(
    ("success", "fail", "most", "tone", "word"),
    [
        ([0, 0, 1, 1], None, 3, "good", "success"),
        ([0, 1, 1, 0], None, 3, "warn", "1"),
        ([0, 0, 0, 0], None, 3, "bad", "no success"),
        ([0, 0, 0, 0], None, 50, "", "stopped"),
        ([0, 0, 0, 1], [0, 0, 0, 1], 3, "bad", "failed"),
        ([0, 0, 0, 1], [0, 1, 1, 0], 3, "good", "success"),
        (None, None, 3, "", "no success"),
    ],
)
def test_the_outcome_is_that_of_the_last_state(
    success: list[int] | None, fail: list[int] | None, most: int, tone: str, word: str
) -> None:
    episode = made(3, max_episode_steps=most)
    given = {"success": success, "fail": fail}
    episode.evaluate = {name: np.array(row, bool) for name, row in given.items() if row is not None}
    text, found = outcome_text(episode)
    assert found == tone and word in text


class Encoded(list[np.ndarray]):
    """Pictures of one modality that count how often one is decoded, and may fail."""

    def __init__(self, values: list[int]) -> None:
        super().__init__(np.full((6, 8, 3), value, np.uint8) for value in values)
        self.decoded = 0
        self.fails: Exception | None = None

    def __getitem__(self, index: Any) -> Any:
        self.decoded += 1
        if self.fails is not None:
            raise self.fails
        return super().__getitem__(index)


def with_pictures(name: str = "base_camera", **info: Any) -> tuple[Episode, Encoded]:
    """Pictures of states 1, 3 and 5 of six, whose brightness is ten times the state."""
    pictures, depth = Encoded([10, 30, 50]), Encoded([1, 3, 5])
    poses = np.tile(np.array([0, 0, 1, 1, 0, 0, 0], np.float32), (3, 1))
    poses[:, 0] = (1, 3, 5)
    track = CameraTrack(camera(name), np.array([1, 3, 5]), poses, pictures, depth)  # type: ignore[arg-type]
    return replace(made(6, **info), cameras=[track]), pictures


def test_a_camera_shows_its_newest_picture_of_the_state_for_the_env() -> None:
    episode, pictures = with_pictures()
    reader = PictureReader()
    both = [
        CameraRequest("base_camera", "sensor", ("rgb", "segmentation")),
        CameraRequest("gone", "human", ("rgb",)),
    ]

    def brightness(state: int, env: int = 0) -> int | None:
        found = reader.pictures(episode, state, both, env)
        assert len(found) <= 1
        for picture in found.values():
            assert picture.env == env and picture.pose[0] * 10 == picture.rgb.max()  # type: ignore[union-attr]
            assert picture.depth is None
            return int(picture.rgb.max())  # type: ignore[union-attr]
        return None

    assert [brightness(state) for state in range(7)] == [None, 10, 10, 30, 30, 50, 50]
    decoded = pictures.decoded
    assert brightness(5) == 50 and pictures.decoded == decoded, "it is kept"
    assert brightness(5, env=2) == 50
    depth = reader.pictures(episode, 5, [CameraRequest("base_camera", "sensor", ("depth",))], 2)
    assert all(one.rgb is None and one.depth is not None for one in depth.values()) and depth
    assert brightness(5, env=2) == 50
    pictures.fails = ReaderBusy("opening another one")
    assert brightness(1, env=2) == 50, "the last one stays"  # type: ignore[comparison-overlap]


def test_a_picture_that_cannot_be_read_is_named_until_another_recording_is_open() -> None:
    episode, pictures = with_pictures()
    other, _ = with_pictures(pictures="fast")
    reader = PictureReader()
    wanted = [CameraRequest("base_camera", "sensor", ("rgb",))]
    pictures.fails = ReaderBusy("busy")
    assert reader.pictures(episode, 3, wanted, 0) == {} and not reader.problem
    pictures.fails = OSError("bad block")
    assert reader.pictures(episode, 3, wanted, 0) == {}
    assert "base_camera" in reader.problem and "bad block" in reader.problem
    (picture,) = reader.pictures(other, 3, wanted, 1).values()
    assert not reader.problem and picture.degree == "fast"
    assert [one.modalities for one in reader.cameras(episode)] == [("rgb", "depth")]
    episode.cameras[0].frame = np.zeros(0, np.int64)
    assert reader.cameras(episode) == ()


def test_the_numbers_of_a_state_are_those_of_the_step_that_led_there() -> None:
    episode = made(4, success_from=3)
    episode.action = np.arange(8, dtype=np.float32).reshape(4, 2)
    episode.truncated[3] = True
    for state in range(5):
        step = step_of(episode, state)
        assert step.elapsed_steps.tolist() == [state]
        assert step.reward.tolist() == [state] and step.truncated.tolist() == [state == 4]
        assert step.terminated.tolist() == [state >= 3]
        assert (None if step.action is None else step.action.tolist()) == (
            None if state == 0 else [episode.action[state - 1].tolist()]
        )
        assert step.evaluate["distance"].tolist() == [1 - state / 100]
        np.testing.assert_array_equal(step.poses[0], poses_of(episode)[state])


def test_the_chosen_entry_is_drawn_for_all_and_the_terms_for_the_selected_recording(panels: Panels) -> None:
    panel = ReviewCurves(panels.server)
    view = aligned((10, 5), (6, 2), selected=1)
    for at, one in enumerate(view.opened):
        one.episode.action[:] = at + 1
        one.episode.evaluate["height"] = np.arange(one.length + 1) * (at + 1.0)
    del view.opened[0].episode.evaluate["distance"]

    def charts() -> dict[str, Any]:
        panel.draw(view)
        return {chart.title: chart for chart in panels.charts()}

    assert "success" in charts()
    with pytest.raises(Refused):
        panel.do(ChooseReviewCurve(curve="speed"), PERSON)
    panel.do(ChooseReviewCurve(curve="height"), PERSON)
    drawn = charts()["height"]
    np.testing.assert_allclose(drawn.of(colour(0)), [[s - 5, s] for s in range(11)], atol=0.05)
    np.testing.assert_allclose(drawn.of(colour(1)), [[s - 2, 2 * s] for s in range(7)], atol=0.05)
    panel.do(ChooseReviewCurve(curve="distance"), PERSON)
    assert len(charts()["distance"].lines) == 1, "only one recording has it"
    panel.do(ChooseReviewCurve(curve=f"{ACTION}: gripper"), PERSON)
    drawn = charts()[f"{ACTION}: gripper"]
    assert [set(drawn.of(colour(at))[:, 1].round(2)) for at in (0, 1)] == [{1.0}, {2.0}]
    (terms,) = (chart for title, chart in charts().items() if title.startswith(f"{ACTION}, "))
    assert all(set(points[:, 1].round(2)) == {2.0} for _, points in terms.lines)
    assert terms.title.endswith("B") and len(terms.lines) == 2
    assert {tuple(points[[0, -1], 0].round(1)) for _, points in terms.lines} == {(-1.0, 4.0)}, (
        "as B is aligned"
    )


def test_differences_count_from_the_alignment() -> None:
    a, b = made(8), made(10)
    a.evaluate |= {"corner": np.zeros((9, 3)), "near": np.zeros(9, bool)}
    b.evaluate |= {"corner": np.zeros((11, 3)), "near": np.zeros(11, bool)}
    for one in (a, b):
        poses_of(one)[:, BODY["cube"], 0] = 0
        one.reward[:], one.evaluate["distance"][:], one.evaluate["reward_terms/reach"][:] = 1, 0, 0
    b.evaluate["corner"][6, 1:] = (2.5, 3)
    b.evaluate["corner"][9, 0] = -4
    b.evaluate["near"][5] = True
    poses_of(b)[7:, BODY["cube"], 2] += 0.25
    found = difference(a, b, (1, 3))
    # Position p is state p + 1 of A and p + 3 of B.
    assert (found.begin, found.compared) == (-1, 9)
    numbers = {one.name: one for one in found.numbers}
    assert [one.position for one in found.numbers[:4]] == [-1, -1, 2, 3], "the first differences come first"
    assert (numbers["near"].position, numbers["near"].values, numbers["near"].largest) == (2, "no → yes", "")
    assert (numbers["corner"].position, numbers["corner"].largest) == (3, "4")
    assert numbers["corner"].values.startswith("[1]") and "2.5" in numbers["corner"].values
    assert found.bodies is not None and found.bodies.position == 4 and found.body == "cube"
    np.testing.assert_allclose(found.apart, [0] * 5 + [0.25] * 4, atol=1e-6)
    # The first compared state of A is its start: no step led there.
    assert numbers["reward"].position == -1 and numbers["reward"].values.startswith("—")


def test_what_the_compared_recordings_do_not_share_is_noted() -> None:
    def of(steps: int = 4, **info: Any) -> Opened:
        episode = made(steps, **info)
        return Opened(str(id(episode)), "x.rrd", episode, ())

    def count(a: Opened, b: Opened) -> int:
        return len(notes(a, b, difference(a.episode, b.episode, (0, 0))))

    assert count(of(), of()) == 0
    for other in (of(task="B-v1"), of(seed=8), of(seed=-1), of(5), of(control_dt=0.1)):
        assert count(of(), other) == 1 == count(other, of())
    assert count(of(), of(6, control_dt=0.1, seed=4)) == 3
    batch = of()
    batch.episode.batch = {"mean": np.zeros(5)}
    (note,) = notes(of(), batch, difference(of().episode, batch.episode, (0, 0)))
    assert "mean" in note
    moved = of()
    poses_of(moved.episode)[3:, BODY["cube"], 2] += 0.5
    found = difference(of().episode, moved.episode, (0, 0))
    assert "3" in headline(found) and "cube" in headline(found)
    same = difference(of().episode, of().episode, (0, 0))
    slightly = difference(of().episode, moved.episode, (0, 0), tolerance=1.0)
    bare = difference(of().episode, replace(of().episode, geometry=None, poses=None), (0, 0))
    assert len({headline(one) for one in (found, same, slightly, bare)}) == 4


def test_the_first_recording_is_compared_with_the_chosen_one(panels: Panels) -> None:
    review, _ = review_of(a=made(4), b=made(4, success_from=3), c=made(4, success_from=2))
    view = opened(review, "a", "b", "c")
    panel = ReviewComparePanel(panels.server, review)

    found = {}
    for index in (1, 2):
        panel.do(CompareWith(index=index), PERSON)
        panel.draw(review.view())
        found[index] = panels.html()
    assert found[1] != found[2] and len(view.opened) == 3
    with pytest.raises(Refused):
        panel.do(CompareWith(index=3), PERSON)
    before = panel.key(review.view())
    panel.do(ChooseTolerance(metres=1e-2), PERSON)
    assert panel.key(review.view()) != before


def test_a_recording_goes_on_live_from_its_own_state(panels: Panels) -> None:
    review, _ = review_of(a=made(10, success_from=4), b=made(12, success_from=7))
    opened(review, "a", "b")
    gone: list[tuple[str, int]] = []
    panel = ReviewPanel(panels.server, review, lambda *given: gone.append(given), lambda: "")
    panel.do(ContinueLive(), PERSON)
    review.do(AlignRecordings(at="first success"))
    review.do(Seek(step=-2))
    panel.do(ContinueLive(), PERSON)
    panel.do(SelectRecording(id="b"), PERSON)
    panel.do(ContinueLive(), PERSON)
    assert gone == [("a", 0), ("a", 2), ("b", 5)]
    assert panel.ghosts
    panel.do(ToggleOverlaid(), PERSON)
    assert not panel.ghosts
    panel.do(ArrangeRecordings(layout="overlaid"), PERSON)
    assert panel.ghosts
    panel.lay_side_by_side()
    assert not panel.ghosts


def test_the_pose_of_a_body_is_that_of_the_selected_recording_and_state() -> None:
    view = after(three(), Seek(step=4), AlignRecordings(at="first success")).view
    assert view.states == (4, 7, 0)
    poses_of(view.opened[0].episode)[4, BODY["cube"], :3] = (0.125, 0.25, 0.375)
    poses_of(view.opened[1].episode)[7, BODY["cube"], :3] = (0.5, 0.625, 0.75)
    assert "0.375" in body_html("cube", view) and "0.75" not in body_html("cube", view)
    other = body_html("cube", replace(view, selected=1))
    assert "0.625" in other and "0.375" not in other
    assert not body_html("", view) and not body_html("sphere", view)


def test_options_and_times_are_written_for_people() -> None:
    assert assignments({"robot_uids": "panda", "name": "two words"}) == "robot_uids=panda, name='two words'"
    assert local_time("not a time") == "not a time"
