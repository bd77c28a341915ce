"""Questions to a worker about cameras, rules, past moments and recordings, with the types of their answers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, get_args

import numpy as np
from numpy.typing import NDArray

from workbench.authoring.camera_source.cameras import HookCameras
from workbench.authoring.loading.reference import TaskName
from workbench.checks.results import RuleResult, StepProfile
from workbench.core.camera_data import CameraKey, CameraSettings, Picture
from workbench.core.cameras.report import CameraReport, OfferedPlacement, SearchSpace
from workbench.core.rules import Degree
from workbench.core.scene.shapes import SceneGeometry
from workbench.jobs.rescore.verdict import Rescore, RescoreMoments
from workbench.machine.processes.wire import Question
from workbench.planning.options import PlanArguments
from workbench.session.protocol.messages import Load, PlaceCamera, Reset, WarmUp

# --- cameras ---------------------------------------------------------------------------------------
# Each question is small, so that the worker that plays answers it between two steps: sixteen envs are sixteen questions.
# Only a search takes long: it goes to the worker in the background, and any request behind it ends it.


@dataclass(frozen=True)
class DrawCamera(Question[Picture]):
    """The picture of one camera in one env."""

    key: CameraKey
    settings: CameraSettings | None
    """Settings for this picture only; None for the current ones. Required for a camera that the env does not have: it
    stands still and is drawn as with a `scale`."""
    env: int
    modalities: tuple[str, ...] = ("rgb",)
    """Requested modalities; those that the camera's shader does not give are left out."""
    poses: NDArray[np.float32] | None = None
    """(B, 7) poses of the env's bodies at a past moment; None for now."""
    scale: float = 1.0
    """Factor on the picture's size. Other than 1 it needs `settings`, and a temporary camera with the minimal shader draws:
    colours, depth and segmentation."""


@dataclass(frozen=True)
class MeasureCamera(Question[CameraReport]):
    """Measure what one camera sees in one env."""

    key: CameraKey
    settings: CameraSettings | None
    """Settings to measure with; None for the env's own."""
    env: int
    poses: NDArray[np.float32] | None = None
    """(B, 7) poses of the env's bodies at a past moment, as in `DrawCamera`; None for now."""


@dataclass(frozen=True)
class SuggestCameras(Question[tuple[OfferedPlacement, ...]]):
    """Search placements of one camera from which it sees the given objects."""

    space: SearchSpace
    envs: tuple[int, ...]


@dataclass(frozen=True)
class RunCameras(Question[HookCameras]):
    """Run the camera hooks with other texts of the author's files."""

    task: TaskName
    """The task, by the reference with which it was opened."""
    texts: Mapping[str, str]
    """Text of each file, by path."""


CameraQuestion = DrawCamera | MeasureCamera | SuggestCameras | RunCameras


# --- checks ------------------------------------------------------------------------------------------
# Only for a worker that does not play: a check makes envs of its own and steps them. What it saw is kept for the next group.


@dataclass(frozen=True)
class CheckedGroup:
    """A group was checked; its results were sent before."""

    groups: int
    """Number of groups."""
    rules: int
    """Number of rules in all groups that are not off."""
    next: str
    """What the next group looks at; empty after the last group."""


@dataclass(frozen=True)
class RuleProgress:
    """Progress of the rules of a group."""

    rule: str
    """The rule that is being checked; empty for the rules of GPU simulation, which are checked together."""
    result: RuleResult | None = None
    """Result of the rule; None when its check begins."""


@dataclass(frozen=True)
class CheckGroup(Question[CheckedGroup]):
    """Check the rules of one group on the loaded version. A later request ends the check."""

    part: ClassVar[Any] = RuleProgress
    group: int
    """Index of the group, from 0 on, in the order of what people meet most."""
    degrees: Mapping[str, Degree]
    """Degree of each rule."""
    known: tuple[str, ...] = ()
    """Rules of the group that were checked before a job of higher priority came."""


@dataclass(frozen=True)
class ProfileStep(Question[StepProfile]):
    """Time the hooks and lines of a control step, on separate envs. A later request ends it."""


# --- plans -------------------------------------------------------------------------------------------
# Only for a worker that does not play: its envs are the rollouts.


@dataclass(frozen=True)
class PlannedEnv:
    """What was found for one env, and what the last round of its K rollouts earned."""

    env: int
    actions: NDArray[np.float32]
    """(S, A) actions for the control steps before the next plan."""
    horizon: int
    """H, control steps of a rollout."""
    returns: NDArray[np.float32]
    """(K,) return of each rollout, best first, NaN last."""
    plan: int
    """Index of the rollout that is the earlier plan, unchanged."""
    hold: int
    """Index of the rollout that holds still."""
    success_at: NDArray[np.int32]
    """(K,) the step of the horizon at which each succeeded, from 1 on; 0 if it did not."""
    paths: NDArray[np.float32]
    """(P, H + 1, 3) path of the traced body in some of the rollouts, best first; metres in the env's frame."""
    drawn: tuple[int, ...]
    """(P,) indices of the rollouts in `paths`."""
    traced: str
    """Name of the traced body; empty if the task has none to trace."""
    seconds: float


@dataclass(frozen=True)
class Planned:
    """Plans for the envs that were asked for, in their order."""

    envs: tuple[PlannedEnv, ...]


@dataclass(frozen=True)
class PlanActions(Question[Planned]):
    """Plan the next actions of some envs, continuing their last plans. A later request ends the planning."""

    snapshot: bytes
    """A pickled `core.snapshots.snapshot.Snapshot` of these envs."""
    bodies: tuple[dict[str, bytes], ...]
    """What each of these envs is built of, from `planning.rollouts.bodies_of`."""
    options: PlanArguments
    traced: str = ""
    """Name of the body to trace, as in `Settings.traced`."""


# --- moments of the past -----------------------------------------------------------------------------
# The server keeps the history and hands over snapshots and actions. Only for a worker that does not play: its envs move.


@dataclass(frozen=True)
class Captured:
    """What a recording stores of a moment."""

    columns: dict[str, NDArray]
    """State columns, as in `Stepped.columns`."""
    pictures: tuple[Picture, ...]


@dataclass(frozen=True)
class CaptureMoment(Question[Captured]):
    """Put the envs back to a past moment and read what a recording stores of it."""

    snapshot: bytes
    """A pickled `core.snapshots.snapshot.Snapshot` of the whole batch."""
    env_idx: tuple[int, ...]
    """The envs to draw."""
    pictures: bool
    """Whether to draw pictures."""


# --- the scene of a recording ------------------------------------------------------------------------


@dataclass(frozen=True)
class SceneMade:
    geometry: SceneGeometry
    poses: NDArray[np.float32]
    """(T + 1, B, 7) poses."""
    missed: tuple[str, ...]
    """States that could not be written into the env, each with its reason."""


@dataclass(frozen=True)
class MakeScene(Question[SceneMade]):
    """Make a recording's env in a worker without a task, and put it into each recorded state."""

    part: ClassVar[Any] = str
    task: str
    """Registered id of the task."""
    files: tuple[str, ...]
    """Task files to search before ManiSkill's registry."""
    env_kwargs: dict[str, Any]
    seed: int
    reset_options: dict[str, Any]
    env_states: dict[str, NDArray]
    """(T + 1, D) states by name."""
    imports: tuple[str, ...] = ()
    """Modules to import, as in `TaskOptions.imports`."""


# --- the list of tasks --------------------------------------------------------------------------------


@dataclass(frozen=True)
class ListTasks(Question[tuple[str, ...]]):
    """The ids that ManiSkill registers."""


@dataclass(frozen=True)
class TaskPicture:
    """A picture of a task, or why there is none."""

    pixels: NDArray[np.uint8] | None = None
    """(H, W, 3) pixels."""
    why_not: str = ""
    needs_download: bool = False
    """Whether the task or its robot lacks files that ManiSkill can download."""


@dataclass(frozen=True)
class DrawTask(Question[TaskPicture]):
    """Draw a picture of a registered task after a reset, by its human camera, or else by its first sensor."""

    env_id: str


QUESTIONS = (
    Load, Reset, PlaceCamera, WarmUp, *get_args(CameraQuestion), CheckGroup, ProfileStep, PlanActions, RescoreMoments, CaptureMoment,
    Rescore, MakeScene, ListTasks, DrawTask,
)  # fmt: skip
"""All types that a `Call` may hold."""
