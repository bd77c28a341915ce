"""Palette entries of the documents, and of the open task: its envs, cameras, control modes, bodies, curves and files."""

from __future__ import annotations

from pathlib import Path

import viser

from workbench.app.help_pages import ADDRESS, RULE_PAGES, topics
from workbench.cameras.commands import SelectCamera
from workbench.cameras.studio_panel import TAB as CAMERAS
from workbench.live.commands import SelectBody, UseControlMode
from workbench.live.env_commands import SelectEnv
from workbench.live.panels.run_panel import control_modes
from workbench.live.panels.timeline_panel import strip_curves
from workbench.live.timeline_commands import ChooseStripCurve
from workbench.live.view import SessionView
from workbench.page.command import Command
from workbench.page.commands import OpenHelp, OpenInEditor
from workbench.page.widgets.keys_and_palette import add
from workbench.page.widgets.parts import PagePart
from workbench.page.widgets.visitors import Visitors

MAX_ENVS = 256
"""Maximum number of envs with an entry; more entries would delay every page."""


def add_help_topics(server: viser.ViserServer, visitors: Visitors) -> None:
    """Add an entry for each document. The browser opens the address below the label (``panels.js``)."""
    for topic in topics():
        if topic.group != RULE_PAGES:
            add(server, visitors, f"Help: {topic.title}", OpenHelp(), f"{ADDRESS}{topic.name}")


class TaskCommands(PagePart[SessionView]):
    """Palette entries of the open task. Construct it outside any container and after the commands of the page: the palette
    lists entries in the order of creation."""

    def __init__(self, server: viser.ViserServer, visitors: Visitors) -> None:
        self._server, self._visitors = server, visitors
        self._handles: list[viser.CommandHandle] = []

    def key(self, view: SessionView) -> object:
        if view.task is None:
            return None
        return (
            view.task.num_envs,
            [camera.key for camera in view.task.cameras],
            control_modes(view),
            view.task.control_mode,
            tuple(strip_curves(view)),
            view.task.geometry.body_names,
            view.task.source_files,
        )

    def draw(self, view: SessionView) -> None:
        for handle in self._handles:
            handle.remove()
        self._handles = [
            add(self._server, self._visitors, label, command, about)
            for label, command, about in _entries(view)
        ]


def _entries(view: SessionView) -> list[tuple[str, Command, str]]:
    """(label, command, text below the label) of each entry."""
    task = view.task
    if task is None:
        return []
    return [
        *((f"Env {env}", SelectEnv(env=env), "") for env in range(min(task.num_envs, MAX_ENVS))),
        *(
            (f"Camera {one.name}", SelectCamera(kind=one.kind, name=one.name), f"in {CAMERAS}")
            for one in task.cameras
        ),
        *(
            (
                f"Control mode {mode}",
                UseControlMode(mode=mode),
                "in effect" if mode == task.control_mode else "rebuilds the envs",
            )
            for mode in control_modes(view)
        ),
        *((f"Body {name}", SelectBody(body=name), "marked in the view") for name in task.geometry.body_names),
        *((f"Curve {name}", ChooseStripCurve(curve=name), "on the strip") for name in strip_curves(view)),
        *(
            (f"File {Path(file).name}", OpenInEditor(file=file), f"in the editor: {file}")
            for file in task.source_files
        ),
    ]
