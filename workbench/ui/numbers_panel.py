"""The table of numbers in the Reward tab, redrawn no faster than it can be read."""

from __future__ import annotations

import time

import viser

from workbench.session.view import SessionView
from workbench.ui.draw_due import Clock, DrawDue
from workbench.ui.fragments import render
from workbench.ui.numbers_table import number_rows

REDRAW_EVERY = 0.12


class NumbersPanel:
    def __init__(self, server: viser.ViserServer, clock: Clock = time.monotonic) -> None:
        self._handle = server.gui.add_html("")
        self._due = DrawDue(REDRAW_EVERY, clock)

    def draw(self, view: SessionView) -> None:
        wanted = (view.task_serial, view.step_serial, view.selected_env)
        if not self._due.is_due(wanted):
            return
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
