"""Loads a saved version of the task in place of the running one and keeps as much state as possible."""

from __future__ import annotations

import pickle
from dataclasses import dataclass, replace

import numpy as np

from workbench.envs import action_vector as actions
from workbench.envs.broken_rule import BrokenRules
from workbench.envs.gpu_rules import Finding
from workbench.envs.hot_swap import (
    can_exchange_cameras,
    exchange_cameras,
    keep_observation_space,
    put_class,
    rehearse_hooks,
)
from workbench.envs.snapshots.snapshot import RestoreReport, Snapshot, restore_snapshot
from workbench.envs.step_result import StepResult
from workbench.envs.task_env import TaskEnv
from workbench.live.messages import Load, NewProcessNeeded, ReloadReport
from workbench.live.worker.process_state import (
    ProcessState,
    changed_settings,
    read_process_state,
    some_of,
    threads_of,
)
from workbench.machine.parse_python import parse_python
from workbench.pictures.render import list_cameras
from workbench.task.blame import blamed, returns_check
from workbench.task.call_graph import line_in
from workbench.task.description import changed_options
from workbench.task.load import LoadedTask, RefusedClass, load_task, undo_load, with_late_imports
from workbench.task.modules import read_source
from workbench.task.open import Clock, OpenedTask, Opening, build_task, import_task, notices_of, with_advice
from workbench.task.outlier_rules import rules_of_outliers
from workbench.task.problem import Interrupted, TaskError
from workbench.task.reference import named_file, reference_to_class
from workbench.task.reload_level import RESET_HOOKS, Change, find_change, inherited_names, removed_effects


@dataclass(frozen=True)
class Running:
    """The running version."""

    request: Load
    """The version's load."""
    opened: OpenedTask
    last: StepResult
    """Result of the last step."""


class _MustRebuild(Exception):
    """The new code does not fit the live env, and a new env must be built; the text is the reason."""


def load_version(
    request: Load,
    running: Running | None,
    opening: Opening | None = None,
) -> tuple[OpenedTask, ReloadReport | None]:
    """Load the requested version of the task, and keep as much state of `running` as possible.

    ``same`` and ``patched`` keep the env and give it the new class; ``cameras`` also rebuilds its cameras.
    ``rebuilt`` builds another env, which takes over the state by name; the caller closes the old env.
    ``restarted``: the env of a new worker takes over a snapshot that the server kept.

    A new env is rehearsed before it takes over (`build_task`). In a kept env, the changed hooks of resets and
    steps are called and undone (`rehearse_hooks`); then evaluate, observation and reward are computed for the
    present state, except at the level ``same``. No picture may be in progress.

    Raises:
        TaskError: the version does not work. If its code ran, the process must end: the effects of
            this code are not undone.
    """
    opening = opening or Opening(begins_anew=True)
    before = None if running is None else with_late_imports(running.opened.loaded)
    loaded = import_task(request.task, request.options, request.source, opening)
    try:
        return _bring_in(request, running, before, loaded, opening)
    except TaskError as error:
        # A user who has chosen this task, or runs it already, needs no advice about the file's other tasks.
        knows_others = False
        if running is None:
            found = _open_another(request, loaded, error, opening)
            if found is not None:
                return found, None
        else:
            knows_others = running.opened.loaded.chosen == loaded.chosen or not loaded.alternatives
        raise with_advice(
            error,
            loaded,
            request.options,
            lambda: load_task(request.task, source=request.source),
            knows_others,
        ) from error.__cause__


def _open_another(request: Load, tried: LoadedTask, error: TaskError, opening: Opening) -> OpenedTask | None:
    """The first other task of the file that opens, if the request allows another; else None."""
    if not request.any_task or isinstance(error.__cause__, Interrupted) or tried.file is None:
        return None
    for name in tried.alternatives:
        opening.on_activity(f"trying {name}")
        loaded = load_task(reference_to_class(request.task, tried.file, name), source=request.source)
        loaded = replace(loaded, in_place_of=RefusedClass(tried.chosen, str(error)))
        try:
            return build_task(loaded, request.options, replace(opening, clock=Clock()))
        except TaskError as further:
            undo_load(loaded)
            if isinstance(further.__cause__, Interrupted):
                raise
        except BaseException:
            undo_load(loaded)
            raise
    return None


def _bring_in(
    request: Load,
    running: Running | None,
    before: LoadedTask | None,
    loaded: LoadedTask,
    opening: Opening,
) -> tuple[OpenedTask, ReloadReport | None]:
    try:
        change = _what_changed(request, running, before, loaded)
        if running is not None and change.level != "rebuilt":
            try:
                opening.on_activity("trying the new version")
                return _exchange(running, loaded, change, opening.clock)
            except _MustRebuild as why:
                change = replace(change, level="rebuilt", reason=str(why))
        return _build(request, running, loaded, change, opening)
    except BaseException:
        # Otherwise the running version would use helper modules and registrations of the failed version.
        undo_load(loaded)
        raise


# --- which process ---------------------------------------------------------------------------------


def why_new_process(
    request: Load, running: Running, failed: bool, at_start: ProcessState, when_loaded: ProcessState
) -> NewProcessNeeded | None:
    """What the running version left in this process that no reload undoes. None if it left nothing, if the
    new version will leave the same things behind, or if the new version is not Python.

    Args:
        failed: whether the running version raised while it ran.
        at_start: process settings before any version was loaded.
        when_loaded: process settings after the running version was loaded.
    """
    before = with_late_imports(running.opened.loaded)
    same_file = named_file(request.task) == named_file(running.request.task)
    texts = _earlier_modules(before, request) if same_file else {}
    if same_file and before.file is not None and not _is_python(texts.get(str(before.file))):
        return None  # the new version will be refused before any of its code runs
    while_running = changed_settings(when_loaded, read_process_state()) + threads_of(before.source)
    at_load = changed_settings(at_start, when_loaded)
    gone = removed_effects(before.source, texts) if before.followed else ""
    if not (failed or while_running or at_load or gone):
        return None
    inherited = inherited_names(before.cls, {*before.source})
    change = find_change(before.source, texts, str(before.file), before.class_name, inherited)
    same_scene = same_file and before.followed and change.level != "rebuilt"
    if failed:
        reason = "the previous version failed while it ran"
    elif while_running:
        reason = f"the previous version has changed {some_of(while_running)}"
    elif same_scene or not before.followed:
        return None  # imports and scene do not change
    elif at_load:
        reason = f"the previous version has changed {some_of(at_load)}"
    else:
        reason = f"the effects of importing {gone} cannot be undone"
    return NewProcessNeeded(reason, same_scene)


def _is_python(text: str | None) -> bool:
    """Whether a file's text can be executed; `text` is None for a file that cannot be read."""
    if text is None:
        return False
    try:
        parse_python(text)
    except (SyntaxError, ValueError, RecursionError):
        return False
    return True


# --- which level -----------------------------------------------------------------------------------


def _what_changed(
    request: Load, running: Running | None, before: LoadedTask | None, loaded: LoadedTask
) -> Change:
    if running is None or before is None:
        return Change("rebuilt", "")
    if not loaded.followed:
        return Change("rebuilt", "it was requested")
    if loaded.file is not None and before.file != loaded.file:
        return Change("rebuilt", f"{loaded.file.name} was opened in place of {before.chosen}")
    if before.chosen != loaded.chosen:
        return Change("rebuilt", f"{loaded.chosen} is a different task from {before.chosen}")
    if before.env_id != loaded.env_id:
        return Change("rebuilt", _registration_text(before, loaded))
    if changed := changed_options(running.request.options, request.options):
        return Change("rebuilt", f"{' and '.join(changed)} changed")
    files = {*before.source, *loaded.source}
    inherited = inherited_names(loaded.cls, files)
    texts = {**_earlier_modules(before, request), **loaded.source}
    change = find_change(before.source, texts, str(loaded.file), loaded.class_name, inherited)
    if loaded.robot is not None and change.level != "same":
        return Change("rebuilt", f"a robot is part of the scene ({change.reason})")
    if request.level in ("auto", change.level):
        return change
    reason = f"{request.level} was requested"
    if request.level != "rebuilt":
        reason += f" ({change.level} would have been chosen: {change.reason})"
    # Rehearse a level that may be unsafe as if every hook had changed.
    hooks = change.hooks if change.level in ("patched", "cameras") else RESET_HOOKS
    return Change(request.level, reason, hooks)


def _registration_text(before: LoadedTask, loaded: LoadedTask) -> str:
    """How the class's registered id changed, as a text. The id of an unregistered class is its name."""
    if loaded.env_id == loaded.class_name:
        lost = "" if before.max_episode_steps is None else ", and so has no time limit"
        return f"{loaded.chosen} is no longer registered as {before.env_id}{lost}"
    if before.env_id == before.class_name:
        return f"{loaded.chosen} is registered as {loaded.env_id} now"
    return f"{loaded.chosen} is registered as {loaded.env_id} now, and not as {before.env_id}"


def _earlier_modules(before: LoadedTask, request: Load) -> dict[str, str]:
    """Present texts of the previous version's modules. Hooks of both versions may import them later."""
    texts: dict[str, str] = {}
    for path in before.source:
        given = (request.source or {}).get(path)
        try:
            texts[path] = given if given is not None else read_source(path)
        except (OSError, SyntaxError):
            continue
    return texts


# --- the env stays -----------------------------------------------------------------------------------


def _exchange(
    running: Running, loaded: LoadedTask, change: Change, clock: Clock
) -> tuple[OpenedTask, ReloadReport]:
    opened, env = running.opened, running.opened.env.env
    if change.level == "cameras" and not can_exchange_cameras(env):
        raise _MustRebuild(f"{change.reason}, and cameras cannot be exchanged here")
    rules = opened.env.broken_rules or BrokenRules({})
    # From here on nothing is undone: after a failure the process ends.
    put_class(env, loaded.cls)
    left: dict[str, str] = {}
    if change.level != "same":
        rules.edited(lambda row: _find_place(row, opened.loaded, loaded))
    task = TaskEnv(
        env,
        loaded.max_episode_steps,
        check=returns_check(loaded, opened.env.num_envs),
        obs=opened.env.obs,
    )
    if change.level == "cameras":
        with blamed("build", loaded, task):
            exchange_cameras(env)
    if change.tried_hooks:
        resets = "_initialize_episode" in change.tried_hooks
        with blamed("reset", loaded, task), rules.during("reset", confirms=resets):
            left = rehearse_hooks(env, change.tried_hooks)
    clock.lap("rehearse")
    first = running.last if change.level == "same" else _rescore(task, loaded, running.last, change)
    if change.level != "same":
        keep_observation_space(env, task.obs)
    clock.lap("rescore")
    loaded = with_late_imports(loaded)
    description = replace(
        opened.description,
        source_files=tuple(str(path) for path in loaded.source_files),
        source_hash=loaded.source_hash,
        source=dict(loaded.source),
        max_episode_steps=loaded.max_episode_steps,
        chosen=loaded.chosen,
        others=loaded.others,
        in_place_of=None,
        cameras=list_cameras(env) if change.level == "cameras" else opened.description.cameras,
        outlier_rules=rules_of_outliers(loaded, running.request.options.rules),
    )
    notices = notices_of(loaded, running.request.options, description.cameras)
    description = replace(description, notices=notices)
    report = ReloadReport(change.level, change.reason, not_carried=left)
    return OpenedTask(loaded, task, description, first, clock.laps), report


def _find_place(row: Finding, before: LoadedTask, after: LoadedTask) -> tuple[str, int] | None:
    """The place of a finding in the new version; the same place if its file is not part of the task. None if
    the function at the place has changed, or the finding has no file."""
    if row.file is None or row.line is None or row.file not in before.source:
        return None if row.file is None else (row.file, row.line or 1)
    text = after.source.get(row.file)
    line = None if text is None else line_in(before.source[row.file], text, row.line)
    return None if line is None else (row.file, line)


def _rescore(task: TaskEnv, loaded: LoadedTask, last: StepResult, change: Change) -> StepResult:
    # Compute the reward also after a reset, with a hold action, to find errors of the reward now.
    action = last.action if last.action is not None else actions.hold_action(task.parts, task.num_envs)
    try:
        with blamed("step", loaded, task):
            rescored = task.rescore(action)
    except TaskError as error:
        if change.hooks & RESET_HOOKS:
            raise _MustRebuild(
                f"{change.reason}, and the state lacks what a reset makes now ({error.problem.message})"
            ) from error
        raise
    if last.action is None:
        return replace(rescored, reward=np.zeros_like(rescored.reward), action=None)
    return rescored


# --- another env ---------------------------------------------------------------------------------------


def _build(
    request: Load, running: Running | None, loaded: LoadedTask, change: Change, opening: Opening
) -> tuple[OpenedTask, ReloadReport | None]:
    snapshot = _moment(request, running, loaded)
    opened = build_task(loaded, request.options, opening)
    if snapshot is None:
        report = ReloadReport("rebuilt", change.reason) if running is not None else None
        return opened, report
    action = None if running is None else running.last.action
    try:
        first, restored = _restore(opened, snapshot, action)
    except TaskError as error:
        # The new version works, as the rehearsal has shown, but not from this moment.
        with blamed("reset", opened.loaded, opened.env):
            first = opened.env.reset(request.options.seed)
        restored = RestoreReport((), {"the moment": f"the new version fails in it: {error.problem.message}"})
    except BaseException:
        opened.env.close()
        raise
    opening.clock.lap("restore")
    level = "restarted" if running is None else "rebuilt"
    reason = change.reason if running is not None else request.because or "the worker was restarted"
    same_scene = request.same_scene and bool(restored.carried)
    report = ReloadReport(level, reason, restored.carried, dict(restored.not_carried), same_scene)
    return replace(opened, first=first, milliseconds=opening.clock.laps), report


def _moment(request: Load, running: Running | None, loaded: LoadedTask) -> Snapshot | None:
    """The snapshot to restore after the build; None for a new episode."""
    if request.snapshot is not None:
        return pickle.loads(request.snapshot)
    if running is None or request.fresh or running.opened.loaded.chosen != loaded.chosen:
        return None
    if changed_options(running.request.options, request.options):
        return None  # envs with other options must start from a reset
    return running.opened.env.snapshot()


def _restore(
    opened: OpenedTask, snapshot: Snapshot, action: np.ndarray | None
) -> tuple[StepResult, RestoreReport]:
    task = opened.env
    there = [i for i in snapshot.env_idx if i < task.num_envs]
    fits = action is not None and action.shape == (task.num_envs, actions.width(task.parts))
    with blamed("reset", opened.loaded, task):
        report = restore_snapshot(task.env, snapshot, there)
        return task.rescore(action if fits else None), report
