"""The Run tab: play, step, reset, speed, seed, env, episode end and the source of actions."""

from __future__ import annotations

import contextlib
import math
import threading
import time
from functools import partial
from pathlib import Path
from typing import Any

import viser

from workbench.jobs.policy import NoPolicy, find_policy, list_policies
from workbench.jobs.task import ActionDimension, ActionSource
from workbench.machine.kept_choices import keep_policy, used_policies
from workbench.machine.processes.watched_thread import watched_thread
from workbench.session.live.session import Session
from workbench.session.live.view import SessionView
from workbench.session.protocol.messages import EpisodeEnd
from workbench.ui.live.episodes_panel import ALL_ENVS, THIS_ENV
from workbench.ui.server.control_values import limit_text
from workbench.ui.widgets.inputs import Control
from workbench.ui.widgets.parts import PagePart
from workbench.ui.widgets.templates import render

HOLD = "Hold still"
UNBOUNDED = 1.0
"""A dimension without bounds gets a slider from -1 to 1."""


class ActionSliders:
    """A folder with one slider for each dimension, shown while the source is ``sliders``: what the selected env's robot is
    told. A slider that is moved tells that dimension alone, in the env or envs that the folder names."""

    def __init__(self, server: viser.ViserServer, session: Session) -> None:
        self._server = server
        self._session = session
        self._dimensions: tuple[ActionDimension, ...] = ()
        self._controls: list[Control[viser.GuiSliderHandle, float]] = []
        self._folder = server.gui.add_folder(None, visible=False)
        with self._folder:
            self._which = server.gui.add_dropdown(
                "Moves",
                (THIS_ENV, ALL_ENVS),
                initial_value=THIS_ENV,
                hint="Whose robot a slider moves. The sliders show what the robot of the selected env is told.",
            )
            self._hold = server.gui.add_button(
                HOLD, color="gray", hint="Each joint stops where it is; the sliders follow"
            )
        self._hold.on_click(lambda _: session.tell((), (), self._envs))

    @property
    def _envs(self) -> tuple[int, ...] | None:
        return None if self._which.value == ALL_ENVS else (self._session.view().selected_env,)

    def build(self, dimensions: tuple[ActionDimension, ...]) -> None:
        """Make the sliders of this action space, unless they exist (a reload keeps them)."""
        if dimensions == self._dimensions:
            return
        for control in self._controls:
            control.handle.remove()
        self._dimensions, self._controls = dimensions, []
        with self._folder:
            for number, dimension in enumerate(dimensions):
                low, high = slider_bounds(dimension)
                self._controls.append(
                    Control(
                        self._server.gui.add_slider(
                            dimension.name,
                            min=low,
                            max=high,
                            step=(high - low) / 200,
                            initial_value=(low + high) / 2,
                        ),
                        send=partial(self._send, number),
                    )
                )

    def draw(self, view: SessionView) -> None:
        self._folder.visible = view.settings.action_source == "sliders" and bool(self._dimensions)
        several = view.task is not None and view.task.num_envs > 1
        self._which.visible = several
        if not self._folder.visible or view.told is None:
            return
        told = view.told[min(view.selected_env, len(view.told) - 1)]
        for control, dimension, value in zip(self._controls, self._dimensions, told, strict=False):
            low, high = slider_bounds(dimension)
            # A policy's action may lie outside.
            # Three digits: the field beside the slider has no place for more.
            control.show(min(max(float(f"{value:.3g}"), low), high))

    def _send(self, number: int, value: float) -> None:
        self._session.tell((number,), (value,), self._envs)


def slider_bounds(dimension: ActionDimension) -> tuple[float, float]:
    low = dimension.low if math.isfinite(dimension.low) else -UNBOUNDED
    high = dimension.high if math.isfinite(dimension.high) else UNBOUNDED
    return (low, high) if low < high else (low, low + 1e-6)


SPEEDS: dict[str, float] = {
    "0.1 ×": 0.1,
    "0.25 ×": 0.25,
    "0.5 ×": 0.5,
    "1 ×": 1.0,
    "2 ×": 2.0,
    "4 ×": 4.0,
    "8 ×": 8.0,
    "unlimited": math.inf,
}
EPISODE_ENDS: dict[str, EpisodeEnd] = {
    "reset the env": "reset",
    "keep running": "continue",
    "pause": "pause",
}
SOURCES: dict[str, ActionSource] = {
    "hold still": "hold",
    "zero": "zero",
    "random": "random",
    "sliders": "sliders",
    "policy": "policy",
    "solve": "solve",
}
SOURCE_HINT = "solve: planned by rollouts of the task with its own reward."
STEP, RESET_ALL, RESET_THIS = "Step", "Reset all", "Reset this env"
PREVIOUS, NEXT = "‹ previous", "next ›"
CHOOSE = "choose one"
KNOWN_HINT = "Functions of one parameter in the files where the command was started and beside the task, and policies used before."
LOOK_EVERY = 5.0
"""Seconds."""
LARGEST_SEED = 2**31 - 1


class KnownPolicies:
    """Policies to choose from: those that were used in this folder, and what the files there and beside the task hold."""

    def __init__(self) -> None:
        self._here = Path.cwd()
        self._found: tuple[str, ...] = ()
        self._looked = -math.inf
        self._looking: threading.Thread | None = None
        self._kept: str | None = None

    def look(self, task_folder: Path | None, acting: str | None) -> tuple[str, ...]:
        """What is known; looked up again every `LOOK_EVERY` seconds on a thread, since it reads many files.

        Args:
            acting: the policy that is chosen; kept for the next run if there is such a file or module.
        """
        if acting is not None and acting != self._kept:
            self._kept = acting
            with contextlib.suppress(NoPolicy):
                find_policy(acting, task_folder)
                keep_policy(self._here, acting)
                self._looked = -math.inf
        looking = self._looking is not None and self._looking.is_alive()
        if not looking and time.monotonic() - self._looked > LOOK_EVERY:
            self._looked = time.monotonic()
            self._looking = watched_thread("policies", lambda: self._look(task_folder))
            self._looking.start()
        return self._found

    def _look(self, task_folder: Path | None) -> None:
        used = [one for one in used_policies(self._here) if _is_there(one, task_folder)]
        self._found = tuple(dict.fromkeys([*used, *list_policies(self._here, task_folder)]))


def _is_there(reference: str, task_folder: Path | None) -> bool:
    try:
        find_policy(reference, task_folder)
    except NoPolicy:
        return False
    return True


class RunPanel(PagePart[SessionView]):
    """The tab's controls. Each asks the session and shows the session's value (`Control`); none touches an env."""

    def __init__(self, server: viser.ViserServer, session: Session) -> None:
        self._session = session
        gui = server.gui

        self._play = gui.add_button("Play", icon=viser.Icon.PLAYER_PLAY)
        self._play.on_click(lambda _: self.toggle_play())
        self._transport = gui.add_button_group("", (STEP, RESET_ALL, RESET_THIS))
        self._transport.on_click(self._on_transport)

        self._env_folder = gui.add_folder("Environment", visible=False)
        with self._env_folder:
            self._env = Control(
                gui.add_slider("Selected", min=0, max=1, step=1, initial_value=0),
                send=lambda env: session.change(selected_env=env),
            )
            self._neighbours = gui.add_button_group("", (PREVIOUS, NEXT))
            self._neighbours.on_click(
                lambda event: self.select_neighbour(-1 if event.target.value == PREVIOUS else 1)
            )

        with gui.add_folder("Episode"):
            self._speed = Control(
                gui.add_dropdown(
                    "Speed", tuple(SPEEDS), initial_value="1 ×", hint="Simulated seconds in one second."
                ),
                read=lambda value: SPEEDS[value],
                send=lambda speed: session.change(speed=speed),
                shown=self._speed_shown,
            )
            self._seed = Control(
                gui.add_number(
                    "Seed", 0, min=0, max=LARGEST_SEED, step=1, hint="A new seed resets every env."
                ),
                send=session.set_seed,
                settle=0.6,
            )
            self._end = Control(
                gui.add_dropdown("At the end", tuple(EPISODE_ENDS), initial_value="reset the env"),
                read=lambda value: EPISODE_ENDS[value],
                send=lambda rule: session.change(episode_end=rule),
                shown=lambda rule: _name_of(EPISODE_ENDS, rule),
            )

        with gui.add_folder("Actions"):
            self._source = Control(
                gui.add_dropdown("Source", tuple(SOURCES), initial_value="hold still", hint=SOURCE_HINT),
                read=lambda value: SOURCES[value],
                send=self._choose_source,
                shown=lambda source: _name_of(SOURCES, source),
            )
            self._policy = Control(
                gui.add_text(
                    "Policy", "", hint="module:function or file.py:function, given obs, returns the action."
                ),
                read=self._read_policy,
                send=lambda policy: session.change(action_source="policy", policy=policy or None),
                settle=0.8,
            )
            limit_text(self._policy.handle, 500)
            add_dropdown: Any = gui.add_dropdown  # viser infers the type of the options from the first
            self._found = Control(
                add_dropdown("Known", (CHOOSE,), hint=KNOWN_HINT, visible=False),
                send=self._choose_found,
            )
            self._policies = KnownPolicies()
            self._policy_hint = gui.add_html(render("policy_hint"))
            self._sliders = ActionSliders(server, session)

    # --- keys and buttons ------------------------------------------------------------------------

    def toggle_play(self) -> None:
        if self._session.view().playing:
            self._session.pause()
        else:
            self._session.play()

    def reset_this(self) -> None:
        self._session.reset((self._session.view().selected_env,))

    def select_neighbour(self, step: int) -> None:
        """Select the next (1) or previous (-1) env, wrapping around."""
        count = self._num_envs()
        self._session.change(selected_env=(self._session.view().selected_env + step) % count)

    def _on_transport(self, event: viser.GuiEvent) -> None:
        actions = {
            STEP: self._session.step,
            RESET_ALL: self._session.reset,
            RESET_THIS: self.reset_this,
        }
        action = actions.get(event.target.value)
        if action is not None:
            action()

    # --- drawing ---------------------------------------------------------------------------------

    def draw(self, view: SessionView) -> None:
        can_act = view.task is not None and view.state != "stopped"
        if view.task is not None:
            several = view.task.num_envs > 1
            self._env_folder.visible = several
            self._env.handle.max = max(1, view.task.num_envs - 1)
            self._sliders.build(view.task.actions)
        self._draw_play(view.playing, can_act)
        # viser cannot disable a group of buttons, so it is hidden.
        self._transport.visible = can_act
        for control in (self._env, self._speed, self._seed, self._end, self._source, self._policy):
            control.enable(can_act)
        self._env.show(view.selected_env)
        self._speed.show(view.settings.speed)
        self._seed.show(view.seed)
        self._end.show(view.settings.episode_end)
        self._source.show(view.settings.action_source)
        self._policy.show(view.settings.policy or "")
        policy_wanted = view.settings.action_source == "policy"
        self._policy.handle.visible = policy_wanted
        self._policy_hint.visible = policy_wanted and not view.settings.policy
        self._draw_found(view.settings.policy if policy_wanted else None, policy_wanted)
        self._sliders.draw(view)

    def _draw_play(self, playing: bool, can_act: bool) -> None:
        self._play.label = "Pause" if playing else "Play"
        self._play.icon = viser.Icon.PLAYER_PAUSE if playing else viser.Icon.PLAYER_PLAY
        self._play.disabled = not can_act

    # --- values ----------------------------------------------------------------------------------

    def _num_envs(self) -> int:
        task = self._session.view().task
        return 1 if task is None else task.num_envs

    def _speed_shown(self, speed: float) -> str:
        name = _name_of(SPEEDS, speed)
        if name is None:
            # A speed from the command line that is not in the list.
            name = f"{speed:g} ×"
            SPEEDS[name] = speed
        if name not in self._speed.handle.options:
            self._speed.handle.options = tuple(SPEEDS)
        return name

    def _choose_source(self, source: ActionSource) -> None:
        # Without a name it is a source too: the next step reports what is missing.
        policy = self._policy.handle.value.strip() if source == "policy" else ""
        self._session.change(action_source=source, policy=policy or None)

    def _draw_found(self, policy: str | None, wanted: bool) -> None:
        options = self._policies.look(self._session.task_folder, policy) if wanted else ()
        handle = self._found.handle
        handle.visible = bool(options)
        if options and handle.options != (CHOOSE, *options):
            handle.options = (CHOOSE, *options)
        self._found.show(policy if policy in options else CHOOSE)

    def _choose_found(self, reference: str) -> None:
        if reference != CHOOSE:
            self._session.change(action_source="policy", policy=reference)

    def _read_policy(self, value: str) -> str:
        text = value.strip()
        if text and ":" not in text:
            raise ValueError("A policy is written module:function or file.py:function.")
        return text


def _name_of(names, value):
    return next((name for name, known in names.items() if known == value), None)
