"""What a person asks of the run, and how that changes it."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec

from workbench.authoring.loading.reference import (
    reference_to_class,
)
from workbench.commands.cameras import ChoosePictures
from workbench.commands.command import Command, Refused
from workbench.commands.envs import NextEnv, PreviousEnv, SelectEnv
from workbench.commands.run import (
    ChooseActions,
    ChooseClass,
    ChooseEpisodeEnd,
    Interrupt,
    PauseRun,
    PlayRun,
    RebuildScene,
    ReloadCameras,
    ReloadCode,
    ReloadFile,
    ResetAll,
    ResetSelected,
    RestartWorker,
    SetPolicy,
    SetSeed,
    SetSpeed,
    Step,
    TogglePlay,
    UseControlMode,
)
from workbench.commands.solve import (
    ChooseMethod,
    ChoosePlannedEnvs,
    FollowBody,
    SetHorizon,
    SetNoise,
    SetPlanEvery,
    SetRollouts,
    SetTemperature,
)
from workbench.commands.timeline import (
    ContinueFromHere,
    GoToLast,
    NextEvent,
    PreviousEvent,
    Seek,
    StepBack,
    StepForward,
    UndoReset,
)
from workbench.session.protocol.messages import (
    EnterRecording,
    Play,
    Reset,
    SingleStep,
)
from workbench.session.run.events import (
    FollowPolicy,
    InterruptWorker,
    ReplaceWorker,
    RunEffect,
    RunToEnter,
    Send,
)
from workbench.session.run.loading import apply_options, reload_file
from workbench.session.run.past import Past
from workbench.session.run.run import Change, Run, movable_bodies, new_pictures

_NEW_PLAN = ChooseMethod, SetRollouts, SetHorizon, SetNoise, SetTemperature, SetPlanEvery
DOES: frozenset[type[Command]] = frozenset(
    {
        TogglePlay,
        PlayRun,
        PauseRun,
        Step,
        ResetAll,
        ResetSelected,
        SelectEnv,
        NextEnv,
        PreviousEnv,
        SetSeed,
        SetSpeed,
        ChooseEpisodeEnd,
        ChooseActions,
        SetPolicy,
        ChoosePlannedEnvs,
        FollowBody,
        *_NEW_PLAN,
        ChoosePictures,
        ReloadFile,
        RebuildScene,
        ReloadCode,
        ReloadCameras,
        ChooseClass,
        UseControlMode,
        RestartWorker,
        Interrupt,
        StepBack,
        StepForward,
        PreviousEvent,
        NextEvent,
        Seek,
        GoToLast,
        UndoReset,
        ContinueFromHere,
    }
)
"""Commands that `apply` takes."""


def do_command(run: Run, command: Command) -> Change:
    match command:
        case TogglePlay():
            return _play(run, not run.playing)
        case PlayRun():
            return _play(run, True)
        case PauseRun():
            return _play(run, False)
        case Step():
            return _set_playing(show_live(run), False), [Send(SingleStep())]
        case ResetAll():
            return reset(run, None)
        case ResetSelected():
            return reset(run, (run.env,))
        case SetSeed(seed=seed):
            return reset(replace(run, seed=seed), None)
        case SelectEnv(env=env):
            if not 0 <= env < run.num_envs:
                raise Refused(f"There is no env {env}: they are 0 to {run.num_envs - 1}.")
            return change_settings(run, selected_env=env)
        case NextEnv():
            return change_settings(run, selected_env=(run.env + 1) % run.num_envs)
        case PreviousEnv():
            return change_settings(run, selected_env=(run.env - 1) % run.num_envs)
        case SetSpeed(speed=speed):
            return change_settings(run, speed=math.inf if speed is None else speed)
        case ChooseEpisodeEnd(rule=rule):
            return change_settings(run, episode_end=rule)
        case ChooseActions(source=source):
            # Without a name a policy is a source too: the next step reports what is missing.
            policy = run.named_policy if source == "policy" else None
            return change_settings(run, action_source=source, policy=policy)
        case SetPolicy(policy=policy):
            policy = policy.strip()
            if policy and ":" not in policy:
                raise Refused("A policy is written module:function or file.py:function.")
            return change_settings(run, action_source="policy", policy=policy or None)
        case ChoosePlannedEnvs(envs=envs):
            return change_settings(run, solve_all=envs == "all")
        case FollowBody(body=body):
            if body and body not in movable_bodies(run.task):
                raise Refused("There is no such body that moves.")
            return change_settings(run, traced=body)
        case ChoosePictures(pictures=pictures):
            return change_settings(run, pictures=pictures)
        case _ if isinstance(command, _NEW_PLAN):
            plan = replace(run.settings.plan, **msgspec.structs.asdict(command))
            return change_settings(run, plan=plan)
        case ReloadFile():
            return reload_file(run)
        case RebuildScene():
            return reload_file(run, "rebuilt")
        case ReloadCode():
            return reload_file(run, "patched")
        case ReloadCameras():
            return reload_file(run, "cameras")
        case ChooseClass(name=name):
            return _choose_class(run, name)
        case UseControlMode(mode=mode):
            if run.task is None or run.task.control_mode == mode:
                return run, []
            env_kwargs = {**run.options.env_kwargs, "control_mode": mode}
            return apply_options(run, replace(run.options, env_kwargs=env_kwargs))
        case RestartWorker():
            return replace(run, recovery=run.recovery.restart_requested()), [ReplaceWorker()]
        case Interrupt():
            return run, [InterruptWorker()]
        case _:
            return _travel(run, command)


def _travel(run: Run, command: Command) -> Change:
    """Commands of the timeline."""
    past, env = run.kept, run.env
    if past is None:
        raise Refused("There is no step yet.")
    match command:
        case StepBack():
            return show(run, past.seek_by(env, -1)), []
        case StepForward():
            return show(run, past.seek_by(env, 1)), []
        case PreviousEvent():
            return show(run, past.seek_event(env, -1)), []
        case NextEvent():
            return show(run, past.seek_event(env, 1)), []
        case Seek(step=step, episode_only=episode_only):
            return show(run, past.seek_tick(step, env if episode_only else None)), []
        case GoToLast():
            return show_live(run), []
        case UndoReset():
            run, effects = _play(run, False, live=False)
            restore = past.undo(env)
        case ContinueFromHere(scope=scope):
            effects = []
            restore = past.continue_from_shown(env, scope)
        case _:
            raise AssertionError(f"{command} is not in DOES")
    if restore is None:
        return new_pictures(run), effects
    return new_pictures(replace(run, past=past.seek(None))), [*effects, Send(restore)]


def _set_playing(run: Run, playing: bool) -> Run:
    return replace(run, playing=playing, wants_play=playing)


def _play(run: Run, playing: bool, live: bool = True) -> Change:
    run = show_live(run) if playing and live else run
    return _set_playing(run, playing), [Send(Play(playing))]


def reset(run: Run, env_idx: tuple[int, ...] | None) -> Change:
    return show_live(run), [Send(Reset(env_idx, run.seed if env_idx is None else None))]


def show_live(run: Run) -> Run:
    """The newest moment is shown."""
    return show(run, None if run.past is None else run.past.seek(None))


def show(run: Run, past: Past | None) -> Run:
    """`past` shows another moment, or the same."""
    if past is None or run.past is None or past.shown is run.past.shown:
        return run
    return new_pictures(replace(run, past=past))


def draw_past(run: Run) -> Change:
    if run.past is None:
        return run, []
    past, request = run.past.draw(run.env, run.settings.cameras, run.settings.pictures)
    return replace(run, past=past), [] if request is None else [Send(request)]


def change_settings(run: Run, **values: Any) -> Change:
    """Change fields of `Settings`; the selected env is clipped to the batch, once there is one."""
    before = run.settings
    new = replace(before, **values)
    selected = max(int(new.selected_env), 0)
    new = replace(new, selected_env=selected if run.task is None else min(selected, run.task.num_envs - 1))
    if new.action_source == "policy" and ("policy" in values or new.policy):
        run = replace(run, named_policy=new.policy)
    if new == before:
        return run, []
    policy = run.policy
    run = replace(run, settings=new)
    if new.cameras != before.cameras:
        # One that is asked for again is tried again.
        kept = {camera.key for camera in before.cameras} & {camera.key for camera in new.cameras}
        run = replace(
            run, failed_cameras={key: why for key, why in run.failed_cameras.items() if key in kept}
        )
    if new.selected_env != before.selected_env:
        # Without this the other env's picture would stay until a new one comes.
        run = new_pictures(replace(run, pictures={}))
    effects: list[RunEffect] = [Send(run.for_worker())]
    if run.policy != policy:
        effects.append(FollowPolicy(run.policy, run.folder))
    return run, effects


def _choose_class(run: Run, name: str) -> Change:
    if run.own_file is None or name not in run.choices:
        raise Refused("The file has no such task.")
    file = run.own_file if run.task is None or run.task.file is None else Path(run.task.file)
    choices = (name, *(other for other in run.choices if other != name))
    return reload_file(replace(run, reference=reference_to_class(run.reference, file, name), choices=choices))


def enter(run: Run, wanted: RunToEnter) -> Change:
    run, effects = _play(show_live(run), False)
    if run.task is None:
        return replace(run, to_enter=wanted), effects
    env_idx = tuple(range(run.num_envs)) if wanted.everywhere else (run.env,)
    request = EnterRecording(wanted.run, env_idx, wanted.source_file, dict(wanted.source), wanted.number)
    return run, [*effects, Send(request)]
