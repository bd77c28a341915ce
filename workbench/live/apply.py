"""Applies events, including commands, to the run."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

from workbench.envs.inspection import Inspection
from workbench.live.commands import (
    ChooseActions,
    ChooseClass,
    ChooseEpisodeEnd,
    ChoosePauseEntry,
    ChoosePauseTest,
    ChoosePictures,
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
    SetPauseLevel,
    SetPolicy,
    SetSeed,
    SetSpeed,
    Step,
    TogglePlay,
    UseControlMode,
)
from workbench.live.effects import Asked, Later
from workbench.live.env_commands import NextEnv, PreviousEnv, SelectEnv
from workbench.live.events import (
    EnvEventShown,
    EnvsReset,
    EpisodeStepShown,
    FileOpened,
    FileSaved,
    FollowPolicy,
    InterruptWorker,
    LoadDone,
    LoadPreempted,
    MomentShown,
    Now,
    OptionsApplied,
    PagesCounted,
    PastPicturesWanted,
    PolicySaved,
    ReadingChosen,
    ReadingDue,
    ReplaceWorker,
    RunEffect,
    RunToEnter,
    Send,
    SettingsChanged,
    SlidersMoved,
    VersionLoaded,
    WorkerBusy,
    WorkerDied,
)
from workbench.live.inspect_polling import read, schedule
from workbench.live.loading import (
    apply_options,
    died,
    file_saved,
    follow,
    loaded,
    reload_file,
    task_failed,
    try_next,
)
from workbench.live.messages import (
    CameraFailed,
    EnterRecording,
    Loading,
    NewProcessNeeded,
    PastPictures,
    Pictures,
    Placed,
    Play,
    ReadPolicyAgain,
    Reset,
    RulesBroken,
    SetSliderAction,
    SingleStep,
    SliderAction,
    Status,
    TaskFailed,
)
from workbench.live.past import Past
from workbench.live.run import Change, Run, at_rest, new_pictures, with_problem
from workbench.live.timeline_commands import (
    ContinueFromHere,
    GoToLast,
    NextEvent,
    PreviousEvent,
    Seek,
    StepBack,
    StepForward,
    UndoReset,
)
from workbench.page.command import Command, Refused
from workbench.task.description import Stepped
from workbench.task.reference import reference_to_class

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
        ChoosePauseEntry,
        ChoosePauseTest,
        SetPauseLevel,
        ChooseActions,
        SetPolicy,
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
"""Commands that `apply` handles."""
PICTURES_DELAY_SECONDS = 0.35
"""Debounce: the pictures of a past moment are drawn only after the moment was shown for this long. So a drag
of the slider does not draw the pictures of every moment on the way."""


def apply(run: Run, event: object, now: Now) -> Change:
    """The run after an event, and the effects to perform.

    The history (`Past.history`) is changed in place; nothing else is.

    Raises:
        Refused: the command makes no sense now; nothing has changed.
    """
    new, effects = _apply(run, event, now)
    stands_at = new.stands_at
    if new.pages and stands_at is not None and (stands_at != run.stands_at or isinstance(event, Placed)):
        effects = [*effects, Later(PICTURES_DELAY_SECONDS, PastPicturesWanted(stands_at))]
    new, for_reading = schedule(new, event, now)
    return new, [*effects, *for_reading]


def _apply(run: Run, event: object, now: Now) -> Change:
    match event:
        case Asked(command=command) if type(command) in DOES:
            return _do_command(run, command)
        case VersionLoaded():
            return loaded(run, event.loaded, event.on_disk, now)
        case Stepped():
            return _pause_if_due(run, _stepped(run, event), event)
        case Status():
            return _take_status(run, event), []
        case Pictures() | PastPictures():
            return _take_pictures(run, event), []
        case Loading():
            run = replace(run, recovery=run.recovery.began(event.number))
            return replace(run, state="loading", activity=event.activity), []
        case TaskFailed():
            return task_failed(run, event, now)
        case LoadDone() if run.to_enter is not None:
            return _enter(replace(run, to_enter=None), run.to_enter)
        case LoadPreempted():
            return try_next(run, event.failed)
        case NewProcessNeeded():
            return replace(run, needed=event), []
        case RulesBroken():
            rules = event if event.rows else None
            return replace(run, rules=rules, rules_serial=run.rules_serial + 1), []
        case CameraFailed():
            return replace(run, failed_cameras={**run.failed_cameras, event.key: event.why}), []
        case Placed():
            return _placed(run, event), []
        case SliderAction():
            return replace(run, slider_action=event.action), []
        case Inspection():
            return replace(run, inspection=event), []
        case WorkerDied():
            return died(run, event, now), []
        case WorkerBusy(busy=busy):
            return replace(run, busy=busy), []
        case FileSaved():
            return file_saved(run)
        case PolicySaved():
            return _policy_saved(run)
        case PagesCounted(count=count):
            counted = replace(run, pages=count)
            changes = (count == 0) != (run.pages == 0)
            return counted, [Send(counted.for_worker())] if changes else []
        case SettingsChanged(values=values):
            return _change_settings(run, **values)
        case OptionsApplied(options=options):
            return apply_options(run, options)
        case FileOpened():
            return _open_file(run, event)
        case MomentShown(serial=serial, env=env):
            run, effects = (run, []) if env is None else _change_settings(run, selected_env=env)
            return _show(run, None if run.past is None else run.past.seek(serial)), effects
        case EpisodeStepShown(env=env, step=step):
            run, effects = _change_settings(run, selected_env=env)
            return _show(run, None if run.kept is None else run.kept.seek_step(env, step)), effects
        case EnvEventShown(env=env, event=kind):
            run, effects = _change_settings(run, selected_env=env)
            return _show(run, None if run.kept is None else run.kept.seek_env_event(env, kind)), effects
        case PastPicturesWanted(at=at):
            return _draw_past(run) if at == run.stands_at else (run, [])
        case SlidersMoved():
            return _move_sliders(run, event)
        case ReadingChosen(sections=sections, body=body):
            return replace(run, read_sections=sections, read_body=body), []
        case ReadingDue():
            return read(run, now)
        case EnvsReset(env_idx=env_idx, seed=seed):
            return _reset(run, env_idx, seed)
        case RunToEnter():
            return _enter(run, event)
    return run, []


def _open_file(run: Run, event: FileOpened) -> Change:
    file = event.file
    opened = replace(
        run, reference=f"{file}:{event.class_name}", own_file=file, own_folder=file.parent, choices=()
    )
    return reload_file(opened, "auto", follow(opened, ()))


def _move_sliders(run: Run, event: SlidersMoved) -> Change:
    if run.task is None:
        return run, []
    envs = tuple(range(run.num_envs)) if event.env_idx is None else event.env_idx
    return _show_live(run), [Send(SetSliderAction(envs, event.dimensions, event.values))]


# --- commands ----------------------------------------------------------------------------------------


def _do_command(run: Run, command: Command) -> Change:
    match command:
        case TogglePlay():
            return _play(run, not run.playing)
        case PlayRun():
            return _play(run, True)
        case PauseRun():
            return _play(run, False)
        case Step():
            run = replace(_show_live(run), paused_at=None)
            return _set_playing(run, False), [Send(SingleStep())]
        case ResetAll():
            return _reset(run, None)
        case ResetSelected():
            return _reset(run, (run.env,))
        case SetSeed(seed=seed):
            return _reset(replace(run, seed=seed), None)
        case SelectEnv(env=env):
            if not 0 <= env < run.num_envs:
                raise Refused(f"There is no env {env}: the envs are 0 to {run.num_envs - 1}.")
            return _change_settings(run, selected_env=env)
        case NextEnv():
            return _change_settings(run, selected_env=(run.env + 1) % run.num_envs)
        case PreviousEnv():
            return _change_settings(run, selected_env=(run.env - 1) % run.num_envs)
        case SetSpeed(speed=speed):
            return _change_settings(run, speed=math.inf if speed is None else speed)
        case ChooseEpisodeEnd(rule=rule):
            return _change_settings(run, episode_end=rule)
        case ChoosePauseEntry(entry=entry):
            return replace(run, pause_when=replace(run.pause_when, entry=entry)), []
        case ChoosePauseTest(test=test):
            return replace(run, pause_when=replace(run.pause_when, test=test)), []
        case SetPauseLevel(level=level):
            return replace(run, pause_when=replace(run.pause_when, level=level)), []
        case ChooseActions(source=source):
            # If no policy was named yet, the next step reports that a policy is missing.
            policy = run.named_policy if source == "policy" else None
            return _change_settings(run, action_source=source, policy=policy)
        case SetPolicy(policy=policy):
            policy = policy.strip()
            if policy and ":" not in policy:
                raise Refused("Write the policy as module:function or file.py:function.")
            return _change_settings(run, action_source="policy", policy=policy or None)
        case ChoosePictures(pictures=pictures):
            return _change_settings(run, pictures=pictures)
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
    """Carry out a command of the timeline."""
    past, env = run.kept, run.env
    if past is None:
        raise Refused("There is no step to go to yet.")
    match command:
        case StepBack():
            return _show(run, past.seek_by(env, -1)), []
        case StepForward():
            return _show(run, past.seek_by(env, 1)), []
        case PreviousEvent():
            return _show(run, past.seek_event(env, -1)), []
        case NextEvent():
            return _show(run, past.seek_event(env, 1)), []
        case Seek(step=step, episode_only=episode_only):
            return _show(run, past.seek_tick(step, env if episode_only else None)), []
        case GoToLast():
            return _show_live(run), []
        case UndoReset():
            if (restore := past.undo(env)) is None:
                raise Refused("There is nothing to undo.")
            run, effects = _play(run, False)
        case ContinueFromHere(scope=scope):
            if (restore := past.continue_from_shown(env, scope)) is None:
                raise Refused("Show an earlier moment first: the run continues from there.")
            effects = []
        case _:
            raise AssertionError(f"{command} is not in DOES")
    return new_pictures(replace(run, past=past.seek(None))), [*effects, Send(restore)]


def _set_playing(run: Run, playing: bool) -> Run:
    return replace(run, playing=playing, wants_play=playing)


def _play(run: Run, playing: bool) -> Change:
    run = replace(_show_live(run), paused_at=None) if playing else run
    run = replace(_set_playing(run, playing), plays_asked=run.plays_asked + 1)
    return run, [Send(Play(playing, run.plays_asked))]


def _reset(run: Run, env_idx: tuple[int, ...] | None, seed: int | None = None) -> Change:
    return _show_live(run), [Send(Reset(env_idx, run.seed if env_idx is None else seed))]


def _show_live(run: Run) -> Run:
    """Show the newest moment."""
    return _show(run, None if run.past is None else run.past.seek(None))


def _show(run: Run, past: Past | None) -> Run:
    """The run with `past`, and with its pictures marked as new. If `past` is None or shows the same moment as
    before, the run does not change."""
    if past is None or run.past is None or past.shown is run.past.shown:
        return run
    return new_pictures(replace(run, past=past))


def _draw_past(run: Run) -> Change:
    if run.past is None:
        return run, []
    past, request = run.past.draw(run.env, run.settings.cameras, run.settings.pictures)
    return replace(run, past=past), [] if request is None else [Send(request)]


def _change_settings(run: Run, **values: Any) -> Change:
    """Change fields of `Settings`; once a task is loaded, the selected env is clipped to the batch."""
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
        # A failed camera is tried again after the user unticks it and ticks it again.
        kept = {camera.key for camera in before.cameras} & {camera.key for camera in new.cameras}
        run = replace(
            run, failed_cameras={key: why for key, why in run.failed_cameras.items() if key in kept}
        )
    if new.selected_env != before.selected_env:
        # Without this the pictures of the previous env would stay until new ones arrive.
        run = new_pictures(replace(run, pictures={}))
    effects: list[RunEffect] = [Send(run.for_worker())]
    if run.policy != policy:
        effects.append(FollowPolicy(run.policy, run.folder))
    return run, effects


def _choose_class(run: Run, name: str) -> Change:
    if run.own_file is None or name not in run.choices:
        raise Refused(f"The file has no task {name}.")
    file = run.own_file if run.task is None or run.task.file is None else Path(run.task.file)
    choices = (name, *(other for other in run.choices if other != name))
    return reload_file(replace(run, reference=reference_to_class(run.reference, file, name), choices=choices))


def _enter(run: Run, wanted: RunToEnter) -> Change:
    run, effects = _play(_show_live(run), False)
    if run.task is None:
        return replace(run, to_enter=wanted), effects
    env_idx = tuple(range(run.num_envs)) if wanted.everywhere else (run.env,)
    request = EnterRecording(wanted.run, env_idx, wanted.source_file, dict(wanted.source), wanted.number)
    return run, [*effects, Send(request)]


# --- events of the worker ----------------------------------------------------------------------------


def _stepped(run: Run, event: Stepped) -> Run:
    recovery = run.recovery if event.step.action is None else run.recovery.stepped()
    past, step, serial = run.past, event.step, run.step_serial
    if past is not None:
        # While a person drives, episodes go on after the time limit.
        driven = run.settings.action_source == "sliders" and run.settings.episode_end == "continue"
        past, moment = past.added(event, limited=not driven)
        step, serial = moment.step, moment.serial
    first = run.first_step_due
    run = replace(run, recovery=recovery, past=past, step=step, step_serial=serial, first_step_due=False)
    run = replace(run, pulled=event.pulled)
    if run.problem is not None and run.problem_at_run and not first:
        # The task runs again after a problem at run time: it was reset, or the policy changed.
        run = at_rest(with_problem(run, None))
    return run


def _pause_if_due(before: Run, run: Run, event: Stepped) -> Change:
    """Pause at the moment at which `Run.pause_when` holds."""
    env, joints = run.env, () if run.task is None else run.task.joints
    if run.paused_at is not None and not run.playing:
        # The worker made further steps before the pause arrived.
        return _show(run, None if run.past is None else run.past.seek(run.paused_at)), []
    if not run.playing or run.step is None or event.step.action is None or env >= len(run.step.reward):
        return run, []
    same_episode = before.step is not None and before.step.elapsed_steps[env] < run.step.elapsed_steps[env]
    if not run.pause_when.holds(before.step if same_episode else None, run.step, env, joints):
        return run, []
    return _play(replace(run, paused_at=run.step_serial), False)


def _take_status(run: Run, event: Status) -> Run:
    was = run.state
    run = replace(
        run,
        policy_failed=run.policy_failed and not event.playing,
        playing=event.playing if event.handled >= run.plays_asked else run.playing,
        steps_per_second=event.steps_per_second,
        real_time_factor=event.real_time_factor,
        recorded_share=event.recorded_share,
        watched_share=event.watched_share,
    )
    if event.activity:
        return replace(run, state="loading", activity=event.activity)
    return at_rest(replace(run, activity="")) if was in ("running", "paused", "loading") else run


def _take_pictures(run: Run, event: Pictures | PastPictures) -> Run:
    if run.past is not None:
        run.past.history.add_pictures(event)
    if isinstance(event, PastPictures):
        return run if run.past is None else new_pictures(run)
    if not event.pictures or event.pictures[0].env != run.env:
        return run
    # Pictures of sensors and of human cameras come in separate events: merge them, and drop unwatched
    # cameras.
    watched = {camera.key for camera in run.settings.cameras}
    made = {picture.key: picture for picture in event.pictures}
    shown = {key: picture for key, picture in {**run.pictures, **made}.items() if key in watched}
    return new_pictures(replace(run, pictures=shown, picture_milliseconds=event.milliseconds))


def _placed(run: Run, event: Placed) -> Run:
    if event.info is None or run.task is None:
        return run
    infos = tuple(event.info if c.key == event.key else c for c in run.task.cameras)
    reshaped = run.cameras_serial + event.reshaped  # the camera's modalities may have changed
    past = None if run.past is None else run.past.camera_moved(*event.key)
    return replace(run, task=replace(run.task, cameras=infos), cameras_serial=reshaped, past=past)


def _policy_saved(run: Run) -> Change:
    """Clear a problem of the policy and reload the policy; playing resumes if the problem had stopped it."""
    if run.problem is not None and run.problem.stage == "policy":
        run = at_rest(with_problem(run, None))
    return run, [Send(ReadPolicyAgain(play=run.policy_failed and run.wants_play))]
