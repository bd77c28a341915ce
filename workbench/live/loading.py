"""Decides which version to load after a save, on request or after a crash, and applies the result of a load."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

from workbench.envs.step_result import StepResult
from workbench.live.events import Follow, Now, ReplaceWorker, RunEffect, Send, WorkerDied
from workbench.live.history.env_table import EnvTable
from workbench.live.history.moments import History
from workbench.live.messages import SCENE_KEPT, Loaded, LoadLevel, NewProcessNeeded, Play, Request, TaskFailed
from workbench.live.past import Past
from workbench.live.process.heartbeat import death_problem
from workbench.live.process.supervisor import End
from workbench.live.run import (
    Change,
    PastAfterLoad,
    PastLoad,
    Run,
    at_rest,
    load_of,
    new_pictures,
    with_problem,
)
from workbench.machine.processes.wire import pack
from workbench.task.description import TaskDescription, TaskOptions, changed_options
from workbench.task.reference import RecordedTask, reference_to_class

_MAX_PAST_LOADS = 20


def first_requests(run: Run) -> tuple[Run, list[Request]]:
    """First requests to a new worker: settings, what to load, and whether to play."""
    requests: list[Request] = [run.for_worker()]
    recovery, inputs = run.recovery.next_load(run.newest_moment)
    run = replace(run, recovery=recovery)
    if inputs is not None:
        needed, run = run.needed, replace(run, needed=NewProcessNeeded("", False))
        requests.append(load_of(run, inputs, because=needed.reason, same_scene=needed.same_scene))
    elif run.state == "starting":
        # There is no version to load: the problem stays.
        run = replace(run, state="error", activity="")
    # A version that failed while it ran would fail again: it is restored paused.
    if run.wants_play and not (recovery.restoring and run.problem_at_run):
        requests.append(Play(True, run.plays_asked))
    return run, requests


def watched_files(run: Run, paths: Iterable[str] = (), at_fault: str | None = None) -> frozenset[Path]:
    """The files to watch: the task's own file, each of `paths` that is in the task's folder, and `at_fault`,
    which may be in any folder. Empty if the task has no file of its own."""
    if run.own_file is None or run.own_folder is None:
        return frozenset()
    modules = (Path(p) for p in paths if Path(p).is_relative_to(run.own_folder))
    return frozenset({run.own_file, *modules, *([] if at_fault is None else [Path(at_fault)])})


def files_at_fault(run: Run, failed: TaskFailed) -> frozenset[Path]:
    """The files to watch after a failure, including the file with the problem: a module that the task has
    never imported without an error is not in `source_files`, and may be in another folder."""
    if failed.problem.file is None:
        return frozenset()
    return watched_files(run, () if run.task is None else run.task.source_files, failed.problem.file)


def follow(
    run: Run, paths: Iterable[str], texts: Mapping[str, str] = MappingProxyType({})
) -> list[RunEffect]:
    files = watched_files(run, paths)
    return [Follow(files, texts)] if files else []


def reload_file(run: Run, level: LoadLevel = "auto", effects: Iterable[RunEffect] = ()) -> Change:
    """Reload the file. A level other than ``auto`` is forced, even if it keeps parts of the old version.

    If the worker does not handle the request (an endless loop), the supervisor interrupts or replaces it.
    """
    recovery, inputs = run.recovery.file_requested(run.newest_moment)
    run = replace(run, recovery=recovery)
    # A stopped worker is replaced, and the new one loads the file, see `first_requests`.
    load = ReplaceWorker() if run.state == "stopped" else Send(load_of(run, inputs, level))
    return run, [*effects, load]


def file_saved(run: Run) -> Change:
    run = replace(run, stale=True)
    if isinstance(run.reference, RecordedTask) and run.reference.approved is not None:
        # The task was opened with a recording's approved text: from now on the file on disk is used.
        run = replace(run, reference=str(run.reference))
    return reload_file(run)


def apply_options(run: Run, options: TaskOptions) -> Change:
    tried = options if changed_options(run.options, options) else None
    return reload_file(replace(run, tried_options=tried, options_refused=None))


def _past_after(before: TaskDescription | None, event: Loaded, restored: bool) -> PastAfterLoad:
    """Effect of a load on the history.

    Args:
        before: the previous version.
        restored: whether the load restored an earlier version.
    """
    if before is None:
        return "gone"
    report, same_source = event.reload, before.source_hash == event.task.source_hash
    if report is None:
        return "same" if restored and same_source else "gone"
    if report.level in SCENE_KEPT:
        return "patched" if report.level == "patched" else "same"
    same_task = before.chosen == event.task.chosen and before.num_envs == event.task.num_envs
    if report.level != "restarted" or not same_task or not (same_source or report.same_scene):
        return "gone"
    return "same" if same_source else "patched"


def loaded(run: Run, event: Loaded, on_disk: bool, now: Now) -> Change:
    """Handle a successful load."""
    restored = run.recovery.restoring
    stale = restored and not on_disk
    task, report, before = event.task, event.reload, run.task
    run = replace(run, recovery=run.recovery.loaded(task, now.monotonic))
    run = _take_options(run, event.options)
    kept = report is not None and report.level in SCENE_KEPT
    past = _past_after(before, event, restored)
    drawn = kept or (past != "gone" and before is not None and pack(before.geometry) == pack(task.geometry))
    if drawn and before is not None:
        # Keep the same object: it tells the page that the scene need not be rebuilt.
        task = replace(task, geometry=before.geometry)
    level, reason = (None, "the first version") if report is None else (report.level, report.reason)
    milliseconds = sum(event.milliseconds.values())
    run = replace(
        run,
        task=task,
        task_serial=run.task_serial + 1,
        step=event.first,
        load_milliseconds=milliseconds,
        reload=report,
        after_load=past,
        activity="",
        stale=stale,
        failed_cameras=run.failed_cameras if restored else {},
        loads=_remembered(run, PastLoad(now.wall, level, reason, milliseconds)),
        first_step_due=not kept,
    )
    if not kept:
        run = _new_scene(run, task, event.first, its_past_stays=past != "gone", drawn=drawn)
    elif run.past is not None:
        run = replace(run, step=run.past.history.replace_last(event.first))
    if past != "gone" and run.past is not None and (before is None or before.source_hash != task.source_hash):
        run.past.history.begin_version(task.outlier_rules)
        run = replace(run, versions=(*run.versions, (run.past.history.last + 1, task)))
    if report is None or report.level not in ("same", "patched"):
        run = replace(run, cameras_serial=run.cameras_serial + 1, pictures=run.pictures if kept else {})
        run = new_pictures(run)
    if not (restored and run.choices):  # the user may have chosen another class since
        run = replace(run, choices=(task.chosen, *task.others) if task.others else ())
    if task.others and task.source_files and task.file is not None:
        running = reference_to_class(run.reference, Path(task.file), task.chosen)
        # Another class may run in place of the failing one: saves then reload the running class.
        reference = run.reference if task.in_place_of is None else running
        run = replace(run, running_reference=running, reference=reference)
    else:
        run = replace(run, running_reference=run.reference)
    if not restored:  # after a restore the problem that killed the worker stays visible
        run = with_problem(run, None)
    run = at_rest(run)
    effects = [*follow(run, task.source_files, {} if stale else task.source), Send(run.for_worker())]
    return run, effects


def _new_scene(run: Run, task: TaskDescription, first: StepResult, its_past_stays: bool, drawn: bool) -> Run:
    selected = min(run.env, task.num_envs - 1)
    run = replace(
        run,
        scene_serial=run.scene_serial + (not drawn),
        settings=replace(run.settings, selected_env=selected),
        inspection=None,
        slider_action=None,
        # The worker reports broken rules of the new scene after the load.
        rules=None,
        rules_serial=run.rules_serial + 1,
    )
    if run.past is not None and its_past_stays:
        return run
    begins = 0 if run.past is None else run.past.history.last + 1
    table = EnvTable(task.geometry, first, task.control_dt, task.reward_mode, task.outlier_rules)
    past = Past(History(table, run.history_bytes, begins, task.joints))
    return replace(run, past=past, versions=((begins, task),))


def task_failed(run: Run, event: TaskFailed, now: Now) -> Change:
    run = with_problem(run, event.problem, event.at_run, event.spoiled)
    run = replace(run, policy_failed=run.policy_failed or event.problem.stage == "policy")
    run, of_options = _refuse_options(run, event.options)
    if not event.at_run:
        run = replace(
            run,
            loads=_remembered(run, PastLoad(now.wall, None, event.problem.message, problem=event.problem)),
        )
    run = replace(
        run,
        activity="",
        playing=run.playing and not event.at_run,
        choices=event.classes or run.choices,
        stale=run.stale or not (event.at_run or of_options),
    )
    run = at_rest(run) if event.kept else replace(run, state="error")
    return try_next(run, event)


def try_next(run: Run, failed: TaskFailed) -> Change:
    """Send the next attempt of `Recovery` to a worker without a version, unless the worker is spoiled and
    ends."""
    if failed.spoiled:
        return replace(run, needed=NewProcessNeeded(failed.spoiled, failed.at_run)), []
    recovery, goes_on = run.recovery.failed(failed.kept, run.newest_moment)
    inputs = None
    if goes_on:
        recovery, inputs = recovery.next_load(run.newest_moment)
    run = replace(run, recovery=recovery)
    return run, [] if inputs is None else [Send(load_of(run, inputs))]


def _take_options(run: Run, loaded: TaskOptions | None) -> Run:
    if loaded is None:
        return run
    taken = run.tried_options is not None and not changed_options(run.tried_options, loaded)
    return replace(
        run,
        options=loaded,
        tried_options=None if taken else run.tried_options,
    )


def _refuse_options(run: Run, failed: TaskOptions | None) -> tuple[Run, bool]:
    """Drop options with which the task failed, so that the next save does not fail with them. Returns False if the options
    were not the cause."""
    tried = run.tried_options
    if tried is None or failed is None or changed_options(tried, failed):
        return run, False
    # Without an env there is nothing to keep: the next load tries these options again.
    options = replace(tried, seed=run.options.seed) if run.task is None else run.options
    return replace(run, tried_options=None, options=options, options_refused=tried), True


def died(run: Run, event: WorkerDied, now: Now) -> Run:
    death, recovery = event.death, run.recovery
    while_loading = recovery.loading
    texts = executed_texts(run, while_loading)
    run = replace(
        run,
        recovery=recovery.died(death.end is End.DIED, death.doing is None, now.monotonic, run.newest_moment),
    )
    if while_loading:
        run, _ = _refuse_options(run, run.tried_options)
    if death.end is not End.HANDED_OVER and (death.end is not End.ASKED or death.stack):
        problem = death_problem(death.why, death.doing, death.stack, run.own_files, event.printed, texts)
        run = with_problem(run, problem, at_run=not while_loading)
    if death.doing == "drawing" and death.end is not End.ASKED:
        # The next worker would die of the same picture.
        why = f"The worker {death.why} while it rendered. To retry, untick the camera and tick it again."
        failed = {camera.key: why for camera in run.settings.cameras}
        run = replace(run, failed_cameras={**run.failed_cameras, **failed})
    if death.end not in (End.FILE_WAITS, End.HANDED_OVER):
        run = replace(run, wants_play=False)
    return replace(
        run,
        playing=False,
        plays_asked=0,
        steps_per_second=0.0,
        real_time_factor=0.0,
        state="stopped" if death.gives_up else "starting",
        activity="" if death.gives_up else "starting a new worker",
    )


def executed_texts(run: Run, while_loading: bool) -> Mapping[str, str]:
    """Source by path of the version that is being loaded (empty if unknown), or of the running version if the worker is
    not loading."""
    recovery = run.recovery
    if not while_loading:
        return {} if run.task is None else run.task.source
    if recovery.restoring:
        return recovery.good_source or {}
    if recovery.file_waits:
        # Empty texts: the file was saved again, so the lines on disk are not those that ran.
        return dict.fromkeys(run.own_files, "")
    return {}


def _remembered(run: Run, load: PastLoad) -> tuple[PastLoad, ...]:
    return load, *run.loads[: _MAX_PAST_LOADS - 1]
