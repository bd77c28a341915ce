"""State of what a person moves and drives by hand, and the requests to the worker."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

from workbench.actions.sources import ActionSource
from workbench.envs.robots import Joint, RobotDescription
from workbench.hands import reach as of_reach
from workbench.hands.commands import (
    BeginAgain,
    ChooseMovedEnvs,
    DiscardEpisode,
    DragJoint,
    KeepEpisode,
    SetJoint,
    ToggleDriving,
    ToggleReach,
    UseKeyframe,
    WatchForce,
    WriteQpos,
)
from workbench.hands.drive_keys import GRIPPER_KEY, bindings, driven_action, gripper
from workbench.hands.joints import position_of
from workbench.hands.reach import ArmDragged, ArmsReleased, Reach
from workbench.hands.start_edit import RobotQpos, StartWanted
from workbench.live.commands import PlayRun
from workbench.live.effects import Asked, Later, Then
from workbench.live.events import EnvsReset, PagesCounted, Send, SettingsChanged, VersionLoaded, WorkerDied
from workbench.live.history.moments import Moment
from workbench.live.messages import (
    EpisodeEnd,
    MoveBody,
    MoveJoints,
    PullBody,
    Reached,
    SetSliderAction,
    TaskFailed,
)
from workbench.live.run import Run
from workbench.page.command import Command, Refused
from workbench.record.commands import ToggleSavePast
from workbench.record.saving_state import (
    EpisodesKept,
    EpisodesSaved,
    PastEpisode,
    SaveFailed,
    SaveRequest,
    find_episode,
    request_of,
)
from workbench.task.description import Stepped

DOES: frozenset[type[Command]] = frozenset(
    {
        ToggleDriving,
        ToggleReach,
        BeginAgain,
        DiscardEpisode,
        KeepEpisode,
        ChooseMovedEnvs,
        DragJoint,
        SetJoint,
        UseKeyframe,
        WatchForce,
        WriteQpos,
    }
)
"""Commands that `apply` handles."""
MAX_WATCHED_FORCES = 8
LET_GO_SECONDS = 0.3
"""Held keys count as released when the page has not reported for this long. While it is open and connected,
the page reports three times in this period."""


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
    """A page reports the driving keys and the controls of a gamepad that are held."""

    keys: tuple[str, ...]
    yaw: float
    sticks: tuple[float, ...] = ()
    """See `driven_action`."""


@dataclass(frozen=True)
class DrivingDue:
    """The keys of a report count as released, unless another report has come."""

    number: int


@dataclass(frozen=True)
class DraggedJoint:
    """A joint whose slider is dragged while the envs are paused."""

    robot: str
    """As in `RobotDescription.name`."""
    env_idx: tuple[int, ...]
    joint: int
    """Place in `RobotDescription.joints`."""
    position: float
    """In radians or metres."""


@dataclass(frozen=True)
class KeptRequest:
    """A kept episode that is being saved."""

    what: SaveRequest
    saved: str
    """The note when it is saved."""
    not_saved: str
    """The note if it is not saved."""


@dataclass(frozen=True)
class LeftEpisode:
    """An episode that a person ended and did not keep."""

    env: int
    was_reset: bool = False
    """Whether the env's reset, which ended the episode, has come."""


@dataclass(frozen=True)
class Hands:
    """What a person drives and drags by hand, and the last kept episode. Also the view of this feature."""

    driving: bool = False
    source: ActionSource = "random"
    episode_end: EpisodeEnd = "reset"
    """`source` and `episode_end` are the settings from before a person took over; they return when driving
    stops."""
    keys: tuple[str, ...] = ()
    """Keys that are held."""
    sticks: tuple[float, ...] = ()
    """Deflections of the gamepad; empty if all are zero."""
    env: int = 0
    """Env in which the keys and sticks are held."""
    number: int = 0
    """Number of reports so far."""
    closes: bool = False
    """Whether the gripper closes."""
    reach: Reach = Reach()
    """Arms that follow their handles."""
    all_envs: bool = False
    """Whether a move applies to all envs; if False, to the selected one."""
    dragged: DraggedJoint | None = None
    """The joint that the page shows at its slider's position, from the drag until the env has followed."""
    next_seed: int = 0
    """Minimum seed of the next episode of the set."""
    kept: Moment | None = None
    """Last moment of the episode that was kept last. After the episode was continued, its last moment is another,
    so it can be kept again."""
    note: str = ""
    """What became of the last episode of the set."""
    saves: KeptRequest | None = None
    """The kept episode that `note` is about, until it is saved."""
    left: LeftEpisode | None = None
    """The episode that `note` is about, while `UndoReset` goes back to it."""


HandEvent = BodyMoved | BodyPulled | Driven | DrivingDue | ArmDragged | ArmsReleased | Reached
Change = tuple[Hands, list[Any]]


def apply(
    hands: Hands,
    event: object,
    run: Run,
    recorded: tuple[int, ...] = (),
    unsaved: tuple[SaveRequest, ...] = (),
) -> Change:
    """The next state after an event, and the effects to perform.

    Args:
        recorded: envs of the running recording.
        unsaved: what is being saved from the history, after the event.

    Raises:
        Refused: the body or the joints cannot be moved, or the robot cannot be driven now; nothing has changed.
    """
    hands = _with_present_note(hands, event, unsaved)
    match event:
        case Asked(command=ToggleDriving()):
            return _stop(hands) if hands.driving else _start(hands, run)
        case Asked(command=ToggleReach()):
            reach, requests = of_reach.toggle(hands.reach, run)
            return replace(hands, reach=reach), requests
        case Asked(command=ChooseMovedEnvs(all_envs=all_envs)):
            return replace(hands, all_envs=all_envs), []
        case Asked(command=WatchForce() as command):
            return hands, [_watch_force(run, command)]
        case Asked(command=DragJoint(robot=robot, joint=joint, to=to)):
            return _set_joint(hands, run, robot, joint, to, ends=False)
        case Asked(command=SetJoint(robot=robot, joint=joint, to=to)):
            return _set_joint(hands, run, robot, joint, to, ends=True)
        case Asked(command=UseKeyframe(robot=robot, name=name)):
            return hands, [_use_keyframe(hands, run, robot, name)]
        case Asked(command=WriteQpos(robot=robot)):
            return hands, [Then(StartWanted(_qpos_now(run, robot)))]
        case Stepped() | TaskFailed() | VersionLoaded() | PagesCounted() | WorkerDied() if hands.dragged:
            return apply(replace(hands, dragged=None), event, run, recorded, unsaved)
        case Asked(command=BeginAgain() | DiscardEpisode() | KeepEpisode() as command):
            return _end_episode(hands, run, command, recorded)
        case Driven(keys=keys, yaw=yaw, sticks=sticks) if hands.driving:
            return _drive(replace(hands, number=hands.number + 1), run, keys, yaw, sticks)
        case DrivingDue(number=hands.number) if hands.driving and (hands.keys or hands.sticks):
            return _drive(hands, run, (), 0.0)
        case SettingsChanged(values={"action_source": source}) if hands.driving and source != "sliders":
            return _let_go(hands)
        case VersionLoaded():
            hands = replace(hands, reach=of_reach.loaded(hands.reach, run))
            if hands.driving and (run.task is None or not (bindings(run.task.actions) or hands.reach.shown)):
                return _stop(hands)
        case ArmDragged():
            return _lead(hands, event, run)
        case ArmsReleased():
            return _released(hands)
        case Reached():
            return replace(hands, reach=of_reach.answered(hands.reach, event)), []
        case Stepped() if hands.reach.targets or hands.reach.reached:
            return replace(hands, reach=of_reach.stepped(hands.reach, event)), []
        case BodyMoved() | BodyPulled():
            return hands, _handle(event, run)
    return hands, []


def _with_present_note(hands: Hands, event: object, unsaved: tuple[SaveRequest, ...]) -> Hands:
    """`hands` with a note that is still true after the event."""
    match event:
        case EpisodesSaved() | SaveFailed() | Asked(command=ToggleSavePast()) if hands.saves is not None:
            if hands.saves.what not in unsaved:
                saved = isinstance(event, EpisodesSaved)
                note = hands.saves.saved if saved else hands.saves.not_saved
                # Otherwise an episode that was not saved could not be kept again.
                return _noting(replace(hands, kept=hands.kept if saved else None), note)
        case Stepped() if hands.left is not None and event.reset_mask[hands.left.env]:
            if not hands.left.was_reset:
                return replace(hands, left=replace(hands.left, was_reset=True))
            return _noting(hands, "")  # the env went back, or was reset again
        case VersionLoaded() if hands.left is not None:
            return _noting(hands, "")
    return hands


def _noting(
    hands: Hands, note: str, saves: KeptRequest | None = None, left: LeftEpisode | None = None
) -> Hands:
    return replace(hands, note=note, saves=saves, left=left)


def _start(hands: Hands, run: Run) -> Change:
    """A person takes over from the present source of actions."""
    _require_live(run)
    assert run.task is not None, "there is a live moment"
    if not run.task.actions:
        raise Refused("The task has no robot to drive.")
    if not bindings(run.task.actions):
        raise Refused(
            f"{run.task.control_mode} takes absolute targets, but keys give relative motions. Choose a mode "
            "with delta or vel under Control on the Run tab, such as pd_ee_delta_pose."
        )
    return _take_over(hands, run)


def _take_over(hands: Hands, run: Run) -> Change:
    """The sliders become the source of actions, and hold the robots still until a person moves one."""
    settings = run.settings
    started = replace(
        hands,
        driving=True,
        source=settings.action_source,
        episode_end=settings.episode_end,
        keys=(),
        sticks=(),
        closes=False,
    )
    started = _noting(started, "")
    # An automatic reset would interrupt the person.
    changed = SettingsChanged({"action_source": "sliders", "episode_end": "continue"})
    hold = Send(SetSliderAction(tuple(range(run.num_envs)), (), ()))
    return started, [Then(changed), hold, Then(Asked(PlayRun()))]


def _stop(hands: Hands) -> Change:
    """Stop driving, and restore the source of actions from before."""
    back = SettingsChanged({"action_source": hands.source, "episode_end": hands.episode_end})
    stopped, requests = _let_go(hands)
    return stopped, [*requests, Then(back)]


def _let_go(hands: Hands) -> Change:
    """The person drives no longer."""
    hands = hands if hands.left is None else _noting(hands, "")
    return _released(replace(hands, driving=False, keys=(), sticks=()))


def _released(hands: Hands) -> Change:
    """Let go of all arms."""
    return replace(hands, reach=of_reach.without(hands.reach)), of_reach.let_go(hands.reach)


def _lead(hands: Hands, event: ArmDragged, run: Run) -> Change:
    """An arm follows its handles; while the envs play, a person takes over from the source of actions."""
    _require_live(run)
    _require_pose(event.pose)
    effects: list[Any] = []
    if run.playing and not hands.driving:
        hands, effects = _take_over(hands, run)
    reach, requests = of_reach.lead(hands.reach, event, run)
    return replace(hands, reach=reach), [*effects, *requests]


def _drive(
    hands: Hands, run: Run, keys: tuple[str, ...], yaw: float, sticks: tuple[float, ...] = ()
) -> Change:
    if run.task is None:
        return hands, []
    dimensions, values = driven_action(run.task.actions, keys, yaw, sticks)
    closes = hands.closes ^ (GRIPPER_KEY in keys and GRIPPER_KEY not in hands.keys)
    if closes != hands.closes:
        grips = gripper(run.task.actions)
        dimensions += tuple(k for k, _, _ in grips)
        values += tuple(closed if closes else opened for _, closed, opened in grips)
    effects: list[Any] = [Send(SetSliderAction((run.env,), dimensions, values))] if dimensions else []
    if (hands.keys or hands.sticks) and hands.env != run.env:  # another env was selected while they were held
        still = driven_action(run.task.actions, (), yaw)
        effects.append(Send(SetSliderAction((hands.env,), *still)))
    reach = hands.reach
    if any(values[: len(bindings(run.task.actions))]):  # the keys override the handles
        effects += of_reach.let_go(reach, run.env)
        reach = of_reach.without(reach, run.env)
    if keys or sticks:
        effects.append(Later(LET_GO_SECONDS, DrivingDue(hands.number)))
    return replace(hands, keys=keys, sticks=sticks, env=run.env, closes=closes, reach=reach), effects


def _end_episode(
    hands: Hands, run: Run, command: BeginAgain | DiscardEpisode | KeepEpisode, recorded: tuple[int, ...]
) -> Change:
    """End the driven episode, and begin another. An episode that is not kept stays in the history only."""
    if not hands.driving:
        raise Refused("Drive first (K): episodes are kept and discarded while you drive.")
    _require_live(run)
    assert run.past is not None, "there is a live moment"
    env, history = run.env, run.past.history
    next_seed = max(hands.next_seed, run.seed + run.num_envs)
    episode = find_episode(history, env, None, limited=False)
    has_step = len(history.episode(env, history.last, 2)) > 1
    if isinstance(command, BeginAgain):
        hands = _noting(hands, "")
        if isinstance(episode, PastEpisode) and has_step and env not in recorded:
            note = f"{_named(episode)} was not kept. Shift+U goes back to it."
            hands = _noting(hands, note, left=LeftEpisode(env))
        return _begin_episode(hands, env, next_seed)
    if env in recorded:
        raise Refused(
            "Each episode of this env is recorded now. To keep or discard single episodes, stop the recording (Shift+C)."
        )
    if isinstance(episode, str):
        raise Refused(f"There is no episode to keep or discard: {episode}.")
    if isinstance(command, KeepEpisode):
        hands, effects = _keep(hands, run, episode)
        if not has_step:  # the next episode has begun already
            return hands, effects
        hands, more = _begin_episode(hands, env, next_seed)
        return hands, [*effects, *more]
    if not has_step:
        raise Refused("There is no episode to discard: this one has no step yet.")
    note = f"{_named(episode)} was discarded. Shift+U brings it back."
    hands = _noting(hands, note, left=LeftEpisode(env))
    return _begin_episode(hands, env, next_seed if episode.seed < 0 else episode.seed)


def _keep(hands: Hands, run: Run, episode: PastEpisode) -> Change:
    """Save this episode, which must be the newest one of the selected env."""
    assert run.past is not None, "an episode was found"
    last, env = episode.moments[-1]
    if last is hands.kept:
        raise Refused("This episode is kept already.")
    what = request_of(run, (run.env,), kept=True)
    if isinstance(what, str):
        raise Refused(f"{what}.")
    name, about = _named(episode), ""
    if run.past.history.by_hand(last, env):
        about = " A body was moved or pulled by hand in it, so its actions alone do not repeat it."
    saved = f"{name} is kept, {'with' if episode.succeeded else 'without'} success.{about}"
    saves = KeptRequest(what, saved, f"{name} was not saved.")
    hands = _noting(replace(hands, kept=last), f"{name} is being saved.{about}", saves)
    return hands, [Then(EpisodesKept(what))]


def _begin_episode(hands: Hands, env: int, seed: int) -> Change:
    begun = replace(hands, closes=False, next_seed=max(hands.next_seed, seed + 1))
    return begun, [Send(SetSliderAction((env,), (), ())), Then(EnvsReset((env,), seed))]


def _named(episode: PastEpisode) -> str:
    of = "" if episode.seed < 0 else f" of seed {episode.seed}"
    return f"The episode{of} ({episode.steps} step{'' if episode.steps == 1 else 's'})"


def _handle(event: BodyMoved | BodyPulled, run: Run) -> list[Any]:
    """The requests to the worker that follow from moving or pulling a body. Raises Refused."""
    match event:
        case BodyMoved(body=body, env_idx=env_idx, pose=pose):
            _require_live(run)
            if run.playing:
                raise Refused("Pause first: bodies can be moved only while the envs are paused.")
            if why := why_not_moved(_kind_of(run, body)):
                raise Refused(why)
            _require_pose(pose)
            return [Send(MoveBody(body, env_idx, pose, _newest(run)))]
        case BodyPulled(pull=PullBody(body="")):
            return [Send(event.pull)]
        case BodyPulled(pull=pull):
            _require_live(run)
            assert run.task is not None, "there is a live moment"
            on_gpu = run.task.backend == "gpu"
            if why := why_not_pulled(_kind_of(run, pull.body), on_gpu):
                raise Refused(why)
            return [Send(pull)]


def _set_joint(hands: Hands, run: Run, name: str, number: int, to: float, ends: bool) -> Change:
    """Handle a drag of a joint's slider, or its end if `ends`; `to` is in the unit of the page."""
    robot = _robot_of(run, name)
    if number >= len(robot.joints):
        raise Refused(f"{name} has only {len(robot.joints)} joints.")
    joint, envs = robot.joints[number], envs_of_move(hands, run.env, run.num_envs)
    position = position_of(joint, to)
    if run.playing:
        driven = _drive_joint(run, joint, envs, position)
        for env in envs:  # the slider overrides the handles
            driven += of_reach.let_go(hands.reach, env)
            hands = replace(hands, reach=of_reach.without(hands.reach, env))
        return hands, driven
    hands = replace(hands, dragged=DraggedJoint(name, envs, number, position))
    if not ends:
        return hands, []
    how = f"{joint.name} of {name} was set by hand."
    return hands, [Send(MoveJoints(name, envs, (number,), (position,), None, how, _newest(run)))]


def _drive_joint(run: Run, joint: Joint, envs: tuple[int, ...], position: float) -> list[Any]:
    """Give a joint a position target through the action; takes over from another source of actions."""
    assert run.task is not None, "`_robot_of` was called"
    if joint.target is None:
        raise Refused(why_not_driven(run.task.control_mode, joint.name))
    dimension = run.task.actions[joint.target.dimension]
    value = joint.target.scale * (position - joint.target.zero)
    value = min(max(value, dimension.low), dimension.high)
    request = Send(SetSliderAction(envs, (joint.target.dimension,), (value,)))
    takes_over = Then(SettingsChanged({"action_source": "sliders"}))
    return [request] if run.settings.action_source == "sliders" else [takes_over, request]


def _watch_force(run: Run, command: WatchForce) -> Then:
    bodies = () if run.task is None else run.task.geometry.body_names
    pair = min(command.body, command.other), max(command.body, command.other)
    kept = tuple(one for one in run.settings.watched_forces if one != pair)
    if not command.on:
        return Then(SettingsChanged({"watched_forces": kept}))
    if missing := [name for name in pair if name not in bodies]:
        raise Refused(f"The scene has no body {missing[0]}.")
    if pair[0] == pair[1]:
        raise Refused("Choose two bodies: a body has no contact force with itself.")
    if len(kept) >= MAX_WATCHED_FORCES:
        raise Refused(f"{MAX_WATCHED_FORCES} forces are watched already: stop watching one of them.")
    return Then(SettingsChanged({"watched_forces": (*kept, pair)}))


def _use_keyframe(hands: Hands, run: Run, name: str, keyframe: str) -> Send:
    robot = _robot_of(run, name)
    found = next((one for one in robot.keyframes if one.name == keyframe), None)
    if found is None:
        raise Refused(f"{name} has no keyframe {keyframe}.")
    if run.playing:
        raise Refused("Pause first: a keyframe can be set only while the envs are paused.")
    every, how = tuple(range(len(robot.joints))), f"{name} was put into its keyframe {keyframe} by hand."
    return Send(
        MoveJoints(
            name, envs_of_move(hands, run.env, run.num_envs), every, found.qpos, found.root, how, _newest(run)
        )
    )


def _qpos_now(run: Run, name: str) -> RobotQpos:
    robot = _robot_of(run, name)
    assert run.step is not None, "there is a live moment"
    if run.step.qpos is None:
        raise Refused("The task has no joints.")
    columns = [joint.column for joint in robot.joints]
    return RobotQpos(name, tuple(map(float, run.step.qpos[run.env, columns])))


def why_not_driven(control_mode: str | None, joint: str) -> str:
    """Why a joint cannot be driven while the envs play."""
    return f"{control_mode or 'The control mode'} takes no position of {joint}: pause to set it."


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


def _require_pose(pose: tuple[float, ...]) -> None:
    """A page may report any numbers, and numbers that are not finite would spread to the whole simulation."""
    if not all(map(math.isfinite, pose)) or not any(pose[3:]):
        raise Refused("This is not a pose: it needs finite numbers, and a quaternion that is not zero.")


def envs_of_move(hands: Hands, env: int, num_envs: int) -> tuple[int, ...]:
    """The envs that a move in this env applies to."""
    return tuple(range(num_envs)) if hands.all_envs else (env,)


def _newest(run: Run) -> int:
    """The serial of the newest moment."""
    assert run.past is not None, "`_require_live` was called"
    return run.past.history.last


def _robot_of(run: Run, name: str) -> RobotDescription:
    """Raises `Refused` if there is no such robot, or nothing can be moved now."""
    _require_live(run)
    assert run.task is not None, "there is a live moment"
    robot = next((one for one in run.task.robots if one.name == name), None)
    if robot is None:
        raise Refused("The task has no such robot.")
    return robot


def _kind_of(run: Run, body: str) -> str:
    assert run.task is not None, "`_require_live` was called"
    geometry = run.task.geometry
    return dict(zip(geometry.body_names, geometry.body_kinds, strict=True)).get(body, "")
