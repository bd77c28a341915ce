"""What the page reads: one immutable snapshot of the session, taken as often as it likes.

The page is redrawn by one loop that compares this snapshot with the last one it drew. Counters
(``serial``) say cheaply whether a part is new, so nothing is drawn or sent twice.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from workbench.authoring.problem import Problem
from workbench.core.camera_data import CameraInfo, CameraKey, CameraKind, Picture
from workbench.core.capture.inspection import Inspection
from workbench.core.env.step_result import StepResult
from workbench.jobs.task import TaskDescription
from workbench.session.cameras.view import StudioView
from workbench.session.history.curves import Curves
from workbench.session.live.timeline import TimelineView
from workbench.session.process.captured_output import NOTHING_PRINTED, Printed
from workbench.session.process.heartbeat import Busy
from workbench.session.process.supervisor import Vitals
from workbench.session.protocol.messages import ReloadReport, RulesBroken, Settings
from workbench.session.record.live import RecordingStatus
from workbench.session.rescore.background import RescoreView

State = Literal["starting", "loading", "running", "paused", "error", "stopped"]
"""``starting``: the worker process is coming up. ``loading``: a task is being imported or built.
``error``: a problem stands (see `SessionView.problem`); ``stopped``: the worker is gone."""


@dataclass(frozen=True)
class Seen:
    """What cameras see of the env that is looked at: a session's at the moment that is shown, or a recording's."""

    cameras: tuple[CameraInfo, ...]
    cameras_serial: int
    """Another one for another set of cameras."""
    pictures: dict[CameraKey, Picture]
    pictures_serial: int
    segmentation: dict[int, str]
    """Names of the ids in a segmentation."""
    env: int = 0
    milliseconds: float | None = None
    """That the newest picture took; None for one that was recorded."""
    can_render: bool = True
    placed: CameraKey | None = None
    """The camera that is placed by hand."""
    quick: bool = False
    """That one is looked through in another size than its own."""


@dataclass(frozen=True)
class SessionView:
    state: State = "starting"
    activity: str = ""
    """What is being done while starting or loading, else empty."""
    stale: bool = False
    """The file on disk is newer than (or failed to become) the version that is shown."""
    task: TaskDescription | None = None
    task_serial: int = 0
    """Grows with every load that succeeded."""
    scene_serial: int = 0
    """Grows with every scene: not with a version that was put on the one that is there."""
    cameras_serial: int = 0
    """Grows with every set of cameras."""
    load_milliseconds: float = 0.0
    reload: ReloadReport | None = None
    """How the version that is shown came in; None for the first."""
    choices: tuple[str, ...] = ()
    """What can be chosen in the file, where it has several tasks: the one that was asked for first."""
    step: StepResult | None = None
    """What is shown: the newest step, or a moment of the past (`timeline`)."""
    step_serial: int = 0
    """Number of the moment that is shown."""
    pictures: dict[tuple[CameraKind, str], Picture] = field(default_factory=dict)
    pictures_serial: int = 0
    picture_milliseconds: float = 0.0
    problem: Problem | None = None
    problem_serial: int = 0
    refused: Problem | None = None
    """Why what the file holds does not run, while another version does or none."""
    curves: Curves | None = None
    settings: Settings = Settings()
    """What pages chose."""
    seed: int = 0
    playing: bool = False
    steps_per_second: float = 0.0
    real_time_factor: float = 0.0
    timeline: TimelineView = TimelineView()
    """The past. While a moment of it is shown, `step` and `pictures` are of that moment."""
    busy: Busy | None = None
    """What the worker has been at for long."""
    rules: RulesBroken | None = None
    """What the version that is shown has broken of the rules of GPU simulation; None while nothing."""
    rules_serial: int = 0
    inspection: Inspection | None = None
    """The newest answer to `Session.inspect`, of whichever env was selected then."""
    recording: RecordingStatus = RecordingStatus()
    printed: Printed = NOTHING_PRINTED
    """The last lines that the author's code printed."""
    vitals: Vitals = Vitals()
    """What the processes hold."""
    rescored: RescoreView = RescoreView()
    """What the new code says of the episodes that were run with the old."""
    studio: StudioView = StudioView()
    """Cameras, as they are placed by hand."""

    @property
    def seen(self) -> Seen | None:
        """None while there is no task."""
        task, studio = self.task, self.studio
        return task and Seen(
            task.cameras,
            self.cameras_serial,
            self.pictures,
            self.pictures_serial,
            task.segmentation,
            self.selected_env,
            self.picture_milliseconds,
            task.can_render,
            studio.selected,
            studio.quick_scale != 1.0,
        )

    @property
    def selected_env(self) -> int:
        """Whose pictures and numbers are shown."""
        return self.settings.selected_env
