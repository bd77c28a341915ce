"""The Run tab: reset, seed, env, episode end and the source of actions."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from typing import Literal, get_args

import viser

from workbench.actions.sources import SOURCES
from workbench.live.commands import (
    ChooseActions,
    ChooseEpisodeEnd,
    ChooseMoved,
    ChoosePauseEntry,
    ChoosePauseTest,
    HoldStill,
    MoveSlider,
    ResetAll,
    ResetSelected,
    SetPauseLevel,
    SetPolicy,
    SetSeed,
    UseControlMode,
)
from workbench.live.events import SlidersMoved
from workbench.live.history.curves import columns_by_label
from workbench.live.messages import EpisodeEnd
from workbench.live.pause_when import Test
from workbench.live.session_protocol import LiveSession
from workbench.live.view import SessionView
from workbench.page.command import Command, Refused
from workbench.page.commands import ShowTab
from workbench.page.widgets.fields import Field, choice, slider
from workbench.page.widgets.parts import PagePart
from workbench.page.widgets.templates import render
from workbench.page.widgets.tools import Tool, tool, tools_html
from workbench.page.widgets.visitors import Visitor
from workbench.task.description import ActionDimension

ENVS = {"the selected env": "selected", "all envs": "all"}
"""Choices of a field *Envs*, with their values in commands."""
HOLD = "Hold still"
MOVED_HINT = "The envs whose robot a slider moves. The sliders show the action of the selected env."
DEFAULT_BOUND = 1.0
"""Bound of the slider of a dimension without bounds: from -1 to 1."""


class ActionSliders:
    """A folder with one slider per action dimension of the selected env's robot, shown while the source is ``sliders``.
    Moving a slider sets only that dimension, in the env or envs chosen in the folder."""

    DOES = (MoveSlider, ChooseMoved, HoldStill)

    def __init__(self, server: viser.ViserServer, session: LiveSession) -> None:
        self._server = server
        self._session = session
        self._dimensions: tuple[ActionDimension, ...] = ()
        self._sliders: list[Field] = []
        self._moved: Literal["selected", "all"] = "selected"
        self._folder = server.gui.add_folder(None, visible=False)
        with self._folder:
            self._which = choice(server, "Moves", ChooseMoved, "envs", ENVS, self._moved, hint=MOVED_HINT)
            server.gui.add_html(tools_html([tool(HOLD, HoldStill())]))

    def build(self, dimensions: tuple[ActionDimension, ...]) -> None:
        """Make the sliders of this action space, unless they exist (a reload keeps them)."""
        if dimensions == self._dimensions:
            return
        for one in self._sliders:
            one.remove()
        self._dimensions, self._sliders = dimensions, []
        with self._folder:
            for number, dimension in enumerate(dimensions):
                low, high = slider_bounds(dimension)
                self._sliders.append(
                    slider(
                        self._server,
                        dimension.name,
                        MoveSlider,
                        "value",
                        (low, high),
                        step=(high - low) / 200,
                        given={"dimension": number},
                    )
                )

    def draw(self, view: SessionView, hidden: bool) -> None:
        shown = view.settings.action_source == "sliders" and not hidden
        self._folder.visible = shown and bool(self._dimensions)
        self._which.visible = view.task is not None and view.task.num_envs > 1
        self._which.show(self._moved)
        if not self._folder.visible or view.slider_action is None:
            return
        action = view.slider_action[min(view.selected_env, len(view.slider_action) - 1)]
        for one, dimension, value in zip(self._sliders, self._dimensions, action, strict=False):
            low, high = slider_bounds(dimension)
            # A policy's action may lie outside the bounds.
            # Three digits: the field next to the slider has no room for more.
            one.show(min(max(float(f"{value:.3g}"), low), high))

    def do(self, command: Command) -> None:
        envs = None if self._moved == "all" else (self._session.view().selected_env,)
        match command:
            case MoveSlider(dimension=dimension, value=value):
                if dimension >= len(self._dimensions):
                    raise Refused(f"The robot's action has only {len(self._dimensions)} dimensions.")
                low, high = slider_bounds(self._dimensions[dimension])
                self._session.dispatch(SlidersMoved((dimension,), (min(max(value, low), high),), envs))
            case HoldStill():
                self._session.dispatch(SlidersMoved((), (), envs))
            case ChooseMoved(envs=moved):
                self._moved = moved


def slider_bounds(dimension: ActionDimension) -> tuple[float, float]:
    low = dimension.low if math.isfinite(dimension.low) else -DEFAULT_BOUND
    high = dimension.high if math.isfinite(dimension.high) else DEFAULT_BOUND
    return (low, high) if low < high else (low, low + 1e-6)


EPISODE_ENDS: dict[str, EpisodeEnd] = {
    "reset the env": "reset",
    "keep running": "continue",
    "pause": "pause",
}
NEVER = "never"
PAUSE_HINT = "Pause at the step at which a number of the selected env meets a condition."
SOURCE_HINT = "solve: planned by rollouts of the task with its own reward."
RESET_ALL, RESET_THIS = "Reset all", "Reset this env"
TO_TRY = "Options and results of solve"
MODE_HINT = "Another control mode rebuilds the envs."
CHOOSE = "choose one"
KNOWN_HINT = (
    "Functions with one parameter, from the files in the task's folder and in the folder where the command was started; "
    "and policies used before."
)


class RunPanel(PagePart[SessionView]):
    """The tab's controls. Each shows the session's value and sends its command to the session.

    Args:
        is_driven: returns whether a person drives by keys. The sliders of the action are then hidden.
    """

    does = ActionSliders.DOES

    def __init__(
        self, server: viser.ViserServer, session: LiveSession, is_driven: Callable[[SessionView], bool]
    ) -> None:
        self._session, self._is_driven = session, is_driven
        gui = server.gui

        with gui.add_folder("Actions") as self.actions:
            self._source = choice(
                server, "Source", ChooseActions, "source", SOURCES, "hold", hint=SOURCE_HINT
            )
            self._about_solve = gui.add_html(
                tools_html([Tool(TO_TRY, ShowTab(tab="Try"), "Open the Try tab")])
            )
            self._mode = choice(server, "Control", UseControlMode, "mode", (), "", hint=MODE_HINT)
            self.below_mode = self._mode.order + 0.5
            """viser's order of what comes after the control mode, in `actions`."""
            self._policy = Field(
                server,
                "Policy",
                SetPolicy,
                "policy",
                hint="module:function or file.py:function. The function takes obs and returns the action.",
            )
            self._known = choice(server, "Known", SetPolicy, "policy", (CHOOSE,), CHOOSE, hint=KNOWN_HINT)
            self._policy_hint = gui.add_html(render("policy_hint"))
            self._policy.visible = self._known.visible = self._policy_hint.visible = False
            self._sliders = ActionSliders(server, session)

        with gui.add_folder("Episode") as self.episode:
            self._seed = Field(server, "Seed", SetSeed, "seed", "0", hint="A new seed resets every env.")
            self._end = choice(server, "At the end", ChooseEpisodeEnd, "rule", EPISODE_ENDS, "reset")
            self._pause = choice(
                server, "Pause when", ChoosePauseEntry, "entry", {NEVER: ""}, "", hint=PAUSE_HINT
            )
            tests = get_args(Test)
            self._pause_test = choice(server, "It", ChoosePauseTest, "test", tests, tests[0])
            self._pause_level = Field(server, "Level", SetPauseLevel, "level", 0.0, step=0.1)
            self._resets = gui.add_html("")
            self.below_resets = self._resets.order + 0.5
            """viser's order of what comes after the buttons that reset, in `episode`."""

    def do(self, command: Command, visitor: Visitor) -> None:
        self._sliders.do(command)

    # --- drawing ---------------------------------------------------------------------------------

    def draw(self, view: SessionView) -> None:
        can_act = view.task is not None and view.state != "stopped"
        if view.task is not None:
            self._sliders.build(view.task.actions)
        resets = (RESET_ALL, ResetAll()), (RESET_THIS, ResetSelected())
        self._resets.content = tools_html([tool(name, command, off=not can_act) for name, command in resets])
        self._seed.show(str(view.seed))
        self._end.show(view.settings.episode_end, off=not can_act)
        self._draw_pause(view)
        self._source.show(view.settings.action_source, off=not can_act)
        modes = control_modes(view)
        self._mode.visible = len(modes) > 1
        now = "" if view.task is None else view.task.control_mode or ""
        self._mode.show(now, options={mode: mode for mode in modes}, off=not can_act)
        self._about_solve.visible = view.settings.action_source == "solve"
        self._policy.show(view.settings.policy or "")
        policy, known = view.settings.policy, view.known_policies
        policy_wanted = view.settings.action_source == "policy"
        self._policy.visible = policy_wanted
        self._policy_hint.visible = policy_wanted and not policy
        self._known.visible = policy_wanted and bool(known)
        self._known.show(
            policy if policy in known else "", options={CHOOSE: "", **{one: one for one in known}}
        )
        self._sliders.draw(view, hidden=self._is_driven(view))

    def _draw_pause(self, view: SessionView) -> None:
        when, joints = view.pause_when, () if view.task is None else view.task.joints
        known = [] if view.step is None else [*columns_by_label(view.step, joints)]
        if when.entry and when.entry not in known:
            known.append(when.entry)
        self._pause.show(when.entry, options={NEVER: "", **{name: name for name in known}})
        self._pause_test.show(when.test)
        self._pause_level.show(when.level)
        self._pause_test.visible = bool(when.entry)
        self._pause_level.visible = bool(when.entry) and when.test in ("rises above", "falls below")


def control_modes(view: SessionView) -> list[str]:
    """The control modes that the robot has."""
    made = () if view.task is None else view.task.made.modes
    choices = next((keyword.choices for keyword in made if keyword.name == "control_mode"), ()) or ()
    return [mode for text in choices if isinstance(mode := json.loads(text), str)]
