"""The snapshot of the session that the page draws."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from workbench.envs.camera_data import CameraKey, Picture
from workbench.envs.gpu_rules import Finding
from workbench.envs.inspection import Inspection
from workbench.envs.step_result import StepResult
from workbench.live.history.env_table import EnvRows
from workbench.live.messages import ReloadReport, RulesBroken, Settings
from workbench.live.past import TimelineView
from workbench.live.pause_when import PauseWhen
from workbench.live.process.captured_output import NOTHING_PRINTED, Printed
from workbench.live.process.heartbeat import Busy
from workbench.live.process.supervisor import ProcessMemory
from workbench.live.run import PastLoad, Run, RunState
from workbench.task.description import Pulled, TaskDescription, TaskOptions
from workbench.task.problem import Problem

Part = TypeVar("Part")


@dataclass(frozen=True)
class SessionView:
    """Immutable snapshot of the session. Its serials tell the redraw loop cheaply which parts are new, so that nothing is
    drawn twice."""

    state: RunState = "starting"
    activity: str = ""
    """Current phase of starting or loading, else empty."""
    stale: bool = False
    """Whether the file on disk is newer than the running version, or does not load."""
    task: TaskDescription | None = None
    task_serial: int = 0
    """Increases with every successful load."""
    scene_serial: int = 0
    """Increases with every new scene, not with a version that is patched into the present one."""
    cameras_serial: int = 0
    """Increases with every new set of cameras."""
    load_milliseconds: float = 0.0
    reload: ReloadReport | None = None
    """How the running version was loaded; None for the first version."""
    timeline_cleared: bool = False
    """Whether the load of the running version started a new history."""
    loads: tuple[PastLoad, ...] = ()
    """The last loads, newest first."""
    choices: tuple[str, ...] = ()
    """Task classes of the file, the chosen class first; empty if the file has only one."""
    step: StepResult | None = None
    """The shown step: the newest, or a past one (`timeline`)."""
    step_serial: int = 0
    """Serial of the shown moment."""
    env_table: EnvRows | None = None
    """The table of envs at the shown moment, without the rewards; `Run.env_rows` has them."""
    pictures: Mapping[CameraKey, Picture] = field(default_factory=dict)
    pictures_serial: int = 0
    picture_milliseconds: float | None = None
    failed_cameras: Mapping[CameraKey, str] = field(default_factory=dict)
    """Cameras that cannot be drawn and are left out, with the reason as a sentence."""
    problem: Problem | None = None
    problem_serial: int = 0
    problem_at_run: bool = False
    """Whether `problem` occurred while the task ran, not during a load."""
    spoiled: str = ""
    """Why another process restored the version that ran when `problem` occurred; see `TaskFailed.spoiled`."""
    refused: Problem | None = None
    """Why the present version of the file does not run."""
    settings: Settings = Settings()
    """Settings chosen on the page."""
    pause_when: PauseWhen = PauseWhen()
    """Condition at which the run pauses."""
    paused_at: int | None = None
    """Serial of the moment at which the condition held; None once the run has continued."""
    pulled: Pulled | None = None
    """The pull by hand during the shown step."""
    slider_action: NDArray[np.float32] | None = None
    """(N, A) next action of the sliders; for a past moment, the action that led there. None if unknown."""
    options: TaskOptions = TaskOptions()
    """How the envs are made, apart from the seed in these options: the seed in use is `SessionView.seed`."""
    options_refused: TaskOptions | None = None
    """The options that were applied last, if the task failed with them; else None."""
    seed: int = 0
    pages: int = 0
    """Number of open pages."""
    playing: bool = False
    steps_per_second: float = 0.0
    real_time_factor: float = 0.0
    recorded_share: float = 0.0
    watched_share: float = 0.0
    """Speeds and shares of time, as in `Status`."""
    timeline: TimelineView = TimelineView()
    """The history. While a past moment is shown, `step` and `pictures` are those of that moment."""
    busy: Busy | None = None
    """A long-running call in the worker."""
    rules: RulesBroken | None = None
    """Rules of GPU simulation that the running version has broken; None for none."""
    rules_serial: int = 0
    odd: tuple[Finding, ...] = ()
    """Rules that the running version broke by outliers, one finding per rule."""
    inspection: Inspection | None = None
    """See `Run.inspection`."""
    printed: Printed = NOTHING_PRINTED
    """The last lines that the author's code printed."""
    vitals: ProcessMemory = ProcessMemory()
    """Memory of the processes."""
    known_policies: tuple[str, ...] = ()
    """Policies to choose from, from the last search."""
    features: Mapping[type[Any], Any] = field(default_factory=dict)
    """The view of each feature, by its class."""

    def of(self, kind: type[Part]) -> Part:
        """The view of a feature, such as ``of(StudioView)``. If the session has no such view: a view with
        default values."""
        return self.features[kind] if kind in self.features else kind()

    @property
    def played(self) -> tuple[Finding, ...]:
        """Findings while playing: broken rules of GPU simulation, and outliers."""
        return (*(() if self.rules is None else self.rules.rows), *self.odd)

    @property
    def selected_env(self) -> int:
        """The env whose pictures and numbers are shown."""
        return self.settings.selected_env


_OF_RUN = {one.name for one in fields(SessionView)} & {one.name for one in fields(Run)}
"""Fields that a view copies unchanged from the run."""


def view_of(run: Run, **known: Any) -> SessionView:
    """The view of the run at the shown moment.

    Args:
        known: further fields of the view.
    """
    refused = run.problem if run.stale and not run.problem_at_run else None
    now = SessionView(**{name: getattr(run, name) for name in _OF_RUN}, refused=refused, **known)
    past = run.past
    if past is None:
        return now
    at = past.history.at(past.at)
    view = replace(
        now,
        timeline_cleared=run.after_load == "gone",
        timeline=past.view(run.env, run.settings.cameras, run.settings.pictures),
        odd=past.history.findings,
        env_table=None if at is None else at.rows,
    )
    moment = past.shown
    if moment is None:
        return view
    return replace(
        view,
        step=moment.step,
        step_serial=moment.serial,
        pictures=past.pictures(run.env),
        slider_action=moment.step.action,
        pulled=moment.pulled,
    )
