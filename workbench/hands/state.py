"""What hands do to bodies and robots, and the requests that follow."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from workbench.actions.sources import ActionSource
from workbench.hands.commands import ToggleDriving
from workbench.hands.drive_keys import GRIPPER_KEY, bindings, driven_action, gripper
from workbench.live.commands import PlayRun
from workbench.live.effects import Asked, Later, Then
from workbench.live.events import Send, SettingsChanged, VersionLoaded
from workbench.live.messages import EpisodeEnd, MoveBody, PullBody, SetSliderAction
from workbench.live.run import Run
from workbench.page.command import Command, Refused

DOES: frozenset[type[Command]] = frozenset({ToggleDriving})
"""Commands that `apply` handles."""
LET_GO_SECONDS = 0.3
"""Time after the last report of held keys after which they count as released: the page reports three times in it,
unless it has closed or its line is cut."""


@dataclass(frozen=True)
class BodyMoved:
    """A person put a body at a pose."""

    body: str
    env_idx: tuple[int, ...]
    pose: tuple[float, ...]
    """(7,) position and quaternion wxyz in the frame of each env."""


@dataclass(frozen=True)
class BodyPulled:
    """A person pulls a body, or has let go."""

    pull: PullBody


@dataclass(frozen=True)
class Driven:
    """A page reports the driving keys that are held."""

    keys: tuple[str, ...]
    yaw: float
    """See `driven_action`."""


@dataclass(frozen=True)
class DrivingDue:
    """The keys of a report count as released, unless another report has come."""

    number: int


@dataclass(frozen=True)
class Hands:
    """Who drives: a person by keys, or another source of actions. Also the view of this feature."""

    driving: bool = False
    source: ActionSource = "random"
    episode_end: EpisodeEnd = "reset"
    """Source of actions and end of episodes before a person took over, which return at the end."""
    keys: tuple[str, ...] = ()
    """Keys that are held."""
    number: int = 0
    """Reports so far."""
    closes: bool = False
    """Whether the gripper closes."""


HandEvent = BodyMoved | BodyPulled | Driven | DrivingDue
Change = tuple[Hands, list[Any]]


def apply(hands: Hands, event: object, run: Run) -> Change:
    """The next state after an event, and the effects to perform.

    Raises:
        Refused: the body cannot be moved or pulled, or the robot cannot be driven now; nothing has changed.
    """
    match event:
        case Asked(command=ToggleDriving()):
            return _stop(hands) if hands.driving else _start(hands, run)
        case Driven(keys=keys, yaw=yaw) if hands.driving:
            return _drive(replace(hands, number=hands.number + 1), run, keys, yaw)
        case DrivingDue(number=hands.number) if hands.driving and hands.keys:
            return _drive(hands, run, (), 0.0)
        case SettingsChanged(values={"action_source": source}) if hands.driving and source != "sliders":
            return replace(hands, driving=False, keys=()), []
        case VersionLoaded() if hands.driving and (run.task is None or not bindings(run.task.actions)):
            return _stop(hands)
        case BodyMoved() | BodyPulled():
            return hands, _handle(event, run)
    return hands, []


def _start(hands: Hands, run: Run) -> Change:
    """A person takes over from the present source of actions."""
    _require_live(run)
    assert run.task is not None, "there is a live moment"
    if not run.task.actions:
        raise Refused("The task has no robot to drive.")
    if not bindings(run.task.actions):
        raise Refused(
            f"{run.task.control_mode} takes absolute targets, which keys cannot hold. Choose a mode with delta or vel "
            "under Control on the Run tab, such as pd_ee_delta_pose."
        )
    settings = run.settings
    started = Hands(True, settings.action_source, settings.episode_end, number=hands.number)
    # An episode that ends by itself would take the robot out of the hand.
    changed = SettingsChanged({"action_source": "sliders", "episode_end": "continue"})
    hold = Send(SetSliderAction(tuple(range(run.num_envs)), (), ()))
    return started, [Then(changed), hold, Then(Asked(PlayRun()))]


def _stop(hands: Hands) -> Change:
    """Give back to the source of actions from before."""
    back = SettingsChanged({"action_source": hands.source, "episode_end": hands.episode_end})
    return replace(hands, driving=False, keys=()), [Then(back)]


def _drive(hands: Hands, run: Run, keys: tuple[str, ...], yaw: float) -> Change:
    if run.task is None:
        return hands, []
    dimensions, values = driven_action(run.task.actions, keys, yaw)
    closes = hands.closes ^ (GRIPPER_KEY in keys and GRIPPER_KEY not in hands.keys)
    if closes != hands.closes:
        grips = gripper(run.task.actions)
        dimensions += tuple(k for k, _, _ in grips)
        values += tuple(closed if closes else opened for _, closed, opened in grips)
    told: list[Any] = [Send(SetSliderAction((run.env,), dimensions, values))]
    if keys:
        told.append(Later(LET_GO_SECONDS, DrivingDue(hands.number)))
    return replace(hands, keys=keys, closes=closes), told


def _handle(event: BodyMoved | BodyPulled, run: Run) -> list[Any]:
    """The requests to the worker that follow from moving or pulling a body. Raises Refused."""
    match event:
        case BodyMoved(body=body, env_idx=env_idx, pose=pose):
            _require_live(run)
            if run.playing:
                raise Refused("Pause first: a body is moved while the envs stand still.")
            if why := why_not_moved(_kind_of(run, body)):
                raise Refused(why)
            assert run.past is not None, "there is a live moment"
            return [Send(MoveBody(body, env_idx, pose, run.past.history.last))]
        case BodyPulled(pull=PullBody(body="")):
            return [Send(event.pull)]
        case BodyPulled(pull=pull):
            _require_live(run)
            assert run.task is not None, "there is a live moment"
            on_gpu = run.task.backend == "gpu"
            if why := why_not_pulled(_kind_of(run, pull.body), on_gpu):
                raise Refused(why)
            return [Send(pull)]


def why_not_moved(kind: str) -> str:
    """Why a body of this kind cannot be moved; empty if it can."""
    if kind == "static":
        return "A static body cannot be moved: its place is fixed when the scene is built."
    if kind == "link":
        return "A link cannot be moved alone: play, and drag the link to pull it."
    return "" if kind else "The task has no such body."


def why_not_pulled(kind: str, on_gpu: bool) -> str:
    """Why a body of this kind cannot be pulled; empty if it can."""
    if kind in ("static", "kinematic"):
        return f"A {kind} body does not react to forces."
    if kind == "link" and on_gpu:
        return "SAPIEN applies no forces to links in GPU simulation."
    return "" if kind else "The task has no such body."


def _require_live(run: Run) -> None:
    if run.task is None or run.past is None or run.step is None:
        raise Refused("There is nothing to move until the task has loaded.")
    if run.past.pinned is not None:
        raise Refused("This is a past moment. Press End to go live, or Shift+G to continue from here.")


def _kind_of(run: Run, body: str) -> str:
    assert run.task is not None, "`_require_live` was called"
    geometry = run.task.geometry
    return dict(zip(geometry.body_names, geometry.body_kinds, strict=True)).get(body, "")
