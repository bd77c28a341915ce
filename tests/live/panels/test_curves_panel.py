"""The curves of the Reward tab: which ones, of which episodes, and what a press does."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.drive.env_rows import rows_of
from tests.drive.live import Live
from tests.drive.scenes import running, step_of
from workbench.envs.step_result import StepResult
from workbench.live.commands import ToggleCurve
from workbench.live.events import EpisodeStepShown
from workbench.live.history.curves import Column, Group, columns_of
from workbench.live.history.moments import EpisodeNumbers
from workbench.live.panels.reward_panel import BESIDE_COLOUR, COLOURS, MAX_CHARTS
from workbench.live.past import TimelineView
from workbench.live.timeline_commands import SeekOnCurve
from workbench.live.view import SessionView
from workbench.page.commands import TellOpenTab

JOINTS = ("hinge", "slide")
ONE = COLOURS[0]


def step(number: int, num_envs: int, **entries: Any) -> StepResult:
    """The reward of env k at step t is k + t N."""
    evaluate = {"success": np.zeros(num_envs, bool), **entries}
    result = step_of(np.zeros((num_envs, 1, 7), np.float32), **evaluate)
    reward = np.arange(num_envs, dtype=np.float32) + number * num_envs
    moved = np.full((num_envs, 2), number, np.float32)
    return replace(result, reward=reward, qpos=moved, elapsed_steps=np.full(num_envs, number, np.int32))


class Episodes:
    """A session in which each env is at step `length` of its episode, after `ended` equal ones."""

    def __init__(self, live: Live, length: int, num_envs: int, ended: int = 0, **entries: Any) -> None:
        self.live, self.length, self.num_envs, self.ended = live, length, num_envs, ended
        self.entries = entries
        live.session.answers["episodes"] = self.read

    def read(self, env: int, last: int, columns: Sequence[Column], before: int) -> tuple[EpisodeNumbers, ...]:
        steps = np.arange(1, self.length + 1)
        made = [columns_of(step(int(number), self.num_envs, **self.entries), JOINTS) for number in steps]
        values = {column: np.array([one[column][env] for one in made], np.float32) for column in columns}
        return (EpisodeNumbers(steps, values, None),) * (1 + min(before, self.ended))

    def view(self, env: int = 0, past: int | None = None) -> SessionView:
        """A view after these steps; `past` is the shown step, if not the last."""
        shown = step(self.length if past is None else past, self.num_envs, **self.entries)
        timeline = TimelineView(0, self.length, past, tick=self.length, moments=self.length + 1)
        view = running(self.num_envs, selected_env=env)
        assert view.task is not None
        return replace(view, step=shown, timeline=timeline, task=replace(view.task, joints=JOINTS))


@pytest.fixture
def live(open_live: Live) -> Live:
    open_live.show(running(4))
    open_live.asked.clear()
    return open_live


def reward(length: int, num_envs: int, env: int) -> list[list[float]]:
    return [[number, env + number * num_envs] for number in range(1, length + 1)]


def test_the_episode_is_drawn_over_the_last_ten(live: Live) -> None:
    live.show(Episodes(live, 5, 4, ended=20).view(env=2))
    chart = live.part("Reward").charts()[0]
    np.testing.assert_allclose(chart.of(ONE), reward(5, 4, 2), atol=0.05)
    assert chart.names == ["env 2"] and chart.cursor == pytest.approx(5, abs=0.01)
    assert len(chart.of(BESIDE_COLOUR)) == 10 * 5


@pytest.mark.thorough
def test_a_long_episode_is_drawn_as_few_points(live: Live) -> None:
    live.show(Episodes(live, 3000, 2).view())
    for chart in live.part("Reward").charts():
        points = chart.of(ONE)
        assert len(points) < 1300
        assert points[0, 0] == pytest.approx(1, abs=2) and points[-1, 0] == pytest.approx(3000, abs=2)


def test_the_cursor_is_at_the_shown_step(live: Live) -> None:
    live.show(Episodes(live, 50, 4).view(env=3, past=17))
    drawn = live.part("Reward").charts()
    assert [chart.title for chart in drawn] == ["reward", "success"]
    assert drawn[0].cursor == pytest.approx(17, abs=0.05) and drawn[0].legend == (("env 3", "71"),)


def test_each_part_of_the_reward_has_a_line_of_the_selected_env(live: Live) -> None:
    terms: dict[str, Any] = {
        "reward_terms/reach": np.array([1.0, 2, 3]),
        "reward_terms/<b>": np.array([-1.0, -2, -3]),
        "reward_terms/sum": np.zeros((3, 9)),
    }
    live.show(Episodes(live, 4, 3, **terms).view(env=1))
    *_, chart = live.part("Reward").charts()
    assert chart.title == "reward terms" and chart.legend == (("reach", "2"), ("<b>", "-2"))
    assert chart.of(COLOURS[0])[:, 1] == pytest.approx([2.0] * 4, abs=0.01)
    assert chart.of(COLOURS[1])[:, 1] == pytest.approx([-2.0] * 4, abs=0.01)
    assert "No curve of sum" in live.part("Reward").html()


def test_of_many_lines_in_one_chart_the_first_ones_are_drawn(live: Live) -> None:
    terms: dict[str, Any] = {f"reward_terms/{k}": np.full(3, float(k)) for k in range(len(COLOURS) + 8)}
    live.show(Episodes(live, 4, 3, ended=3, **terms).view())
    *_, chart = live.part("Reward").charts()
    assert chart.names == [str(k) for k in range(len(COLOURS))]
    assert [chart.of(colour)[0, 1] for colour in COLOURS[:3]] == pytest.approx([0, 1, 2], abs=0.1)


def test_any_entry_or_joint_can_be_chosen_and_the_choice_is_kept_per_task(live: Live) -> None:
    entries = {"height": np.array([0.1, 0.2]), "at": np.ones((2, 3)), "touches": np.array([True, False])}
    view = Episodes(live, 3, 2, **entries).view(env=1)
    live.show(view)
    for entry in ((Group.EVALUATE, "height"), (Group.EVALUATE, "at"), (Group.JOINT, "slide")):
        live.part("Reward").ask(ToggleCurve(group=entry[0].value, name=entry[1]))
    live.part("Reward").ask(ToggleCurve(group="evaluate", name="success"))
    live.show(view)
    titles = ["reward", "height", "at", "joints"]
    assert [chart.title for chart in live.part("Reward").charts()] == titles
    _, height, at, joints = live.part("Reward").charts()
    assert height.of(ONE)[:, 1] == pytest.approx([0.2] * 3, abs=0.01)
    assert at.names == ["at[0]", "at[1]", "at[2]"]
    np.testing.assert_allclose(joints.of(ONE), [[1, 1], [2, 2], [3, 3]], atol=0.01)
    assert view.task is not None
    live.show(replace(view, task=replace(view.task, class_name="Other")))
    assert [chart.title for chart in live.part("Reward").charts()] == ["reward", "success"]
    live.show(view)
    assert [chart.title for chart in live.part("Reward").charts()] == titles


def test_a_press_on_a_curve_shows_that_step_of_the_selected_envs_episode(live: Live) -> None:
    live.show(Episodes(live, 50, 2).view(env=1))
    live.part("Reward").ask(SeekOnCurve(step=1))
    assert live.asked == [EpisodeStepShown(1, 1)]


def test_no_curve_is_drawn_without_a_past(live: Live) -> None:
    live.show(running(4))
    live.show(Episodes(live, 1, 4).view())
    assert (
        live.part("Reward").charts() == []
        and "Curves appear after the second step." in live.part("Reward").html()
    )
    live.show(Episodes(live, 2, 4).view())
    assert len(live.part("Reward").charts()) == 2 and "Curves appear" not in live.part("Reward").html()
    live.show(Episodes(live, 1, 4).view())
    assert live.part("Reward").charts() == []


def test_envs_whose_reward_is_nan_are_counted(live: Live) -> None:
    view = Episodes(live, 50, 4).view()
    assert view.step is not None
    lost = replace(
        view.step, reward=np.array([np.nan, np.nan, np.nan, 1], np.float32), action=np.zeros((4, 1))
    )
    live.show(replace(view, step=lost))
    assert "NaN in 3 of 4 envs" in live.part("Reward").html("wb-warn")
    live.show(view)
    assert "NaN" not in live.part("Reward").html()


def test_episodes_of_other_steps_are_drawn_at_their_own_steps(live_page: Live) -> None:
    def read(env: int, last: int, columns: Sequence[Column], before: int) -> tuple[EpisodeNumbers, ...]:
        def of(steps: np.ndarray) -> EpisodeNumbers:
            return EpisodeNumbers(
                steps, dict.fromkeys(columns, (10.0 * steps + env).astype(np.float32)), None
            )

        return of(np.arange(5, 8)), *[of(np.arange(2, 5))] * min(before, 1)

    episodes = Episodes(live_page, 7, 4)
    live_page.session.answers["episodes"] = read
    live_page.show(episodes.view(env=1))
    chart = live_page.part("Reward").charts()[0]
    np.testing.assert_allclose(chart.of(ONE), [[5, 51], [6, 61], [7, 71]], atol=0.1)
    np.testing.assert_allclose(chart.of(BESIDE_COLOUR), [[2, 21], [3, 31], [4, 41]], atol=0.1)


def test_the_others_are_at_most_ten_and_never_the_env_itself(live_page: Live) -> None:
    episodes = Episodes(live_page, 3, 15, ended=5)
    live_page.show(episodes.view(env=3))
    live_page.part("Reward").set("Compare with", "the other envs")
    live_page.again()
    assert live_page.part("Reward").typed("Compare with") == "the other envs"
    beside = live_page.part("Reward").charts()[0].of(BESIDE_COLOUR)
    others = [env for env in range(11) if env != 3]
    np.testing.assert_allclose(beside[::3, 1], [env + 15 for env in others], atol=0.1)
    alone = Episodes(live_page, 3, 1, ended=2)
    live_page.show(alone.view())
    assert not live_page.part("Reward").shows("Compare with")
    assert len(live_page.part("Reward").charts()[0].of(BESIDE_COLOUR)) == 2 * 3, "there is no other env"
    episodes = Episodes(live_page, 3, 15, ended=5)
    live_page.show(episodes.view(env=3))
    live_page.part("Reward").set("Compare with", "its last ten episodes")
    live_page.again()
    assert len(live_page.part("Reward").charts()[0].of(BESIDE_COLOUR)) == 5 * 3


def test_the_choice_shows_what_is_drawn_and_works_at_once_while_it_plays(live_page: Live) -> None:
    view = Episodes(live_page, 3, 2, height=np.ones(2)).view()
    live_page.do(TellOpenTab(tab="Reward"))
    live_page.show(view)

    def pressed() -> list[str]:
        html = live_page.part("Reward").html("wb-curve-choice")
        return re.findall(r'aria-pressed="true">([^<]*)<', html)

    assert pressed() == ["reward", "success"]
    for drawn in (["reward", "success", "height"], ["reward", "success"]):
        live_page.part("Reward").ask(ToggleCurve(group="evaluate", name="height"))
        live_page.again(0.1)
        assert pressed() == drawn == [chart.title for chart in live_page.part("Reward").charts()]
        assert any(f"{len(drawn)} of 5" in one for one in live_page.folders())


def test_of_many_entries_only_some_get_a_chart(live_page: Live) -> None:
    names = [f"e{k:02}" for k in range(MAX_CHARTS + 5)]
    entries: dict[str, Any] = {name: np.ones(2) for name in names}
    view = Episodes(live_page, 3, 2, **entries).view()
    live_page.show(view)
    for name in names:
        live_page.part("Reward").ask(ToggleCurve(group="evaluate", name=name))
    live_page.again()
    titles = [chart.title for chart in live_page.part("Reward").charts()]
    assert titles == ["reward", "success", *names[:MAX_CHARTS]]


@pytest.mark.parametrize(
    ("mode", "advised"), [("dense", True), ("normalized_dense", True), ("sparse", False), ("none", False)]
)
def test_a_task_without_parts_or_without_a_reward(live_page: Live, mode: str, advised: bool) -> None:
    view = Episodes(live_page, 3, 2).view()
    assert view.task is not None
    live_page.show(replace(view, task=replace(view.task, reward_mode=mode)))
    titles = [chart.title for chart in live_page.part("Reward").charts()]
    assert titles == (["success"] if mode == "none" else ["reward", "success"])
    assert ("info[" in live_page.part("Reward").html()) is advised
    terms: dict[str, Any] = {"reward_terms/reach": np.ones(2)}
    live_page.show(Episodes(live_page, 3, 2, **terms).view())
    assert "info[" not in live_page.part("Reward").html(), "it has parts"


def test_a_reset_is_no_lost_reward(live_page: Live) -> None:
    view = Episodes(live_page, 3, 2).view()
    assert view.step is not None
    reset = replace(view.step, reward=np.full(2, np.nan, np.float32), action=None)
    live_page.show(replace(view, step=reset))
    assert not live_page.part("Reward").html("wb-warn")
    live_page.show(replace(view, step=replace(reset, action=np.zeros((2, 1), np.float32))))
    assert live_page.part("Reward").html("wb-warn")


def test_how_the_episodes_ended_is_counted_over_all_envs(live_page: Live) -> None:
    def counts() -> list[str]:
        return re.findall(r"</i> \D+(\d+)</span>", live_page.part("Reward").html("wb-outcomes"))

    live_page.show(running(6), rows_of())
    assert counts() == ["4", "4", "2"]
    none = np.zeros(6, int)
    live_page.show(running(6), rows_of(ended=none, succeeded=none, failed=none))
    assert counts() == []
