"""The folder *Solve* of the Try tab: planning options, the returns of the rollouts, and their paths in the 3-D view."""

from __future__ import annotations

import json
from typing import get_args

import numpy as np
import viser
from numpy.typing import NDArray

from workbench.live.commands import ChooseActions, UseControlMode
from workbench.live.history.env_table import EnvRows
from workbench.live.run import movable_bodies
from workbench.live.session_protocol import LiveSession
from workbench.live.view import SessionView
from workbench.machine.text import number_text, rate_text
from workbench.page.command import Command, Refused
from workbench.page.commands import ShownOn
from workbench.page.widgets.editor_links import LinkTo, no_links
from workbench.page.widgets.fields import choice, slider
from workbench.page.widgets.line_chart import ChartLine, LineChart, part_round
from workbench.page.widgets.notices import notify_all
from workbench.page.widgets.open_tabs import OpenTabs
from workbench.page.widgets.parts import PagePart
from workbench.page.widgets.templates import render
from workbench.page.widgets.tools import Tool, tool, tools_html
from workbench.page.widgets.visitors import Visitor
from workbench.planning.options import PlanOptions
from workbench.record.commands import SaveSolved
from workbench.record.state import RecordingStatus
from workbench.solve.commands import (
    MAX_HORIZON_SECONDS,
    ChooseMethod,
    ChoosePlannedEnvs,
    FollowBody,
    LookAtRollout,
    SetHorizon,
    SetNoise,
    SetPlanEvery,
    SetRollouts,
    SetTemperature,
    ShowRollouts,
)
from workbench.solve.questions import PlannedEnv
from workbench.solve.rollout_traces import RolloutTraces
from workbench.solve.state import SolveView

TAB = "Try"
THIS_ENV, ALL_ENVS = "the selected env", "all envs, in turn"
PLANNED_ENVS = {THIS_ENV: "selected", ALL_ENVS: "all"}
METHODS = {"MPPI": "mppi", "predictive sampling": "predictive", "CEM": "cem"}
SOLVE_NOW = "Solve the selected env"
SOLVE_HINT = "Choose solve as the source of actions: they are planned by rollouts with the task's own reward"
SAVE_SOLVED = "Save the solved episode"
TOOL = "the robot's tool"
BETTER_MODE = "pd_ee_delta_pose"
USE_MODE = "Plan in end-effector control (resets the envs)"
USE_MODE_HINT = "Rebuilds the envs with the control mode pd_ee_delta_pose, in which plans are found fastest"
MAX_NAMED_ENVS = 4
"""Maximum number of newly solved envs that are named."""
CHART_HEIGHT_PIXELS = 150
PREDICTED, ACHIEVED = "#228be6", "#f08c00"


class SolvePanel(PagePart[SessionView]):
    """The folder, shown while the source of actions is *solve*; else a button that chooses this source.

    Args:
        server: The page.
        session: The session.
        tabs: The open tab of each page.
        link: Links the lines of the author's files.
    """

    does = (ShowRollouts, LookAtRollout)

    def __init__(
        self, server: viser.ViserServer, session: LiveSession, tabs: OpenTabs, link: LinkTo = no_links
    ) -> None:
        self._server, self._session, self._tabs, self._link = server, session, tabs, link
        gui = server.gui
        self._traces = RolloutTraces(server)
        self._told: tuple[tuple[int, int], ...] = ()
        self._rollouts_on: ShownOn = "on this tab"
        self._place = 0
        """Index of the chosen rollout among the drawn ones."""
        self._begin = gui.add_html("")
        self._folder = gui.add_folder("Solve", visible=False)
        with self._folder:
            self._status = gui.add_html("")
            self._save = gui.add_html("")
            self._saving = gui.add_html("")
            self._mode = gui.add_html("")
            self._build_settings()
            self._build_rollouts()
            self._chart = LineChart(server, CHART_HEIGHT_PIXELS)

    def _build_settings(self) -> None:
        server = self._server
        self._envs = choice(
            server,
            "Plan for",
            ChoosePlannedEnvs,
            "envs",
            PLANNED_ENVS,
            "selected",
            hint="Envs that are not planned for hold still.",
        )
        self._method = choice(
            server,
            "Method",
            ChooseMethod,
            "method",
            METHODS,
            "mppi",
            hint="How rollouts become the plan. MPPI: the mean of all, weighted by what they earned. Predictive "
            "sampling: the best one. CEM: the mean of the best tenth.",
        )
        self._rollouts = slider(
            server,
            "Rollouts",
            SetRollouts,
            "rollouts",
            step=8,
            hint="Candidates that are tried at a time, each in its own env.",
        )
        self._horizon = slider(
            server,
            "Horizon",
            SetHorizon,
            "horizon",
            step=0.05,
            hint="Seconds that a plan looks ahead.",
        )
        self._noise = slider(
            server,
            "Noise",
            SetNoise,
            "noise",
            step=0.05,
            hint="Standard deviation of the candidates around the plan, as a share of half the range of each action.",
        )
        self._temperature = slider(
            server,
            "Temperature",
            SetTemperature,
            "temperature",
            step=0.01,
            hint="The lower, the more the best rollouts count.",
        )
        self._every = slider(
            server,
            "Plan every",
            SetPlanEvery,
            "every",
            hint="Control steps that are taken before the next plan.",
        )

    def _build_rollouts(self) -> None:
        server = self._server
        self._shows = choice(
            server,
            "Show rollouts",
            ShowRollouts,
            "where",
            get_args(ShownOn),
            self._rollouts_on,
            hint="Draw the path of a body in each rollout as a line in the 3-D view. The best is bright.",
        )
        self._traced = choice(
            server,
            "Lines follow",
            FollowBody,
            "body",
            {TOOL: ""},
            "",
            hint="The body whose paths are drawn, from the next plan on.",
        )
        self._look_at = slider(
            server,
            "Look at",
            LookAtRollout,
            "number",
            (1, 2),
            hint="A rollout of the last plan, from the best to the worst.",
        )
        self._look_at.visible = False
        self._looked_at = server.gui.add_html("", visible=False)

    # --- commands --------------------------------------------------------------------------------

    def do(self, command: Command, visitor: Visitor) -> None:
        match command:
            case ShowRollouts(where=where):
                self._rollouts_on = where
            case LookAtRollout(number=number):
                plan = self._session.view().of(SolveView).plan
                if plan is None or number > len(plan.drawn):
                    raise Refused("There is no such rollout.")
                self._place = number - 1

    # --- drawing ---------------------------------------------------------------------------------

    def draw(self, view: SessionView) -> None:
        task, solve = view.task, view.of(SolveView)
        shown = view.settings.action_source == "solve" and task is not None
        self._folder.visible = shown
        begin = Tool(SOLVE_NOW, ChooseActions(source="solve"), SOLVE_HINT, off=task is None)
        self._begin.content = "" if shown else tools_html([begin])
        if not shown or task is None:
            self._chart.hide()
            self._told = solve.solved
            return
        plan = view.settings.plan
        self._status.content = solve_html(solve, view.env_table, view.selected_env, self._link)
        self._draw_saving(view)
        better = Tool(USE_MODE, UseControlMode(mode=BETTER_MODE), USE_MODE_HINT)
        self._mode.content = tools_html([better] if offers_better_mode(view) else [])
        self._envs.visible = task.num_envs > 1
        self._envs.show("all" if view.settings.solve_all else "selected")
        self._method.show(plan.method)
        self._rollouts.show(plan.rollouts)
        has_success = view.step is None or "success" in view.step.evaluate
        seconds = horizon_seconds(plan, task.control_dt, has_success)
        self._horizon.show(round(min(seconds, MAX_HORIZON_SECONDS), 2))
        self._noise.show(plan.noise)
        self._temperature.show(plan.temperature)
        self._temperature.visible = plan.method == "mppi"
        self._every.show(plan.every)
        self._shows.show(self._rollouts_on)
        self._draw_traced(view)
        self._draw_looked_at(view)
        self._draw_chart(solve)
        self._notify(view)

    def draw_in_view(self, view: SessionView, offset: NDArray[np.float32]) -> None:
        """Draw the paths of the last plan's rollouts.

        Args:
            offset: (3,) offset of the selected env on the grid.
        """
        plan = view.of(SolveView).plan
        there = (
            view.settings.action_source == "solve"
            and self._tabs.shows(self._rollouts_on, TAB)
            and view.timeline.shown is None
        )
        if plan is None or not there:
            self._traces.draw(None, offset, 0)
        else:
            self._traces.draw(plan.paths, offset, 0 if view.playing else self._place_in(plan))

    def _place_in(self, plan: PlannedEnv) -> int:
        """Index of the chosen rollout among the drawn ones; 0, the best one, if this plan draws too few."""
        return self._place if self._place < len(plan.drawn) else 0

    def _draw_saving(self, view: SessionView) -> None:
        saving = view.of(RecordingStatus).saving
        offered = bool(view.of(SolveView).solved) and not view.playing
        save = tool(SAVE_SOLVED, SaveSolved(), off=saving.progress is not None, tone="main")
        self._save.content = tools_html([save] if offered else [])
        self._saving.content = render("saving", saving=saving) if offered else ""

    def _draw_traced(self, view: SessionView) -> None:
        options = {TOOL: "", **{name: name for name in movable_bodies(view.task)}}
        traced = view.settings.traced
        self._traced.show(traced if traced in options.values() else "", options=options)

    def _draw_looked_at(self, view: SessionView) -> None:
        plan = view.of(SolveView).plan
        looks = plan is not None and len(plan.drawn) > 1 and not view.playing and self._rollouts_on != "off"
        self._look_at.visible = self._looked_at.visible = looks
        if looks and plan is not None:
            place = self._place_in(plan)
            self._look_at.show(place + 1, bounds=(1, len(plan.drawn)))
            self._looked_at.content = render("note", text=in_words(plan, place))

    def _draw_chart(self, solve: SolveView) -> None:
        there = part_round(len(solve.predicted), None)
        steps = np.arange(len(solve.predicted))[there] + solve.begins
        lines = (
            ChartLine("best rollout", solve.predicted[there], PREDICTED),
            ChartLine("achieved", solve.achieved[there], ACHIEVED),
        )
        self._chart.draw("Mean reward per step over the horizon of the plan", steps, lines)

    def _notify(self, view: SessionView) -> None:
        """Notify every page of newly solved envs, whichever tab is open: a person may look at another tab
        during planning."""
        solved = view.of(SolveView).solved
        new = [one for one in solved if one not in self._told]
        self._told = solved
        for env, step in new[:MAX_NAMED_ENVS]:
            several = view.task is not None and view.task.num_envs > 1
            what = f"Env {env} is solved" if several else "The episode is solved"
            notify_all(self._server, "Solved", f"{what} at step {step}.", color=None, seconds=8.0)


def horizon_seconds(plan: PlanOptions, control_dt: float, has_success: bool = True) -> float:
    """Horizon of a plan in seconds; the default horizon if `plan.horizon` is 0."""
    return plan.steps(control_dt, has_success) * control_dt


def offers_better_mode(view: SessionView) -> bool:
    """Whether the robot has the control mode in which plans are found fastest, but uses another one."""
    if view.task is None or view.task.control_mode == BETTER_MODE:
        return False
    modes = {keyword.name: keyword for keyword in view.task.made.modes}
    return "control_mode" in modes and json.dumps(BETTER_MODE) in (modes["control_mode"].choices or ())


def in_words(plan: PlannedEnv, place: int) -> str:
    """Text about the chosen rollout: ``Rollout 12 of 64: return 3.2, success at step 7``.

    Args:
        place: index among the drawn rollouts.
    """
    number = plan.drawn[place]
    which = "The best rollout" if number == 0 else f"Rollout {number + 1} of {len(plan.returns)}"
    text = f"{which}: return {plan.returns[number]:.4g}"
    if number in (plan.plan, plan.hold):
        text += ", the last plan carried on" if number == plan.plan else ", holding still"
    return text + (f", success at step {plan.success_at[number]}" if plan.success_at[number] else "")


def earned(rows: EnvRows, env: int) -> tuple[str, int] | None:
    """Return and steps of the env's episode so far, or until its end; None if the table lacks the start of
    the episode."""
    if not rows.followed[env]:
        return None
    steps = rows.steps if rows.end[env] < 0 else rows.end
    return number_text(float(rows.total[env])), int(steps[env])


def is_flat(plan: PlannedEnv) -> bool:
    """Whether all rollouts have the same return and none succeeds."""
    return bool(np.ptp(plan.returns) == 0 and not plan.success_at.any())


def solve_html(solve: SolveView, rows: EnvRows | None, env: int, link: LinkTo = no_links) -> str:
    """HTML of the plan's result, or of what to do to get a plan.

    Args:
        rows: the table of envs.
        env: the selected env.
    """
    plan = solve.plan
    returns: list[tuple[str, str, float]] = []
    if plan is not None:
        returns = [
            ("best rollout", "The rollout that earns most", plan.returns[0]),
            (
                "last plan, carried on",
                "The previous plan, unchanged: one rollout always tries it",
                plan.returns[plan.plan],
            ),
            ("holding still", "The robot holds still: one rollout always tries it", plan.returns[plan.hold]),
            ("worst rollout", "The rollout that earns least", plan.returns[-1]),
        ]
    return render(
        "solve",
        solve=solve,
        solved=solve.solved[:MAX_NAMED_ENVS],
        more=max(0, len(solve.solved) - MAX_NAMED_ENVS),
        several=rows is not None and rows.num_envs > 1,
        flat=plan is not None and is_flat(plan),
        returns=returns,
        earned=None if rows is None else earned(rows, env),
        per_second=rate_text(solve.steps_per_second),
        link=link,
    )
