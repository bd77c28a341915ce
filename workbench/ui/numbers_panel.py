"""The table of numbers in the Reward tab, redrawn no faster than it can be read."""

from __future__ import annotations

import viser

from workbench.session.view import SessionView
from workbench.ui.fragments import render
from workbench.ui.numbers_table import number_rows
from workbench.ui.parts import Part


class NumbersPanel(Part[SessionView]):
    every = 0.12

    def __init__(self, server: viser.ViserServer) -> None:
        self._handle = server.gui.add_html("")

    def key(self, view: SessionView) -> object:
        return view.task_serial, view.step_serial, view.selected_env

    def draw(self, view: SessionView) -> None:
        task, step = view.task, view.step
        rows = []
        if task is not None and step is not None:
            rows = number_rows(step, view.selected_env, task.max_episode_steps)
        self._handle.content = render(
            "numbers",
            rows=rows,
            env=view.selected_env,
            num_envs=0 if task is None else task.num_envs,
            has_success=step is not None and "success" in step.evaluate,
        )
