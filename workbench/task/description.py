"""Options, description and step results of a task as plain data, without torch."""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from workbench.envs.camera_data import CameraInfo, CameraKey, CameraSettings, Picture, PictureDegree
from workbench.envs.gpu_rules import Degree, Finding
from workbench.envs.keywords import HowMade
from workbench.envs.robots import RobotDescription
from workbench.envs.scene.shapes import SceneGeometry
from workbench.envs.step_result import StepResult
from workbench.pictures.camera_report import ObjectToSee

Backend = Literal["auto", "cpu", "gpu"]
ShownPictures = Literal["auto", "exact", "fast"]
"""Quality of the camera pictures on the page. ``auto``: fast during motion, exact at rest."""


@dataclass(frozen=True)
class TaskOptions:
    """Options of a task, for the page, recordings and benchmarks."""

    num_envs: int = 16
    backend: Backend = "auto"
    seed: int = 0
    env_kwargs: dict[str, Any] = field(default_factory=dict)
    """More keyword arguments of the task class (``robot_uids``, ``obs_mode`` ...)."""
    pictures: PictureDegree = "exact"
    """Quality of the pictures that the envs render for observations and recordings."""
    rules: Degree | None = None
    """Degree of all rules of GPU simulation; None keeps each rule's own degree, see `envs.gpu_rules`."""
    imports: tuple[str, ...] = ()
    """Modules to import before the task; they may register its id."""


def changed_options(before: TaskOptions, after: TaskOptions) -> list[str]:
    """Names of the options that differ, except the seed; keyword arguments are listed by their own names."""
    names = [
        one.name
        for one in fields(TaskOptions)
        if one.name not in ("seed", "env_kwargs") and getattr(before, one.name) != getattr(after, one.name)
    ]
    absent = object()
    given = dict.fromkeys((*before.env_kwargs, *after.env_kwargs))
    differs = (n for n in given if before.env_kwargs.get(n, absent) != after.env_kwargs.get(n, absent))
    return [*names, *differs]


def command_line(reference: str, options: TaskOptions) -> str:
    """Command that opens a task with these options from any folder."""
    words = ["workbench", "open", reference]
    usual = TaskOptions()
    for name in ("num_envs", "backend", "seed", "rules"):
        if (value := getattr(options, name)) != getattr(usual, name):
            words += [f"--{name.replace('_', '-')}", str(value)]
    for module in options.imports:
        words += ["--import", module]
    for name, value in options.env_kwargs.items():
        words += ["--env", f"{name}={_argument_text(value)}"]
    return shlex.join(words)


def _argument_text(value: Any) -> str:
    """The text that ``--env`` parses to this value: its JSON, but for a string that is not JSON, the string
    itself."""
    if isinstance(value, str):
        try:
            json.loads(value)
        except ValueError:
            return value
    return json.dumps(value)


@dataclass(frozen=True)
class ActionDimension:
    """One number of the action of one env."""

    name: str
    """For example ``arm/panda_joint1`` or ``gripper``."""
    low: float
    high: float
    zero_holds: bool = True
    """Whether zero leaves the robot where it is: True for deltas and velocities, False for absolute targets."""


@dataclass(frozen=True)
class ArmDescription:
    """An arm of a robot."""

    body: str
    """Body name of the end effector."""
    joints: tuple[str, ...]
    """Names of the joints that move it, from the root on."""


@dataclass(frozen=True)
class TaskDescription:
    """A loaded task, for the page."""

    env_id: str
    """Registered id, or the class name of an unregistered task."""
    class_name: str
    file: str | None
    """Source file of the class."""
    source_files: tuple[str, ...]
    """The task's file and the modules that it imported from its folder: the watcher follows these."""
    source_hash: str
    """sha256 over `source_files`, 12 hex digits."""
    source: dict[str, str]
    """Text of `source_files` by path."""
    backend: str
    """For example ``cpu (batched)`` or ``gpu``."""
    device: str
    """For example ``cpu`` or ``cuda:0``, followed by the render device's name."""
    num_envs: int
    max_episode_steps: int | None
    obs_mode: str
    reward_mode: str
    control_mode: str | None
    control_dt: float
    """Seconds of simulated time in one control step."""
    actions: tuple[ActionDimension, ...]
    geometry: SceneGeometry
    cameras: tuple[CameraInfo, ...]
    segmentation: dict[int, str]
    """Body name by segmentation id."""
    can_render: bool
    pictures: PictureDegree = "exact"
    """Quality of the pictures that its envs render for observations and recordings."""
    chosen: str = ""
    """Name of the open class: the task's, or that of a robot shown in a scene."""
    others: tuple[str, ...] = ()
    """The other tasks of the file."""
    in_place_of: str | None = None
    """The class of the file that was tried first and failed."""
    env_kwargs: dict[str, Any] = field(default_factory=dict)
    """Keyword arguments with which ``gym.make`` makes such an env, as far as JSON can represent them."""
    objects: tuple[ObjectToSee, ...] = ()
    """Objects for which a camera report can state how well a camera sees them."""
    joints: tuple[str, ...] = ()
    """Names of the joints whose positions are in `StepResult.qpos`."""
    robots: tuple[RobotDescription, ...] = ()
    """The robots whose joints a person can set."""
    notices: tuple[str, ...] = ()
    """Notices about a working task, as sentences."""
    arms: tuple[ArmDescription, ...] = ()
    """The arms of all robots."""
    armless: tuple[str, ...] = ()
    """Robots without an arm."""
    parse_cameras: str = "parse_camera_configs"
    """Name of the installed ManiSkill's function that parses what a camera hook returns."""
    outlier_rules: Mapping[str, Finding] = field(default_factory=dict)
    """The rules that an outlier can break, by id. Each value is a template of a finding, placed at the hook
    that the rule guards. Rules that are off, or silenced at the hook, are left out."""
    made: HowMade = HowMade()
    """How the envs are made: robot, modes and the task's own keyword arguments."""

    def camera(self, key: CameraKey) -> CameraInfo | None:
        return next((camera for camera in self.cameras if camera.key == key), None)


NO_MOMENT = -1
"""The `Restored.origin` of a state that is not in this history."""


@dataclass(frozen=True)
class Restored:
    """The result of a `Restore` or an `EnterRecording`."""

    env_idx: tuple[int, ...]
    """The envs that were set."""
    source: tuple[int, ...]
    """For each env of `env_idx`: the index, in the snapshot, of the env whose state it got."""
    origin: int
    """The server's number of the restored moment, or `NO_MOMENT`."""
    undoes: int | None
    """The server's number of the jump that this undoes; None if it undoes none."""
    not_carried: dict[str, str]
    """Parts that could not be restored, with the reasons; empty within one version of a task."""
    recording: str = ""
    """Description of the episode and the state that an `EnterRecording` restored; `origin` is then `NO_MOMENT`."""
    how: str = ""
    """How the state was reached, as a sentence; empty if it was restored without a replay."""
    number: int = 0
    """Number of the `EnterRecording` that this result answers; 0 for a `Restore`."""
    replayed: tuple[int, ...] = ()
    """Indices of the envs that were replayed up to the state. A restored state is an exact point: from it,
    the same actions give the same bits. A replayed state is not."""
    moved: str = ""
    """Name of the body or robot that a `MoveBody` or `MoveJoints` moved; empty for other requests."""


@dataclass(frozen=True)
class Pulled:
    """A pull by hand during one control step."""

    env: int
    body: str
    newtons: float
    """Mean norm of the spring's force over the substeps."""


@dataclass(frozen=True)
class Stepped:
    """One reset, control step, restore or move by hand of the batch. Each is sent, in order; none is left out."""

    step: StepResult
    reset_mask: NDArray[np.bool_]
    """(N,) True for each env whose result does not follow from its previous result: it is the first of a new
    episode, or a state that was restored or made by hand (see `restored`)."""
    captured: tuple[Picture, ...] = ()
    """Pictures of exactly this step (only while capturing)."""
    seeds: NDArray[np.int64] | None = None
    """(N,) episode seed of each env, if this result is of a reset."""
    snapshot: bytes = b""
    """The body of the snapshot of the whole batch at this moment (see `envs.snapshots.packing`): opaque to the
    server, whose `History.snapshot_at` makes a pickled `Snapshot` of it."""
    part_keys: tuple[int, ...] | None = None
    """Keys of the snapshot's parts; None if unchanged since the previous result."""
    new_parts: dict[int, bytes] = field(default_factory=dict)
    """Parts of the snapshot that were not sent with an earlier result, by key."""
    number: int = 0
    """Number of this result, counted since the worker started; `Pictures.number` refers to it."""
    restored: Restored | None = None
    columns: dict[str, NDArray] = field(default_factory=dict)
    """(N, ...) arrays by the names of `envs.state_columns`: ``state/actors/cube``, ``obs/agent/qpos``. Only while
    capturing."""
    acted_by: str = ""
    """Source of this step's action, for a recording; empty: the recording keeps the source that it has."""
    placed: dict[CameraKey, CameraSettings] = field(default_factory=dict)
    """The cameras that are placed by hand (only while capturing)."""
    resumed: bool = False
    """Whether the envs continue from the state that the previous worker left. The result then does not follow
    from an earlier result of this worker, although nothing was reset."""
    pulled: Pulled | None = None
    """The pull by hand during this control step; the action alone does not lead to this result."""


@dataclass(frozen=True)
class RecordArguments:
    """
    Args:
        task: a task file, file.py:ClassName, package.module:ClassName, or a registered env id such as PickCube-v1.
        out: folder for the files.
        upload: fsspec URL (such as s3://bucket/folder) to which each finished episode is uploaded, instead of being kept in the
            folder.
        episodes: number of episodes over all envs; default: 4, or as many as a file of actions has.
        successes: continue until this many episodes succeed, and keep only those.
        tries: with --successes, give up after this many episodes; default: 100 for each success.
        actions: random, zero, hold; solve, which plans with rollouts of the task and its own reward; a policy as
            module:function or file.py:function; or a file: .npy or .npz with actions, or .h5 with ManiSkill's
            demonstrations, which begin from their own seeds.
        use_env_states: restore the demonstration's env state after each step.
        pictures: record the pictures of every camera (--no-pictures is much faster).
        fast_pictures: render simplified meshes: several times faster without a GPU; the pictures differ slightly from a GPU's. The
            recordings are marked, in their .json and in the review.
        max_steps: maximum length of an episode; default: the task's own limit, or 200 steps if it has none.
        seconds_per_seed: wall time limit of an episode: after it, the episode ends at its next step, solved
            or not. Which episodes reach the limit depends on the machine and its load, so a second run may
            differ.
    """

    task: str
    out: Path = Path("recordings")
    episodes: int | None = None
    successes: int | None = None
    tries: int | None = None
    actions: str = "random"
    use_env_states: bool = False
    pictures: bool = True
    fast_pictures: bool = False
    max_steps: int | None = None
    seconds_per_seed: float | None = None
    upload: str = ""
