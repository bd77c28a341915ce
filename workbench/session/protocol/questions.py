"""What a worker is asked besides to load a task and to reset it, each with what its answer is.

About cameras: each question is small, so that a worker that plays answers it between two steps: who wants sixteen envs
judged asks sixteen times. A search alone takes long, and is asked of a worker in the background; any request behind it
ends it. About moments of the past: the server has them all (`history`); it hands over snapshots and actions, some at a
time. Only of a worker that does not play, since its envs are put wherever the moments are.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, get_args

import numpy as np
from numpy.typing import NDArray

from workbench.authoring.camera_source.cameras import HookCameras
from workbench.authoring.loading.reference import TaskName
from workbench.authoring.problem import Problem
from workbench.core.camera_data import CameraKey, CameraSettings, Picture
from workbench.core.cameras.report import CameraReport, OfferedPlacement, SearchSpace
from workbench.core.env.step_result import StepResult
from workbench.core.scene.shapes import SceneGeometry
from workbench.jobs.verdict import Rescore
from workbench.machine.processes.wire import Question
from workbench.session.protocol.messages import Load, PlaceCamera, Reset, WarmUp

# --- cameras ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class DrawCamera(Question[Picture]):
    """The picture of one camera in one env."""

    key: CameraKey
    settings: CameraSettings | None
    """Drawn as if it were placed so, and left as it is; None for as it is placed. Of a camera that the env has not
    they must be given: it is one that stands still, and is drawn as with a `scale`."""
    env: int
    modalities: tuple[str, ...] = ("rgb",)
    """Those that its shader does not give are left out."""
    poses: NDArray[np.float32] | None = None
    """(B, 7) of the env's bodies at a moment of the past; None for now."""
    scale: float = 1.0
    """Other than 1: in a picture whose sides are so much of `settings`' (which must be given), by a camera beside the
    env's, with the minimal shader: colours, depth and segmentation."""


@dataclass(frozen=True)
class MeasureCamera(Question[CameraReport]):
    """Measure what one camera sees in one env."""

    key: CameraKey
    settings: CameraSettings | None
    """None for the env's own."""
    env: int
    poses: NDArray[np.float32] | None = None
    """As in `DrawCamera`."""


@dataclass(frozen=True)
class SuggestCameras(Question[tuple[OfferedPlacement, ...]]):
    """Search placements of one camera that see some objects."""

    space: SearchSpace
    envs: tuple[int, ...]


@dataclass(frozen=True)
class RunCameras(Question[HookCameras]):
    """Run the camera hooks with other texts of the author's files."""

    task: TaskName
    """What was opened."""
    texts: Mapping[str, str]
    """By path."""


CameraQuestion = DrawCamera | MeasureCamera | SuggestCameras | RunCameras


# --- moments of the past -----------------------------------------------------------------------------


@dataclass(frozen=True)
class MomentToRescore:
    """A moment of the past to be lived through again: a control step, or a jump if it has a snapshot."""

    action: NDArray[np.float32] | None
    """(N, A) that was made; None for a jump, or a task without robots."""
    snapshot: bytes | None = None
    """A pickled `core.snapshots.snapshot.Snapshot` of the whole batch."""
    env_idx: tuple[int, ...] = ()
    """The envs that are put back to it."""


@dataclass(frozen=True)
class RescoredMoments:
    """What the task says of some moments now."""

    steps: tuple[StepResult, ...]
    """One for each moment; fewer if one raised."""
    not_carried: dict[str, str]
    """What jumps of all envs among them could not put back, and why."""
    problem: Problem | None = None
    """What the moment after `steps` raised."""


@dataclass(frozen=True)
class RescoreMoments(Question[RescoredMoments]):
    """Live through these moments, in order. Only for a worker that does not play."""

    moments: tuple[MomentToRescore, ...]


@dataclass(frozen=True)
class Captured:
    """What a recording would have kept of a moment."""

    columns: dict[str, NDArray]
    """As `Stepped.columns`."""
    pictures: tuple[Picture, ...]


@dataclass(frozen=True)
class CaptureMoment(Question[Captured]):
    """Put the envs back to a moment of the past that is to be recorded after the fact. Only for a worker that does not
    play."""

    snapshot: bytes
    """A pickled `core.snapshots.snapshot.Snapshot` of the whole batch."""
    env_idx: tuple[int, ...]
    """Those whose pictures are wanted, if any."""
    pictures: bool


# --- the scene of a recording ------------------------------------------------------------------------


@dataclass(frozen=True)
class SceneMade:
    geometry: SceneGeometry
    poses: NDArray[np.float32]
    """(T + 1, B, 7)"""
    missed: tuple[str, ...]
    """What of the states could not be put into the env, each with its reason."""


@dataclass(frozen=True)
class MakeScene(Question[SceneMade]):
    """Have a worker that holds no task make a recording's env, and put it into each recorded state."""

    part: ClassVar[Any] = str
    task: str
    """Registered id."""
    files: tuple[str, ...]
    """Task files in which it may be found before ManiSkill is asked."""
    env_kwargs: dict[str, Any]
    seed: int
    reset_options: dict[str, Any]
    env_states: dict[str, NDArray]
    """(T + 1, D) by name."""
    imports: tuple[str, ...] = ()
    """As `TaskOptions.imports`."""


QUESTIONS = (
    Load, Reset, PlaceCamera, WarmUp, *get_args(CameraQuestion), RescoreMoments, CaptureMoment, Rescore, MakeScene
)  # fmt: skip
"""All that come in a `Call`."""
