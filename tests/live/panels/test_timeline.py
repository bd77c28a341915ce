"""The timeline on a page, without a browser, on a session with a synthetic scene."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from tests.drive.live import Live
from tests.drive.panels import Clock, Panels
from tests.drive.scenes import EMPTY, running
from tests.drive.session import wait_until
from workbench.app.live_page import Page
from workbench.app.session import Session
from workbench.commands import COMMANDS
from workbench.live.commands import ResetAll, SetSpeed, Step, TogglePlay
from workbench.live.events import MomentShown
from workbench.live.history.curves import Column
from workbench.live.past import Strip, TimelineView
from workbench.live.timeline_commands import (
    ContinueFromHere,
    GoToFirst,
    GoToLast,
    Seek,
    SeekBack,
    StepBack,
    StepForward,
    UndoReset,
    ZoomTimeline,
)
from workbench.live.view import SessionView
from workbench.page.command import Command, Refused
from workbench.record.state import RecordingStatus

pytestmark = pytest.mark.thorough

SLIDER = "step of the past"


@dataclass
class EnvMoment:
    """A session with a history, and its page."""

    session: Session
    page: Page
    panels: Panels
    clock: Clock

    @property
    def past(self) -> TimelineView:
        return self.session.view().timeline

    def draw(self) -> None:
        self.clock.passes()
        self.page.redraw()

    def step(self, count: int) -> None:
        for _ in range(count):
            last = self.past.last
            self.session.do(Step())
            wait_until(self.session, lambda view, n=last: view.timeline.last > n, "a step")
        self.draw()

    def ends(self) -> tuple[int, int, int]:
        slider = self.panels.field(SLIDER)
        assert slider.bounds is not None
        return int(slider.bounds[0]), int(slider.bounds[1]), slider.value

    def strip(self) -> str:
        return self.panels.html("wb-timeline") + self.panels.html("wb-legend-row")

    def hand(self) -> np.ndarray:
        (hand, *_) = self.panels.bodies("arm hand")
        return hand.batched_positions.copy()


@pytest.fixture
def lived(panels: Panels, clock: Clock, scripted_session: Callable[..., Session]) -> EnvMoment:
    session = scripted_session(3)
    page = Page(panels.server, panels.visitors, session, clock=clock)
    panels.visitors.do = page.do
    return EnvMoment(session, page, panels, clock)


def test_the_view_the_numbers_and_the_status_line_show_the_past_moment(lived: EnvMoment) -> None:
    lived.step(2)
    there = lived.hand()
    lived.step(2)
    assert not np.array_equal(lived.hand(), there)
    lived.panels.set(SLIDER, -2)
    lived.draw()
    assert lived.past.shown == 2
    assert np.array_equal(lived.hand(), there)
    assert "2 steps ago" in lived.panels.html("wb-status") and "2 steps ago" in lived.strip()
    ways = (ContinueFromHere(), ContinueFromHere(scope="all"), ContinueFromHere(scope="into all"))
    assert all(map(lived.panels.presses, ways)) and lived.ends() == (-4, 0, -2)
    lived.panels.do(GoToLast())
    lived.draw()
    assert "live" in lived.strip() and not lived.panels.presses(ContinueFromHere())


def test_the_slider_ends_follow_a_moment_beyond_them_at_once_and_others_rarely(lived: EnvMoment) -> None:
    lived.step(4)
    last = lived.past.last
    lived.panels.do(ResetAll())
    wait_until(lived.session, lambda view: view.timeline.last > last, "the reset")
    lived.step(2)
    lived.panels.ask(ZoomTimeline(episode_only=True))
    lived.page.redraw()
    assert lived.ends() == (-2, 0, 0)
    lived.session.do(Step())
    wait_until(lived.session, lambda view: view.timeline.last == 8, "a step")
    lived.session.dispatch(MomentShown(6))
    lived.page.redraw()
    assert lived.ends() == (-2, 0, -1), "a moment within them does not disturb a drag of the slider"
    lived.session.dispatch(MomentShown(2))
    lived.page.redraw()
    assert lived.ends() == (-7, -3, -5), "the last episode"
    lived.draw()
    assert lived.ends() == (-7, -3, -5)


def test_an_outdated_slider_value_shows_the_nearest_moment(lived: EnvMoment) -> None:
    lived.step(3)
    lived.panels.do(SeekBack(steps=-9))
    assert lived.past.shown == lived.past.first and lived.past.last == 3
    with pytest.raises(Refused):
        COMMANDS.decode("seek_back", {"steps": 1})


def test_a_single_moment_has_a_valid_slider_range(lived: EnvMoment) -> None:
    lived.draw()
    assert lived.panels.shows(SLIDER), "the panel does not grow at the first step"
    assert lived.panels.field(SLIDER).off
    assert lived.ends() == (-1, 0, 0), "a browser divides by the range"
    assert "history: 0 steps," in lived.strip()
    lived.step(1)
    assert not lived.panels.field(SLIDER).off and lived.ends() == (-1, 0, 0)
    assert "history: 1 step," in lived.strip()


# --- on a view without a session -----------------------------------------------------------------------

REACHED = TimelineView(0, 40, None, 0, 40, 40, 3 * 2**20, 2**28, 41)
PAST = replace(REACHED, shown=30, tick=30, can_continue=True)


class Asked:
    """Answers the timeline's questions about the strip, and notes them."""

    def __init__(self, live: Live) -> None:
        self.strips: list[tuple[int, int, str]] = []
        live.session.answers["strip"] = self.strip

    def strip(self, low: int, high: int, column: Column) -> Strip:
        self.strips.append((low, high, column.label))
        values = np.linspace(2, 5, high - low + 1, dtype=np.float32)
        return Strip(low, high, (), values, (), ((low, high, False, ""),))


def test_the_transport_offers_what_is_possible_now(live_page: Live) -> None:
    def offered(**changes: Any) -> dict[str, Command | None]:
        live_page.show(running(2, **{"timeline": REACHED, **changes}))
        names = "Play", "Pause", "Step", "Step back", "Step forward", "First moment", "Live"
        buttons = {one.text.strip(): one.command for one in live_page.buttons()}
        return {name: buttons[name] for name in names if name in buttons}

    live = {"Step": Step(), "Step back": StepBack(), "First moment": GoToFirst(), "Live": None}
    assert offered() == {"Pause": TogglePlay(), **live}
    assert offered(playing=False) == {"Play": TogglePlay(), **live}
    past = {"Step back": StepBack(), "Step forward": StepForward(), "First moment": GoToFirst()}
    assert offered(timeline=PAST) == {"Pause": TogglePlay(), **past, "Live": GoToLast()}
    assert offered(state="stopped", playing=False) == {**live, "Play": None, "Step": None}
    nothing = offered(timeline=TimelineView())
    assert nothing["Step back"] is nothing["First moment"] is None
    live_page.show(running(2, timeline=REACHED, recording=RecordingStatus(True, (0,), 1.0)))
    assert live_page.shows("Stop recording") and not live_page.shows("Record")


def test_the_speed_is_that_of_the_settings_whatever_it_is(live_page: Live) -> None:
    for speed, label in ((2.0, "2 ×"), (math.inf, "unlimited"), (3.0, "3 ×"), (1.0, "1 ×")):
        live_page.show(running(2, speed=speed, timeline=REACHED))
        assert live_page.typed("Speed") == label and ("3 ×" in live_page.field("Speed").options) == (
            speed == 3
        )
    live_page.set("Speed", "unlimited")
    live_page.set("Speed", "0.25 ×")
    assert live_page.asked == [SetSpeed(speed=None), SetSpeed(speed=0.25)]
    live_page.show(running(2, timeline=REACHED, state="stopped"))
    assert live_page.field("Speed").off


def test_the_slider_names_the_step_that_it_shows_while_steps_are_made(live_page: Live) -> None:
    def show(view: TimelineView, seconds: float = 60.0) -> tuple[Any, Any]:
        live_page.show(running(2, timeline=view), seconds=seconds)
        return live_page.field(SLIDER).bounds, live_page.typed(SLIDER)

    later = replace(PAST, last=43, last_tick=43)
    assert show(REACHED) == ((-40, 0), 0) and show(PAST) == ((-40, 0), -10)
    assert show(later, 0.1) == ((-40, 0), -10), "the ends do not move under a drag"
    live_page.set(SLIDER, -15)
    assert live_page.asked[-1] == Seek(step=25)
    assert show(later) == ((-43, 0), -13)
    live_page.set(SLIDER, -15)
    assert live_page.asked[-1] == Seek(step=28)
    live_page.set(SLIDER, 0)
    live_page.do(GoToFirst())
    assert live_page.asked[-2:] == [GoToLast(), MomentShown(0)]
    live_page.session.answers["episode_ticks"] = lambda: (10, 35)
    live_page.ask(ZoomTimeline(episode_only=True))
    assert show(later, 0.1) == ((-33, -8), -13)
    live_page.set(SLIDER, -20)
    live_page.do(GoToFirst())
    live_page.set(SLIDER, -8)
    assert live_page.asked[-3:] == [Seek(step=one, episode_only=True) for one in (23, 10, 35)]
    live_page.ask(ZoomTimeline(episode_only=False))
    assert show(later, 0.1) == ((-43, 0), -13)
    assert show(TimelineView())[0] == (-1, 0) and live_page.field(SLIDER).off


def test_the_strip_is_that_of_the_shown_env_range_and_curve(live_page: Live) -> None:
    asked = Asked(live_page)
    view = running(2, timeline=REACHED)
    assert view.step is not None and view.task is not None
    jointed = replace(view, task=replace(view.task, joints=("hinge",)))
    jointed = replace(jointed, step=replace(view.step, qpos=np.zeros((2, 1), np.float32)))

    def drawn(view: SessionView) -> list[tuple[int, int, str]]:
        asked.strips.clear()
        live_page.show(view)
        return [*asked.strips]

    whole = [(0, 40, "reward")]
    assert drawn(view) == whole and drawn(view) == []
    for change in (
        {"settings": replace(view.settings, selected_env=1)},
        {"timeline": PAST},
        {"timeline": replace(REACHED, first=1)},
    ):
        assert drawn(replace(view, **change)) == whole, change
        assert drawn(view) == whole, change
    assert drawn(replace(view, timeline=replace(REACHED, last=43, last_tick=43)))[-1] == (0, 43, "reward")
    assert drawn(jointed) == whole
    assert set(live_page.field("Curve").options) == {"reward", "success", "hinge"}
    live_page.set("Curve", "hinge")
    assert drawn(jointed) == [(0, 40, "hinge")] and live_page.typed("Curve") == "hinge"
    assert "hinge" in live_page.html("wb-legend-row")
    assert drawn(view) == whole and live_page.typed("Curve") == "reward", "this task has no such entry"
    assert drawn(jointed) == [(0, 40, "hinge")], "and this one has it again"
    span, used, limit = re.findall(
        r"from (2 to 5)\b.*?, ([\d.]+) of ([\d.]+) MB", live_page.html("wb-legend-row"), re.S
    )[0]
    assert (span, used, limit) == ("2 to 5", "3.0", "256")
    live_page.show(replace(EMPTY, task=None))
    assert "wb-strip" not in live_page.html()
    assert drawn(jointed) == [(0, 40, "hinge")] and "wb-strip" in live_page.html()


def test_the_place_is_that_of_the_selected_envs_episode(live_page: Live) -> None:
    Asked(live_page)

    def place(num_envs: int, env: int, limit: int | None = 50) -> tuple[str, str]:
        view = running(num_envs, selected_env=env, timeline=REACHED)
        assert view.step is not None and view.task is not None
        step = replace(view.step, elapsed_steps=np.arange(3, 3 + num_envs, dtype=np.int32))
        task = replace(view.task, max_episode_steps=limit)
        live_page.show(replace(view, step=step, task=task))
        return re.findall(r'title="([\d.]+) s [^"]*">([^<]*)</span>', live_page.html("wb-where"))[0]

    assert place(3, 2) == ("0.25", "env 2: step 5 / 50")
    assert place(3, 1, None) == ("0.20", "env 1: step 4")
    assert place(1, 0) == ("0.15", "step 3 / 50")


def test_going_back_and_on_is_offered_where_it_is_possible(live_page: Live) -> None:
    ways = [ContinueFromHere(), ContinueFromHere(scope="all"), ContinueFromHere(scope="into all")]

    def offered(num_envs: int, view: TimelineView) -> list[bool]:
        live_page.show(running(num_envs, timeline=view))
        return [live_page.presses(way) for way in ways]

    assert offered(2, PAST) == [True] * 3 and offered(1, PAST) == [True, False, False]
    assert offered(2, replace(PAST, can_continue=False)) == offered(2, REACHED) == [False] * 3
    live_page.show(running(2, timeline=replace(PAST, undo="reset of env 1")))
    assert live_page.button("undo reset of env 1").command == UndoReset()
    live_page.show(running(2, timeline=PAST))
    assert live_page.button("undo").command is None
    for told in ({"not_carried": ("actor ball: gone",)}, {"arrived": "replayed"}):
        live_page.show(running(2, timeline=replace(REACHED, **told)))
        assert "".join(one if isinstance(one, str) else one[0] for one in told.values()) in live_page.html(
            "wb-timeline-hint"
        )
