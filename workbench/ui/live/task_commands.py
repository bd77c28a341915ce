"""Commands of the palette that the open task has: its envs, cameras and control modes by name."""

from __future__ import annotations

import json

import viser

from workbench.session.live.session import Session
from workbench.session.live.view import SessionView
from workbench.ui.widgets.hotkeys import Command, add
from workbench.ui.widgets.parts import PagePart

MAX_ENVS = 256
"""Envs that are commands; more would make every page wait for them."""
STUDIO = "Studio"


class TaskCommands(PagePart[SessionView]):
    """Make it in no container, after the commands of the page: the palette lists them in the order of making."""

    def __init__(self, server: viser.ViserServer, session: Session) -> None:
        self._server, self._session = server, session
        self._handles: list[viser.CommandHandle] = []

    def key(self, view: SessionView) -> object:
        if view.task is None:
            return None
        return (
            view.task.num_envs,
            [camera.key for camera in view.task.cameras],
            _modes(view),
            view.task.control_mode,
        )

    def draw(self, view: SessionView) -> None:
        for handle in self._handles:
            handle.remove()
        self._handles = [add(self._server, command) for command in self._commands(view)]

    def _commands(self, view: SessionView) -> list[Command]:
        task = view.task
        if task is None:
            return []
        envs = [
            Command(f"Env {env}", lambda env=env: self._session.change(selected_env=env))
            for env in range(min(task.num_envs, MAX_ENVS))
        ]
        cameras = [
            Command(
                f"Camera {camera.name}",
                lambda key=camera.key: self._session.studio.select(key),
                about=f"in {STUDIO}",
                tab=STUDIO,
            )
            for camera in task.cameras
        ]
        modes = [
            Command(
                f"Control mode {mode}",
                lambda mode=mode: self._session.versions.use_control_mode(mode),
                about="in effect" if mode == task.control_mode else "makes the envs again",
            )
            for mode in _modes(view)
        ]
        return [*envs, *cameras, *modes]


def _modes(view: SessionView) -> list[str]:
    """The control modes that the robot has."""
    made = () if view.task is None else view.task.made.modes
    choices = next((keyword.choices for keyword in made if keyword.name == "control_mode"), ()) or ()
    return [mode for text in choices if isinstance(mode := json.loads(text), str)]
