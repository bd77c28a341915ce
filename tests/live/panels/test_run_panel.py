"""The Run tab: sliders of the action, the condition to pause at, and the source of actions."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from tests.drive.live import Live
from tests.drive.scenes import running
from workbench.envs.keywords import HowMade, Keyword
from workbench.hands.state import Hands
from workbench.live.commands import (
    ChooseEpisodeEnd,
    ChoosePauseEntry,
    MoveSlider,
    ResetAll,
    ResetSelected,
    SetPolicy,
    UseControlMode,
)
from workbench.live.events import SlidersMoved
from workbench.live.messages import Settings
from workbench.live.panels.run_panel import CHOOSE, HOLD, NEVER, TO_TRY
from workbench.live.pause_when import PauseWhen
from workbench.live.view import SessionView
from workbench.task.description import ActionDimension

HINGE, GRIPPER = "arm/joint1", "gripper"


def driven(env: int, num_envs: int = 3, **changes: Any) -> SessionView:
    """A view in which sliders are the source; env k's sliders are at 0.25 k and 0.01 k."""
    action = np.arange(num_envs, dtype=np.float32)[:, None] * np.array([0.25, 0.01], np.float32)
    settings = Settings(action_source="sliders", selected_env=env)
    return running(num_envs, settings=settings, **{"slider_action": action, **changes})


def test_the_sliders_show_and_move_the_chosen_envs(live_page: Live) -> None:
    def moved(*sliders: MoveSlider) -> list[object]:
        live_page.asked.clear()
        for slider in sliders:
            live_page.do(slider)
        return live_page.asked

    live_page.show(driven(2))
    assert (live_page.typed(HINGE), live_page.typed(GRIPPER)) == (0.5, 0.02)
    assert live_page.field(GRIPPER).bounds == (0.0, 0.04)
    live_page.set(GRIPPER, 0.03)
    assert live_page.asked[-1] == SlidersMoved((1,), (0.03,), (2,))
    outside = MoveSlider(dimension=0, value=7.0), MoveSlider(dimension=0, value=-7.0)
    assert moved(*outside) == [SlidersMoved((0,), (one,), (2,)) for one in (1.0, -1.0)]
    live_page.press(HOLD)
    assert live_page.asked[-1] == SlidersMoved((), (), (2,))
    live_page.set("Moves", "all envs")
    assert moved(MoveSlider(dimension=1, value=0.01)) == [SlidersMoved((1,), (0.01,), None)]
    assert moved(MoveSlider(dimension=2, value=0.0)) == [] and live_page.client.notices
    live_page.show(driven(1, slider_action=np.full((3, 2), -9, np.float32)))
    assert live_page.typed("Moves") == "all envs" and live_page.typed(HINGE) == -1.0
    live_page.show(driven(0, hands=Hands(driving=True)))
    assert not live_page.shows(HINGE), "keys drive"
    live_page.show(driven(0, 1))
    assert live_page.shows(HINGE) and not live_page.shows("Moves"), "there is no other env"
    view = driven(0, slider_action=None)
    assert view.task is not None
    other = (ActionDimension("lift", -math.inf, math.inf), ActionDimension("lock", 2.0, 2.0))
    live_page.show(replace(view, task=replace(view.task, actions=other)))
    assert not live_page.shows(HINGE) and live_page.field("lift").bounds == (-1.0, 1.0)
    low, high = live_page.field("lock").bounds or (0, 0)
    assert low == 2.0 < high, "a browser divides by the range"


def test_a_condition_is_shown_with_what_it_needs(live_page: Live) -> None:
    def shown(*when: Any) -> tuple[object, ...]:
        view = running(2, pause_when=PauseWhen(*when))
        assert view.task is not None and view.step is not None
        step = replace(view.step, qpos=np.zeros((2, 1), np.float32))
        live_page.show(replace(view, step=step, task=replace(view.task, joints=("hinge",))))
        optional = (live_page.typed(one) if live_page.shows(one) else None for one in ("It", "Level"))
        return live_page.typed("Pause when"), *optional

    assert shown() == (NEVER, None, None)
    assert list(live_page.field("Pause when").options.values()) == ["", "reward", "success", "hinge"]
    live_page.set("Pause when", "hinge")
    assert live_page.asked[-1] == ChoosePauseEntry(entry="hinge")
    assert shown("success", "becomes false") == ("success", "becomes false", None)
    for test in ("rises above", "falls below"):
        assert shown("reward", test, 0.5) == ("reward", test, 0.5)
    assert shown("gone", "becomes true") == ("gone", "becomes true", None), "the task lacks it now"


MODES = (Keyword("control_mode", "choice", '"pd_a"', choices=('"pd_a"', '"pd_b"')),)


def test_the_fields_show_what_is_in_effect_and_work_while_a_worker_does(live_page: Live) -> None:
    view = running(2, seed=5, settings=Settings(action_source="zero", episode_end="continue"))
    assert view.task is not None
    task = replace(view.task, control_mode="pd_b", made=HowMade("panda", MODES))
    live_page.show(replace(view, task=task))
    mode = live_page.part("Actions").field("Control")
    assert (mode.value, list(mode.options)) == ("pd_b", ["pd_a", "pd_b"])
    live_page.part("Actions").set("Control", "pd_a")
    assert live_page.asked[-1] == UseControlMode(mode="pd_a")
    fields = ("Seed", "At the end", "Source")
    assert [live_page.typed(one) for one in fields] == ["5", "keep running", "zero"]
    live_page.set("At the end", "pause")
    assert live_page.asked[-1] == ChooseEpisodeEnd(rule="pause")
    assert live_page.button("Reset all").command == ResetAll()
    assert live_page.button("Reset this env").command == ResetSelected()
    live_page.show(replace(view, state="stopped"))
    assert live_page.field("Source").off and live_page.field("At the end").off
    assert live_page.button("Reset all").command is None
    assert not live_page.part("Actions").shows("Control"), "the robot has no other mode"


def test_solve_leads_to_its_options_and_a_policy_without_a_name_is_explained(live_page: Live) -> None:
    def seen(source: Any, policy: str | None = None) -> tuple[bool, int]:
        live_page.show(running(2, settings=Settings(action_source=source, policy=policy)))
        actions = live_page.part("Actions")
        return actions.shows(TO_TRY), len(actions.htmls())

    (to_try, solve), (no, policy), (_, named) = (
        seen("solve"),
        seen("policy"),
        seen("policy", "a.py:act"),
    )
    assert to_try and not no and policy > named and solve > 0


def test_a_policy_is_chosen_from_the_known_ones_while_policies_act(live_page: Live) -> None:
    known = ("a.py:act", "b.py:act")

    def draw(source: str, policy: str | None = None, known: tuple[str, ...] = known) -> None:
        settings = Settings(action_source=source, policy=policy)  # type: ignore[arg-type]
        live_page.show(running(2, settings=settings, known_policies=known))

    draw("policy", known=())
    assert live_page.shows("Policy") and not live_page.shows("Known")
    draw("policy", "b.py:act")
    assert [*live_page.field("Known").options.values()] == ["", *known]
    assert live_page.typed("Known") == live_page.typed("Policy") == "b.py:act"
    draw("policy", "mine:act")
    assert live_page.typed("Known") == CHOOSE
    live_page.set("Known", "a.py:act")
    assert live_page.session.asked[-1] == SetPolicy(policy="a.py:act")
    draw("random")
    assert not live_page.shows("Policy") and not live_page.shows("Known")
