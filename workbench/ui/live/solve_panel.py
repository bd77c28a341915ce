"""The folder *Solve* of the Run tab: how actions are planned, what the rollouts earned, and their ways in the 3-D view."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from workbench.machine.text import number_text, rate_text
from workbench.planning.options import Method, PlanOptions
from workbench.session.history.env_table import EnvRows
from workbench.session.live.session import Session
from workbench.session.live.solver import SolveView
from workbench.session.live.view import SessionView
from workbench.session.protocol.questions import PlannedEnv
from workbench.ui.scene.rollout_traces import RolloutTraces
from workbench.ui.widgets.editor import LinkTo, no_links
from workbench.ui.widgets.inputs import Control, tell_all
from workbench.ui.widgets.line_chart import ChartLine, LineChart, part_round
from workbench.ui.widgets.parts import PagePart
from workbench.ui.widgets.templates import render

THIS_ENV, ALL_ENVS = "the selected env", "all envs, in turn"
METHODS: dict[str, Method] = {
    "MPPI": "mppi",
    "predictive sampling": "predictive",
    "CEM": "cem",
}
SAVE_SOLVED = "Save the solved episode"
TOOL = "the robot's tool"
BETTER_MODE = "pd_ee_delta_pose"
USE_MODE = "Plan in end-effector control (resets the envs)"
MOST_ROLLOUTS, LONGEST_HORIZON = 256, 3.0
MOST_TOLD = 4
"""Solved envs that are named."""
CHART_HEIGHT = 150
PREDICTED, ACHIEVED = "#228be6", "#f08c00"
SETTLE = 0.5
"""Seconds: other rollouts are other envs, which are not built for each place of a slider that is passed."""


class SolvePanel(PagePart[SessionView]):
    """Shown while the source of actions is *solve*.

    Args:
        server: The page.
        session: The session.
        link: Links the lines of the author's files.
    """

    def __init__(self, server: viser.ViserServer, session: Session, link: LinkTo = no_links) -> None:
        self._server, self._session, self._link = server, session, link
        gui = server.gui
        self._traces = RolloutTraces(server)
        self._told: tuple[tuple[int, int], ...] = ()
        self._folder = gui.add_folder("Solve", visible=False)
        with self._folder:
            self._status = gui.add_html("")
            self._save = gui.add_button(
                SAVE_SOLVED,
                icon=viser.Icon.DEVICE_FLOPPY,
                visible=False,
                hint="Into the recordings, like any other episode: from there it can be exported as a demonstration",
            )
            self._saving = gui.add_html("", visible=False)
            self._mode = gui.add_button(
                USE_MODE,
                color="gray",
                visible=False,
                hint="Makes the envs anew with this control mode, in which plans are found soonest",
            )
            self._envs = Control(
                gui.add_dropdown("Plan for", (THIS_ENV, ALL_ENVS), hint="The others hold still."),
                send=lambda which: session.change(solve_all=which == ALL_ENVS),
                shown=lambda every: ALL_ENVS if every else THIS_ENV,
            )
            self._method = Control(
                gui.add_dropdown(
                    "Method",
                    tuple(METHODS),
                    hint="What becomes the plan. MPPI: the mean of all rollouts, weighted by what they earned. Predictive "
                    "sampling: the best one. CEM: the mean of the best tenth.",
                ),
                read=lambda name: METHODS[name],
                send=lambda method: self._plan_with(method=method),
                shown=lambda method: next(name for name, known in METHODS.items() if known == method),
            )
            self._rollouts = self._slider(
                "Rollouts",
                "rollouts",
                8,
                MOST_ROLLOUTS,
                8,
                "Candidates that are tried at a time, each in its env.",
            )
            self._horizon = self._slider(
                "Horizon", "horizon", 0.1, LONGEST_HORIZON, 0.05, "Seconds that a plan looks ahead."
            )
            self._noise = self._slider(
                "Noise",
                "noise",
                0.05,
                2.0,
                0.05,
                "Of candidates around the plan, of half the range of each action.",
            )
            self._temperature = self._slider(
                "Temperature", "temperature", 0.01, 2.0, 0.01, "The lower, the more the best rollouts count."
            )
            self._every = self._slider(
                "Plan every", "every", 1, 10, 1, "Control steps that are taken before the next plan."
            )
            self._shows = gui.add_checkbox(
                "Show rollouts",
                True,
                hint="What was tried, as lines in the 3-D view: each is the way that a body takes in one rollout. The best is "
                "bright.",
            )
            add_dropdown: Any = gui.add_dropdown  # viser infers the type of the options from the first
            self._traced = Control(
                add_dropdown(
                    "Lines follow", (TOOL,), hint="The body whose ways are drawn, from the next plan on."
                ),
                send=lambda name: session.change(traced="" if name == TOOL else name),
            )
            self._look_at = gui.add_slider(
                "Look at",
                min=1,
                max=2,
                step=1,
                initial_value=1,
                visible=False,
                hint="A rollout of the last plan, from the best to the worst.",
            )
            self._looked_at = gui.add_html("", visible=False)
            self._chart = LineChart(server, self._folder, CHART_HEIGHT)
        self._save.on_click(lambda _: self._save_solved())
        self._mode.on_click(lambda _: self._use_mode())

    def _slider(
        self, label: str, name: str, low: float, high: float, step: float, hint: str
    ) -> Control[Any, float]:
        return Control(
            self._server.gui.add_slider(label, min=low, max=high, step=step, initial_value=low, hint=hint),
            send=lambda value: self._plan_with(**{name: value}),
            settle=SETTLE,
        )

    # --- what a person does ----------------------------------------------------------------------

    def _plan_with(self, **changes: Any) -> None:
        self._session.change(plan=replace(self._session.view().settings.plan, **changes))

    def _save_solved(self) -> None:
        # At once: the episode is in the history, and it may take a second until its first moment is saved.
        self._save.disabled, self._saving.visible = True, True
        self._saving.content = render("note", text="saving")
        view = self._session.view()
        self._session.save_past(tuple(env for env, _ in view.solve.solved) or (view.selected_env,))

    def _use_mode(self) -> None:
        self._session.versions.use_control_mode(BETTER_MODE)

    # --- drawing ---------------------------------------------------------------------------------

    def draw(self, view: SessionView) -> None:
        task, solve = view.task, view.solve
        shown = view.settings.action_source == "solve" and task is not None
        self._folder.visible = shown
        if not shown or task is None:
            self._chart.hide()
            self._told = solve.solved
            return
        plan = view.settings.plan
        saving = view.recording.saving
        self._status.content = solve_html(solve, self._session.env_rows(), view.selected_env, self._link)
        self._save.visible = bool(solve.solved) and not view.playing
        self._save.disabled = saving.progress is not None
        self._saving.visible = self._save.visible and (self._save.disabled or bool(saving.message))
        self._saving.content = render("saving", saving=saving)
        self._mode.visible = offers_better_mode(view)
        self._envs.handle.visible = task.num_envs > 1
        self._envs.show(view.settings.solve_all)
        self._method.show(plan.method)
        self._rollouts.show(plan.rollouts)
        has_success = view.step is None or "success" in view.step.evaluate
        self._horizon.show(min(horizon_seconds(plan, task.control_dt, has_success), LONGEST_HORIZON))
        self._noise.show(plan.noise)
        self._temperature.show(plan.temperature)
        self._temperature.handle.visible = plan.method == "mppi"
        self._every.show(plan.every)
        self._draw_traced(view)
        self._draw_looked_at(view)
        self._draw_chart(solve)
        self._tell(view)

    def draw_in_view(self, view: SessionView, offset: NDArray[np.float32]) -> None:
        """Draw the ways of the last plan's rollouts.

        Args:
            offset: (3,) of the selected env on the grid.
        """
        plan = view.solve.plan
        there = view.settings.action_source == "solve" and self._shows.value and view.timeline.shown is None
        chosen = 0 if view.playing else int(self._look_at.value) - 1
        self._traces.draw(plan.paths if plan is not None and there else None, offset, chosen)

    def _draw_traced(self, view: SessionView) -> None:
        assert view.task is not None
        geometry, handle = view.task.geometry, self._traced.handle
        movable = (
            name
            for name, kind in zip(geometry.body_names, geometry.body_kinds, strict=True)
            if kind in ("link", "dynamic")
        )
        options = (TOOL, *movable)
        if handle.options != options:
            handle.options = options
        self._traced.show(view.settings.traced if view.settings.traced in options else TOOL)

    def _draw_looked_at(self, view: SessionView) -> None:
        plan = view.solve.plan
        looks = plan is not None and len(plan.drawn) > 1 and not view.playing and self._shows.value
        self._look_at.visible = self._looked_at.visible = looks
        if looks and plan is not None:
            self._look_at.max = len(plan.drawn)
            if self._look_at.value > len(plan.drawn):
                self._look_at.value = 1
            self._looked_at.content = render("note", text=in_words(plan, int(self._look_at.value) - 1))

    def _draw_chart(self, solve: SolveView) -> None:
        there = part_round(len(solve.predicted), None)
        steps = np.arange(len(solve.predicted))[there] + solve.begins
        lines = (
            ChartLine("best rollout", solve.predicted[there], PREDICTED),
            ChartLine("what came", solve.achieved[there], ACHIEVED),
        )
        self._chart.draw("Reward a step, of the steps that a plan looks ahead", steps, lines)

    def _tell(self, view: SessionView) -> None:
        """Whichever tab is open: a person may not look at this one while it plans."""
        solved = view.solve.solved
        new = [one for one in solved if one not in self._told]
        self._told = solved
        for env, step in new[:MOST_TOLD]:
            several = view.task is not None and view.task.num_envs > 1
            what = f"Env {env} is solved" if several else "It is solved"
            tell_all(self._server, "Solved", f"{what} at step {step}.", color=None, seconds=8.0)


def horizon_seconds(plan: PlanOptions, control_dt: float, has_success: bool = True) -> float:
    """The horizon that a plan has, the usual one too."""
    return plan.steps(control_dt, has_success) * control_dt


def offers_better_mode(view: SessionView) -> bool:
    """Whether the robot has the control mode in which plans are found soonest, and another one is in effect."""
    if view.task is None or view.task.control_mode == BETTER_MODE:
        return False
    modes = {keyword.name: keyword for keyword in view.task.made.modes}
    return "control_mode" in modes and json.dumps(BETTER_MODE) in (modes["control_mode"].choices or ())


def in_words(plan: PlannedEnv, place: int) -> str:
    """The rollout that is looked at: ``12th of 64: return 3.2, succeeds at step 7``.

    Args:
        place: among those that are drawn.
    """
    number = plan.drawn[place]
    which = "The best rollout" if number == 0 else f"Rollout {number + 1} of {len(plan.returns)}"
    told = f"{which}: return {plan.returns[number]:.4g}"
    if number in (plan.plan, plan.hold):
        told += ", the last plan carried on" if number == plan.plan else ", which holds still"
    return told + (f", success at step {plan.success_at[number]}" if plan.success_at[number] else "")


def earned(rows: EnvRows, env: int) -> tuple[str, int] | None:
    """Return and steps of the env's episode, until its end if it has ended; None if it was not followed from its start."""
    if not rows.followed[env]:
        return None
    steps = rows.steps if rows.end[env] < 0 else rows.end
    return number_text(float(rows.total[env])), int(steps[env])


def is_flat(plan: PlannedEnv) -> bool:
    """Whether all rollouts earned the same, none of them by a success."""
    return bool(np.ptp(plan.returns) == 0 and not plan.success_at.any())


def solve_html(solve: SolveView, rows: EnvRows | None, env: int, link: LinkTo = no_links) -> str:
    """What the plan came to, or what to do for one.

    Args:
        rows: the table of envs.
        env: the selected one.
    """
    plan = solve.plan
    returns: list[tuple[str, str, float]] = []
    if plan is not None:
        returns = [
            ("best rollout", "Of all that were tried, the one that earns most", plan.returns[0]),
            (
                "last plan, carried on",
                "What was planned a step ago, without what was learned since: it is always tried too",
                plan.returns[plan.plan],
            ),
            ("holding still", "The robot stays as it is: that is always tried too", plan.returns[plan.hold]),
            ("worst rollout", "Of all that were tried, the one that earns least", plan.returns[-1]),
        ]
    return render(
        "solve",
        solve=solve,
        solved=solve.solved[:MOST_TOLD],
        more=max(0, len(solve.solved) - MOST_TOLD),
        several=rows is not None and rows.num_envs > 1,
        flat=plan is not None and is_flat(plan),
        returns=returns,
        earned=None if rows is None else earned(rows, env),
        per_second=rate_text(solve.steps_per_second),
        link=link,
    )
