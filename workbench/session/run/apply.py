"""How each event changes the run."""

from __future__ import annotations

from dataclasses import replace

from workbench.core.capture.inspection import Inspection
from workbench.jobs.task import Stepped
from workbench.session.events import Asked
from workbench.session.protocol.messages import (
    CameraFailed,
    Inspect,
    LoadFailed,
    Loading,
    NewProcessNeeded,
    PastPictures,
    Pictures,
    Placed,
    ReadPolicyAgain,
    RulesBroken,
    Status,
    Tell,
    Told,
)
from workbench.session.run.asked import (
    DOES,
    change_settings,
    do_command,
    draw_past,
    enter,
    reset,
    show,
    show_live,
)
from workbench.session.run.events import (
    ActionTold,
    EnvsReset,
    EpisodeStepShown,
    FileOpened,
    FileSaved,
    InspectionWanted,
    LoadDone,
    LoadGaveWay,
    MomentShown,
    Now,
    OptionsApplied,
    PagesCounted,
    PastPicturesWanted,
    PolicySaved,
    RunToEnter,
    Send,
    SettingsChanged,
    VersionLoaded,
    WorkerBusy,
    WorkerDied,
)
from workbench.session.run.loading import (
    apply_options,
    died,
    file_saved,
    follow,
    load_failed,
    loaded,
    reload_file,
    try_next,
)
from workbench.session.run.run import Change, Run, at_rest, new_pictures, with_problem


def apply(run: Run, event: object, now: Now) -> Change:
    """The run after an event, and what has to be done.

    Only the history is written into in place (see `Past.history`): all else is in the value.

    Raises:
        Refused: the command makes no sense now; nothing has changed.
    """
    match event:
        case Asked(command=command) if type(command) in DOES:
            return do_command(run, command)
        case VersionLoaded():
            return loaded(run, event.loaded, event.on_disk, now)
        case Stepped():
            return _stepped(run, event), []
        case Status():
            return _take_status(run, event), []
        case Pictures() | PastPictures():
            return _take_pictures(run, event), []
        case Loading():
            run = replace(run, recovery=run.recovery.began(event.number))
            return replace(run, state="loading", activity=event.activity), []
        case LoadFailed():
            return load_failed(run, event, now)
        case LoadDone() if run.to_enter is not None:
            return enter(replace(run, to_enter=None), run.to_enter)
        case LoadGaveWay():
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
        case Told():
            return replace(run, told=event.action), []
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
            return change_settings(run, **values)
        case OptionsApplied(options=options):
            return apply_options(run, options)
        case FileOpened():
            file = event.file
            opened = replace(
                run, reference=f"{file}:{event.class_name}", own_file=file, own_folder=file.parent, choices=()
            )
            return reload_file(opened, "auto", follow(opened, ()))
        case MomentShown(serial=serial, env=env):
            run, effects = (run, []) if env is None else change_settings(run, selected_env=env)
            return show(run, None if run.past is None else run.past.seek(serial)), effects
        case EpisodeStepShown(env=env, step=step):
            run, effects = change_settings(run, selected_env=env)
            return show(run, None if run.past is None else run.past.seek_step(env, step)), effects
        case PastPicturesWanted():
            return draw_past(run)
        case ActionTold():
            if run.task is None:
                return run, []
            envs = tuple(range(run.num_envs)) if event.env_idx is None else event.env_idx
            return show_live(run), [Send(Tell(envs, event.dimensions, event.values))]
        case InspectionWanted(sections=sections):
            return run, [Send(Inspect(run.env, sections))]
        case EnvsReset(env_idx=env_idx):
            return reset(run, env_idx)
        case RunToEnter():
            return enter(run, event)
    return run, []


# --- what the worker says ---------------------------------------------------------------------------


def _stepped(run: Run, event: Stepped) -> Run:
    if event.step.action is not None:
        run = replace(run, recovery=run.recovery.stepped())
    if run.past is None:
        run = replace(run, step=event.step)
    else:
        past, moment = run.past.added(event)
        run = replace(run, past=past, step=moment.step, step_serial=moment.serial)
    first, run = run.first_step_due, replace(run, first_step_due=False)
    if run.problem is not None and run.problem_at_run and not first:
        # It runs again after a problem at run time: the task was reset, or the policy changed.
        run = at_rest(with_problem(run, None))
    return run


def _take_status(run: Run, event: Status) -> Run:
    was = run.state
    run = replace(
        run,
        policy_failed=run.policy_failed and not event.playing,
        playing=event.playing,
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
    # Sensors and human cameras come separately, so pictures are merged; unwatched cameras are dropped.
    watched = {camera.key for camera in run.settings.cameras}
    made = {picture.key: picture for picture in event.pictures}
    shown = {key: picture for key, picture in {**run.pictures, **made}.items() if key in watched}
    return new_pictures(replace(run, pictures=shown, picture_milliseconds=event.milliseconds))


def _placed(run: Run, event: Placed) -> Run:
    if event.info is None or run.task is None:
        return run
    infos = tuple(event.info if c.key == event.key else c for c in run.task.cameras)
    reshaped = run.cameras_serial + event.reshaped  # its modalities may have changed
    past = None if run.past is None else run.past.camera_moved(*event.key)
    return replace(run, task=replace(run.task, cameras=infos), cameras_serial=reshaped, past=past)


def _policy_saved(run: Run) -> Change:
    """Clear a problem of the policy; playing resumes if one had stopped it."""
    if run.problem is not None and run.problem.stage == "policy":
        run = at_rest(with_problem(run, None))
    return run, [Send(ReadPolicyAgain(play=run.policy_failed and run.wants_play))]
