"""The handles at the end effectors on a page, and what a drag asks of the session."""

from __future__ import annotations

from dataclasses import replace
from types import MappingProxyType
from typing import Any

import numpy as np
import pytest

from tests.drive.live import StubSession
from tests.drive.panels import Panels
from tests.drive.scenes import running
from workbench.hands.reach import ArmDragged, ArmKey, ArmsReleased, Reach
from workbench.hands.reach_panel import BEYOND, WITHIN, ReachPanel, reached_text
from workbench.hands.state import Hands
from workbench.live.messages import Reached
from workbench.live.view import SessionView
from workbench.task.description import ArmDescription

ARM = "arm/hand"
OFFSET = np.array([5.0, 0.0, 0.0])
PAGE = 3
TARGET = (0.4, 0.2, 0.1, 1.0, 0.0, 0.0, 0.0)


def seen(reach: Reach, playing: bool = False) -> SessionView:
    view = running(3, selected_env=1)
    assert view.task is not None
    task = replace(view.task, arms=(ArmDescription(ARM, ("a", "b", "c")),))
    return replace(view, task=task, playing=playing, features={Hands: Hands(reach=reach)})


def led(answer: Reached | None = None) -> Reach:
    key: ArmKey = 1, ARM
    reached: dict[ArmKey, Reached] = {} if answer is None else {key: answer}
    return Reach(True, MappingProxyType({key: TARGET}), MappingProxyType(reached))


class Page:
    def __init__(self, panels: Panels) -> None:
        self.panels, self.session = panels, StubSession()
        self.panel = ReachPanel(panels.server, self.session, 0.0)  # type: ignore[arg-type]

    def show(self, reach: Reach, playing: bool = False) -> np.ndarray:
        """Draw; returns the drawn poses."""
        view = self.session.shown = seen(reach, playing)
        assert view.step is not None
        poses = self.panel.moved(view, view.step.poses)
        self.panel.draw_in_view(view, poses, OFFSET)
        self.panel.draw(view)
        return poses

    def gizmo(self) -> Any:
        return next(iter(self.panels.nodes("/hands/reach/0")), None)


@pytest.fixture
def page(panels: Panels) -> Page:
    return Page(panels)


def test_the_handles_are_at_the_end_effector_until_they_are_dragged(page: Page) -> None:
    page.show(Reach())
    assert page.gizmo() is None
    poses = page.show(Reach(shown=True))
    gizmo = page.gizmo()
    hand = seen(Reach()).task.geometry.body_names.index(ARM)  # type: ignore[union-attr]
    assert gizmo.visible
    np.testing.assert_allclose(gizmo.position, poses[1, hand, :3] + OFFSET, atol=1e-6)
    page.show(led())
    np.testing.assert_allclose(gizmo.position, np.array(TARGET[:3]) + OFFSET, atol=1e-6)
    page.show(Reach())
    assert not gizmo.visible


def test_a_drag_reports_the_pose_in_the_frame_of_the_env_and_its_end(page: Page) -> None:
    page.show(Reach(shown=True))
    pose = np.array([*(np.array(TARGET[:3]) + OFFSET), *TARGET[3:]])
    page.panel.drag(PAGE, ARM, "start", pose)
    page.panel.drag(PAGE + 1, ARM, "update", pose + 1)
    page.panel.drag(PAGE, ARM, "end", pose)
    assert [(one.arm, one.env, one.ends) for one in page.session.asked] == [(ARM, 1, False), (ARM, 1, True)]
    assert all(isinstance(one, ArmDragged) for one in page.session.asked)
    np.testing.assert_allclose(page.session.asked[-1].pose, TARGET, atol=1e-9)


def test_a_page_that_closes_during_a_drag_lets_go(page: Page) -> None:
    page.show(Reach(shown=True))
    page.panel.drag(PAGE, ARM, "start", np.array(TARGET))
    page.panel.follow()
    assert page.session.asked[-1] == ArmsReleased()
    page.panel.follow()
    assert len(page.session.asked) == 2


def test_a_drag_ends_with_its_handles(page: Page, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(page.panels.server, "get_clients", lambda: {PAGE: object()})
    page.show(Reach(shown=True))
    page.panel.drag(PAGE, ARM, "start", np.array(TARGET))
    page.panel.follow()
    assert len(page.session.asked) == 1
    page.show(Reach())
    page.panel.follow()
    assert page.session.asked[-1] == ArmsReleased()


def test_a_drag_stays_in_its_env_when_another_is_selected(page: Page) -> None:
    page.show(Reach(shown=True))
    pose = np.array([*(np.array(TARGET[:3]) + OFFSET), *TARGET[3:]])
    page.panel.drag(PAGE, ARM, "start", pose)
    other = replace(page.session.shown, settings=replace(page.session.shown.settings, selected_env=2))
    assert other.step is not None
    page.panel.draw_in_view(other, other.step.poses, 2 * OFFSET)
    page.panel.drag(PAGE, ARM, "end", pose)
    assert page.session.asked[-1].env == 1
    np.testing.assert_allclose(page.session.asked[-1].pose, TARGET, atol=1e-9)


def test_an_answer_that_repeats_the_last_one_is_drawn(page: Page) -> None:
    links = np.array([[1, 2, 3, 1, 0, 0, 0]], np.float32)
    first, second = (Reached(1, ARM, "try", 0.0, 0.0, "", (ARM,), links.copy()) for _ in range(2))
    assert page.panel.key(seen(led(first))) != page.panel.key(seen(led(second)))


@pytest.mark.parametrize(("others", "name"), [((), "hand"), (("second/hand",), ARM)])
def test_the_panel_names_the_robot_only_where_several_have_arms(
    page: Page, others: tuple[str, ...], name: str
) -> None:
    view = seen(Reach(shown=True))
    assert view.task is not None
    arms = tuple(ArmDescription(body, ("a", "b", "c")) for body in (ARM, *others))
    page.panel.draw(replace(view, task=replace(view.task, arms=arms)))
    assert f'title="{ARM}">{name}</td>' in page.panels.html()


def test_a_target_out_of_reach_is_red_and_says_what_is_left(page: Page) -> None:
    page.show(led(Reached(1, ARM, "follow", 0.0, 0.0, "")), playing=True)
    (mark,) = page.panels.nodes("/hands/reach/0_target")
    assert mark.color == WITHIN
    far = Reached(1, ARM, "follow", 0.123, 0.0, "no solution within the limits of a")
    page.show(led(far), playing=True)
    assert mark.color == BEYOND
    assert "12.3 cm left" in page.panels.labels()
    assert reached_text(far) == "out of reach: no solution within the limits of a; 12.3 cm left"
    page.show(Reach(shown=True))
    assert not page.panels.labels() and not page.panels.nodes("/hands/reach/0_target")


def test_only_while_paused_the_page_shows_the_joints_that_would_be_set(page: Page) -> None:
    links = np.array([[1, 2, 3, 1, 0, 0, 0]], np.float32)
    answer = Reached(1, ARM, "try", 0.0, 0.0, "", (ARM,), links)
    poses, before = page.show(led(answer)), page.show(Reach(shown=True))
    np.testing.assert_array_equal(page.show(led(answer), playing=True), before)
    changed = np.argwhere((poses != before).any(axis=2))
    hand = seen(Reach()).task.geometry.body_names.index(ARM)  # type: ignore[union-attr]
    np.testing.assert_array_equal(changed, [[1, hand]])
    np.testing.assert_array_equal(poses[1, hand], links[0])
