"""Requests to the worker and events from the worker: plain dataclasses with NumPy arrays."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from workbench.actions.sources import ActionSource
from workbench.envs.camera_data import CameraInfo, CameraKey, CameraKind, CameraSettings, Picture
from workbench.envs.gpu_rules import Finding
from workbench.envs.inspection import Inspection, Section
from workbench.envs.recorded_run import RecordedRun
from workbench.envs.step_result import BodyPair, StepResult
from workbench.machine.processes.wire import Call, Question
from workbench.planning.options import PlanOptions
from workbench.task.description import ShownPictures, Stepped, TaskDescription, TaskOptions
from workbench.task.problem import Problem
from workbench.task.reference import TaskName

LoadLevel = Literal["auto", "patched", "cameras", "rebuilt"]
"""How to load a new version; ``auto`` takes the smallest level that is safe. See `workbench.task.reload_level`."""
ReloadLevel = Literal["same", "patched", "cameras", "rebuilt", "restarted"]
SCENE_KEPT: frozenset[ReloadLevel] = frozenset({"same", "patched", "cameras"})
"""Levels that keep the env, its episodes and its history."""
EpisodeEnd = Literal["reset", "continue", "pause"]
"""What happens when the episode of an env ends: the env is reset, the env continues, or all envs pause."""


# --- requests: server to worker, handled in order between control steps ---------------------------


@dataclass(frozen=True)
class Load(Question["Loaded"]):
    """Import and build the task. It replaces the running version only if everything succeeds."""

    task: TaskName
    """The task as the user named it (a path, ``path:ClassName`` or a registered env id), or a task named by a
    recording."""
    options: TaskOptions
    source: dict[str, str] | None = None
    """Texts by path to use in place of the files on disk, to restore the last good version."""
    level: LoadLevel = "auto"
    """How to replace a running version of the same task."""
    snapshot: bytes | None = None
    """Pickled `envs.snapshots.snapshot.Snapshot` to restore after a build. Each value is restored by name, if
    its shape matches."""
    any_task: bool = False
    """If no class is named and the first class fails, open another task of the file."""
    number: int = 0
    """Serial of this load of the file on disk, counting up; 0 for a load that restores a version."""
    because: str = ""
    """Why a new process loads the task, for the `ReloadReport`."""
    same_scene: bool = False
    """Whether a new process loads the version, and the version's scene-building code is unchanged."""
    fresh: bool = False
    """Whether a build begins new episodes, instead of putting the bodies back to where they were."""


@dataclass(frozen=True)
class Play:
    """Start or pause stepping."""

    playing: bool
    number: int = 0
    """Number of the user's request, counting up; 0 for a request that the workbench itself makes."""


@dataclass(frozen=True)
class SingleStep:
    """Pause, and make one control step."""


@dataclass(frozen=True)
class Reset(Question[StepResult]):
    """Reset envs."""

    env_idx: tuple[int, ...] | None = None
    """The envs to reset; None for all."""
    seed: int | None = None
    """Seed of the reset; None continues the task's own random numbers."""


class CameraRequest(NamedTuple):
    """A picture to draw, in the form of `pictures.render.Request`."""

    name: str
    kind: CameraKind
    modalities: tuple[str, ...] = ("rgb",)

    @property
    def key(self) -> CameraKey:
        return self.kind, self.name


@dataclass(frozen=True)
class Settings:
    """How the batch runs and which cameras are watched. Always sent whole; the worker applies what changed."""

    speed: float = 1.0
    """Simulated seconds per second; ``inf`` runs as fast as possible."""
    episode_end: EpisodeEnd = "reset"
    action_source: ActionSource = "random"
    policy: str | None = None
    """``module:function`` or ``file.py:function`` when `action_source` is ``policy``; None if not named yet."""
    policy_folder: str | None = None
    """Folder in which the policy's file is searched, after the current folder."""
    plan: PlanOptions = PlanOptions()
    """How actions are planned while `action_source` is ``solve``."""
    solve_all: bool = False
    """Plan for every env in turn. If False, plan for the selected env only; the others hold still."""
    traced: str = ""
    """Name of the body whose path in the rollouts is shown; empty for the robot's tool."""
    selected_env: int = 0
    cameras: tuple[CameraRequest, ...] = ()
    """Cameras to draw in the selected env; none while no page is open."""
    pictures: ShownPictures = "auto"
    """Quality of the pictures of these cameras."""
    watched_forces: tuple[BodyPair, ...] = ()
    """Pairs of bodies whose contact forces each step has from the next step on."""


@dataclass(frozen=True)
class SetSliderAction:
    """Set dimensions of the action of some envs, while `Settings.action_source` is ``sliders``; other
    dimensions keep their value."""

    env_idx: tuple[int, ...]
    dimensions: tuple[int, ...]
    """Dimensions to set; if empty, the envs hold still."""
    values: tuple[float, ...]
    """One value for each dimension, the same for each env."""


@dataclass(frozen=True)
class ReadPolicyAgain:
    """Reload the policy, because its file was saved."""

    play: bool
    """Start playing if the import succeeds."""


@dataclass(frozen=True)
class FollowPlan:
    """The answer to a `PlanWanted`: the actions to take from the moment of the `PlanWanted` on. The worker
    drops the answer if the envs have moved since that moment, or after a `PlanDropped`."""

    number: int
    """Number of the `PlanWanted` that this answers."""
    env_idx: tuple[int, ...]
    actions: NDArray[np.float32]
    """(S, n, A) actions for S control steps of these n envs; the other envs hold still."""


@dataclass(frozen=True)
class PlaceCamera(Question["Placed"]):
    """Change a camera's pose, lens, size or shader in all envs; followed by a `Placed`.

    If several requests for one camera wait, only the last is carried out.
    """

    key: CameraKey
    settings: CameraSettings | None
    """The new settings; None restores the task's own."""


@dataclass(frozen=True)
class SetCapture:
    """For a recording: send each step with the state columns of the batch, and with the pictures of all
    cameras in these envs."""

    env_idx: tuple[int, ...]
    """Envs to capture; empty turns capturing off."""
    from_reset: bool = False
    """Begin in each env at its next reset, so that no unused picture is drawn."""


@dataclass(frozen=True)
class ReplayPath:
    """How an env reached a moment: the actions since an exact point (see `History.replay_path`)."""

    start: int
    """The server's number of the moment at the exact point; `Restore.starts` has its snapshot."""
    source: int
    """The env's number at the exact point."""
    actions: NDArray[np.float32]
    """(T, A) actions since the exact point."""


@dataclass(frozen=True)
class Restore:
    """Put envs back to a moment of the history; followed by a `Stepped` that has `Stepped.restored`."""

    snapshot: bytes
    """A pickled `envs.snapshots.snapshot.Snapshot` of the whole batch."""
    env_idx: tuple[int, ...]
    """The envs to put back."""
    source: tuple[int, ...]
    """For each env of `env_idx`: the env of the snapshot whose state it gets."""
    origin: int
    """The server's number of that moment; returned unchanged."""
    undoes: int | None = None
    """The server's number of the jump that this undoes, if any; returned unchanged."""
    ways: Mapping[int, ReplayPath] = field(default_factory=dict)
    """Replay paths by env, for those of `env_idx` that can be replayed up to the moment."""
    starts: Mapping[int, bytes] = field(default_factory=dict)
    """Pickled snapshots of the whole batch at the beginnings of `ways`, by number of the moment."""


@dataclass(frozen=True)
class EnterRecording:
    """Put envs into a state of a recorded episode; followed by a `Stepped` that has `Stepped.restored`."""

    run: RecordedRun
    """The recorded run, up to the state."""
    env_idx: tuple[int, ...]
    """The envs to set, all to the same state."""
    source_file: str | None = None
    source: Mapping[str, str] = field(default_factory=dict)
    """The recorded source, to report what has changed since the recording; if empty, nothing is reported."""
    number: int = 0
    """The session's number of this request; returned unchanged."""


@dataclass(frozen=True)
class MoveBody:
    """Put a body at a pose, at rest; followed by a `Stepped` that has `Stepped.restored`. Dropped if the task has no
    such body."""

    body: str
    """Name of a dynamic or kinematic body."""
    env_idx: tuple[int, ...]
    pose: tuple[float, ...]
    """(7,) position and quaternion wxyz in the frame of each env."""
    origin: int
    """The server's number of the newest moment; returned unchanged."""


@dataclass(frozen=True)
class MoveJoints:
    """Put joints of a robot at positions, at rest; followed by a `Stepped` that has `Stepped.restored`. Drive targets and
    controllers are set to the new positions. Dropped if the task has no such robot or joint."""

    robot: str
    """As in `RobotDescription.name`."""
    env_idx: tuple[int, ...]
    joints: tuple[int, ...]
    """Places in `Robot.joints`; the other joints keep their positions."""
    positions: tuple[float, ...]
    """One for each of `joints`, in radians or metres."""
    root: tuple[float, ...] | None
    """(7,) position and quaternion wxyz of the root in the frame of each env; None leaves the root where it is."""
    how: str
    """What the person did, as a sentence."""
    origin: int
    """The server's number of the newest moment; returned unchanged."""


@dataclass(frozen=True)
class PullBody:
    """Pull a body with a spring in every control step until the next `PullBody`; without a body, let go."""

    body: str = ""
    env: int = 0
    grabbed: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """The spring's end at the body, in the body's frame, in metres."""
    target: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """The spring's other end, in the env's frame, in metres."""


@dataclass(frozen=True)
class ReachPose:
    """Bring an arm's end effector to a pose by inverse kinematics; followed by a `Reached`. Dropped if the env has no such
    arm."""

    arm: str = ""
    """Body name of the end effector; empty to let go of all arms of the env."""
    env: int = 0
    pose: tuple[float, ...] = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
    """(7,) position and quaternion wxyz in the env's frame."""
    how: Literal["follow", "try", "set"] = "follow"
    """``follow``: while sliders are the source of actions, each action leads the arm there. ``set``: put the
    joints there, at rest; followed by a `Stepped` that has `Stepped.restored`. ``try``: only answer; only the
    newest request waits."""
    origin: int = 0
    """The server's number of the newest moment; returned unchanged."""


@dataclass(frozen=True)
class DrawPast:
    """Draw one env at a past moment without touching its simulation; followed by `PastPictures`."""

    poses: NDArray[np.float32]
    """(B, 7) poses of that env's bodies, as in `StepResult.poses`."""
    env: int
    cameras: tuple[CameraRequest, ...]
    origin: int
    """The server's number of that moment; returned unchanged."""


@dataclass(frozen=True)
class WarmUp(Question[None]):
    """Do the slow parts of a first load and a first picture in advance; see `warm_up`."""

    options: TaskOptions


@dataclass(frozen=True)
class ListenForDebugger:
    """Let debugpy listen on this machine; the log shows the result."""

    port: int
    wait: bool = False
    """Wait until a debugger has attached."""


@dataclass(frozen=True)
class Inspect:
    """Read one env's state once, between two control steps; followed by an `Inspection`."""

    env: int
    sections: tuple[Section, ...]
    body: str = ""
    """Name of a body to read as well; empty for none."""


@dataclass(frozen=True)
class Cancel:
    """Cancel the previous question, because its answer is no longer needed. Wakes the worker: long work stops as soon as a
    request arrives."""


@dataclass(frozen=True)
class Quit:
    """End the worker."""


Request = (
    Load
    | Play
    | SingleStep
    | Reset
    | Settings
    | SetSliderAction
    | ReadPolicyAgain
    | FollowPlan
    | PlaceCamera
    | SetCapture
    | Restore
    | EnterRecording
    | MoveBody
    | MoveJoints
    | PullBody
    | ReachPose
    | DrawPast
    | ListenForDebugger
    | Inspect
    | Call
    | Cancel
    | Quit
)


def without_steps(requests: Iterable[Request]) -> Iterator[Request]:
    """The waiting requests that remain after an interrupt. A `Play` that starts playing is dropped; a
    `SingleStep`, which pauses and then steps, becomes a pause."""
    for request in requests:
        if isinstance(request, SingleStep):
            yield Play(False)
        elif not (isinstance(request, Play) and request.playing):
            yield request


# --- events: worker to server --------------------------------------------------------------------


def hands_over(event: object) -> bool:
    """Whether the worker ends with this event, so that another worker continues."""
    return isinstance(event, NewProcessNeeded) or (isinstance(event, TaskFailed) and event.spoiled != "")


@dataclass(frozen=True)
class Loading:
    """Current phase of a load, for the status line."""

    activity: str
    number: int = 0
    """Number of the `Load`."""


@dataclass(frozen=True)
class NewProcessNeeded:
    """The worker's answer to a `Load` that needs another process: the running version left something in this
    process that no reload undoes. The worker ends; the next worker loads the file and restores the newest
    moment."""

    reason: str
    same_scene: bool
    """Whether all changed code, if any, runs only at resets and steps."""


@dataclass(frozen=True)
class ReloadReport:
    """How a version replaced the previous one."""

    level: ReloadLevel
    reason: str
    """Reason of the level, for example ``only compute_dense_reward changed``."""
    carried: tuple[str, ...] = ()
    """After a build: names of actors, articulations and attributes that kept their state."""
    not_carried: dict[str, str] = field(default_factory=dict)
    """Names of things that did not keep their state, each with the reason."""
    same_scene: bool = False
    """Whether the scene-building code is unchanged, see `Load.same_scene`."""


@dataclass(frozen=True)
class Loaded:
    """A load succeeded."""

    task: TaskDescription
    first: StepResult
    milliseconds: dict[str, float]
    """Time of each part of the load: import, build, rehearse, reset, geometry."""
    reload: ReloadReport | None = None
    """How the version replaced the previous one; None for the first version of a task. At the levels
    ``same``, ``patched`` and ``cameras``, the scene, the episodes and the poses in `first` are unchanged, and
    `task` lacks the shapes of the geometry, because they are large."""
    options: TaskOptions | None = None
    """Options of the `Load`."""


@dataclass(frozen=True)
class TaskFailed:
    """The author's code raised, in a load or later."""

    problem: Problem
    kept: bool
    """Whether the previous version still runs."""
    classes: tuple[str, ...] = ()
    """Tasks of the file, beginning with the tried one; empty if the file has only one task, or no task was
    tried."""
    options: TaskOptions | None = None
    """Options of the `Load` that failed; None if the problem came later."""
    at_run: bool = False
    """Whether the running version or its policy failed, not a load."""
    spoiled: str = ""
    """What the failed code has left, or may have left, in this process; empty if the worker continues. If not
    empty, the worker ends, and the next worker restores the version that ran."""


@dataclass(frozen=True)
class PlanWanted:
    """The worker waits for actions; answered by a `FollowPlan`, or not at all if there is no plan."""

    number: int
    """`Stepped.number` of the moment to plan from."""
    env_idx: tuple[int, ...]
    """The envs to plan for."""
    snapshot: bytes = b""
    """A pickled `envs.snapshots.snapshot.Snapshot` of these envs at that moment."""
    bodies: tuple[dict[str, bytes], ...] = ()
    """Bodies of each of these envs, from `planning.rollouts.bodies_of`."""
    why_not: str = ""
    """Why there is no snapshot; empty if there is one."""


@dataclass(frozen=True)
class PlanDropped:
    """The worker no longer waits for a plan: playing started or stopped, a version was loaded, or the source
    of actions or the envs to plan for changed."""


@dataclass(frozen=True)
class Pictures:
    """The newest pictures of the watched cameras of one kind."""

    pictures: tuple[Picture, ...]
    milliseconds: float | None
    """Render time; None if steps were made during the rendering, since they took part of the time."""
    number: int
    """`Stepped.number` of the moment that the pictures show."""


@dataclass(frozen=True)
class CameraFailed:
    """A camera cannot be drawn. It is left out until other cameras are watched or another version is loaded."""

    key: CameraKey
    why: str


@dataclass(frozen=True)
class Placed:
    """The result of `PlaceCamera`. Later pictures of the camera are taken with the new settings."""

    key: CameraKey
    settings: CameraSettings | None
    """Settings of the request."""
    info: CameraInfo | None
    """The camera after the change; `CameraInfo.settings` still has the values of the task's config."""
    reshaped: bool = False
    """Whether the size or modalities of the camera's pictures changed."""
    why_not: str = ""
    """Why the camera was not placed; nothing has changed then."""


@dataclass(frozen=True)
class PastPictures:
    """The result of `DrawPast`."""

    origin: int
    pictures: tuple[Picture, ...]


@dataclass(frozen=True)
class Progress:
    """Progress of a `wire.Call`."""

    number: int
    done: int
    total: int
    part: bytes = b""
    """New part of the answer since the last progress message, packed; see `wire.Question.part`."""


@dataclass(frozen=True)
class Answer:
    """The end of a `wire.Call`."""

    number: int
    value: bytes = b""
    """The answer, packed: only the caller knows its type."""
    why: str = ""
    """Why there is no answer, for the page; empty if there is one."""
    problem: Problem | None = None
    """Problem of the author's code, if this is why there is no answer."""


class CannotAnswer(Exception):
    """The worker has no answer; the text is a sentence for the page."""


@dataclass(frozen=True)
class Status:
    """Whether and how fast the batch runs."""

    playing: bool
    """Whether the batch plays, after the last `Play` that the worker has handled."""
    steps_per_second: float
    """Control steps of the whole batch per second of wall time."""
    real_time_factor: float
    """Simulated seconds per wall second; if it is below the chosen speed, the machine is too slow."""
    activity: str = ""
    """Long work that delays requests, if any."""
    recorded_share: float = 0.0
    watched_share: float = 0.0
    """Shares (0 to 1) of the playing time spent on recording every step, and on pictures for the page."""
    handled: int = 0
    """Largest `Play.number` that the worker has handled."""


@dataclass(frozen=True)
class SliderAction:
    """The next action of the sliders, while they are the source of actions; sent whenever it may have changed."""

    action: NDArray[np.float32]
    """(N, A) the action."""


@dataclass(frozen=True, eq=False)
class Reached:
    """How near the joints of an arm can bring its end effector to the pose of a `ReachPose`."""

    env: int
    arm: str
    how: Literal["follow", "try", "set"]
    """As in the request."""
    metres: float
    degrees: float
    """Position and rotation errors that remain."""
    why: str
    """Why the pose is out of reach, as text; empty if it is within."""
    links: tuple[str, ...] = ()
    """Body names of the robot's links; empty unless `how` is ``try``."""
    poses: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 7), np.float32))
    """(L, 7) poses of these links at the joint positions that were found, in the env's frame."""


@dataclass(frozen=True)
class RulesBroken:
    """Broken rules that do not stop the running version; sent when the findings change."""

    rows: tuple[Finding, ...]
    more: int = 0
    """Number of findings beyond the limit of rows."""
    new: tuple[Finding, ...] = ()
    """Rows that the previous event did not have."""


Event = (
    Loading
    | NewProcessNeeded
    | Loaded
    | TaskFailed
    | Stepped
    | PlanWanted
    | PlanDropped
    | Pictures
    | CameraFailed
    | Placed
    | PastPictures
    | Inspection
    | Answer
    | Progress
    | SliderAction
    | Reached
    | Status
    | RulesBroken
)
