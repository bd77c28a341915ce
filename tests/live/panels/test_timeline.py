"""The timeline on a page, without a browser, on a session with a synthetic scene."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest

from tests.drive.panels import Clock, Panels
from tests.drive.session import wait_until
from workbench.app.live_page import Page
from workbench.app.session import Session
from workbench.commands import COMMANDS
from workbench.live.commands import ResetAll, Step
from workbench.live.events import MomentShown
from workbench.live.past import TimelineView
from workbench.live.timeline_commands import (
    ContinueFromHere,
    GoToFirst,
    GoToLast,
    NextEvent,
    PreviousEvent,
    SeekBack,
    StepBack,
    UndoReset,
    ZoomTimeline,
)
from workbench.page.command import Refused

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


def test_the_timeline_appears_at_the_first_moment_and_offers_only_possible_actions(lived: EnvMoment) -> None:
    assert not lived.panels.part("Timeline").seen, "the page is not drawn yet"
    lived.draw()
    assert lived.panels.part("Timeline").seen
    lived.step(4)
    assert lived.ends() == (-4, 0, 0)
    assert not lived.panels.presses(ContinueFromHere()), "the view is live"
    assert not lived.panels.presses(UndoReset()), "there is nothing before the first reset"
    assert "live" in lived.strip()


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


def test_continuing_takes_the_named_envs_back(lived: EnvMoment) -> None:
    lived.step(4)
    lived.panels.ask(StepBack())
    lived.panels.ask(StepBack())
    lived.draw()
    lived.panels.ask(ContinueFromHere())
    view = wait_until(lived.session, lambda view: view.timeline.last == 5, "the jump")
    assert view.step is not None and view.step.elapsed_steps.tolist() == [2, 4, 4]
    lived.draw()
    lived.panels.ask(StepBack())
    lived.draw()
    lived.panels.ask(ContinueFromHere(scope="all"))
    view = wait_until(lived.session, lambda view: view.timeline.last == 6, "the other jump")
    assert view.step is not None and view.step.elapsed_steps.tolist() == [4, 4, 4]


def test_zoom_to_episode_starts_the_slider_at_the_episode(lived: EnvMoment) -> None:
    lived.step(4)
    last = lived.past.last
    lived.panels.do(ResetAll())
    wait_until(lived.session, lambda view: view.timeline.last > last, "the reset")
    lived.step(3)
    lived.panels.ask(ZoomTimeline(episode_only=True))
    lived.draw()
    assert lived.ends()[0] == -3
    lived.panels.do(GoToFirst())
    assert lived.past.shown == lived.past.last - 3, "of the episode"
    assert lived.past.steps_ago == 3
    lived.panels.do(GoToLast())
    lived.draw()
    assert "undo reset of all" in lived.panels.html("wb-tools")
    lived.panels.ask(ZoomTimeline(episode_only=False))
    lived.draw()
    assert lived.ends()[0] == -7
    lived.panels.do(GoToFirst())
    assert lived.past.shown == lived.past.first
    lived.panels.do(GoToLast())
    lived.draw()
    lived.panels.ask(UndoReset())
    view = wait_until(lived.session, lambda view: view.timeline.last == 9, "the end of the jump back")
    assert view.step is not None and view.step.elapsed_steps.tolist() == [4, 4, 4]


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
    lived.session.happen(MomentShown(6))
    lived.page.redraw()
    assert lived.ends() == (-2, 0, -1), "a moment within them does not disturb a drag of the slider"
    lived.session.happen(MomentShown(2))
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


def test_home_is_the_left_end_of_the_slider(lived: EnvMoment) -> None:
    lived.step(3)
    lived.panels.do(GoToFirst())
    assert lived.past.shown == 0
    last = lived.past.last
    lived.panels.do(ResetAll())
    wait_until(lived.session, lambda view: view.timeline.last > last, "the reset")
    lived.step(2)
    lived.panels.ask(ZoomTimeline(episode_only=True))
    lived.panels.do(GoToLast())
    lived.draw()
    lived.panels.do(GoToFirst())
    assert lived.past.shown == 4
    lived.panels.do(PreviousEvent())
    assert lived.past.shown == 0
    lived.panels.do(NextEvent())
    assert lived.past.shown == 4
