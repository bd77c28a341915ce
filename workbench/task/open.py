"""Opens a task: imports, builds, rehearses and describes it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from mani_skill.envs.sapien_env import BaseEnv

from workbench.envs import action_vector as actions
from workbench.envs.arms import find_arms, without_arms
from workbench.envs.assets import MissingAssets
from workbench.envs.backends import BackendUnavailable, find_renderer, keep_render_device, unused_gpu_text
from workbench.envs.broken_rule import BrokenRule, NeedsOneEnv, class_is_installed, in_brackets, warn_of
from workbench.envs.camera_data import CameraInfo
from workbench.envs.cpu_scene import BatchedCpuMixin
from workbench.envs.error_notes import CoreRefusal
from workbench.envs.gpu_rules import Degree, Finding
from workbench.envs.keywords import constructor_arguments, control_mode_of, describe_keywords
from workbench.envs.maniskill_private import parse_cameras, version_notice
from workbench.envs.read_robots import read_robots
from workbench.envs.recorded_run import env_kwargs
from workbench.envs.scene.read_scene import read_geometry
from workbench.envs.scene.scene_index import joint_names
from workbench.envs.step_result import StepResult
from workbench.envs.task_env import EnvOptions, TaskEnv, make_env
from workbench.machine.versions import rerun_notice
from workbench.pictures.render import (
    findings_of_shaders,
    list_cameras,
    recorded_pictures,
    segmentation_names,
    take_pictures,
)
from workbench.pictures.visibility import objects_to_see
from workbench.task.blame import blamed, returns_check
from workbench.task.description import ActionDimension, ArmDescription, TaskDescription, TaskOptions
from workbench.task.load import LoadedTask, import_modules, load_task, undo_load, with_late_imports
from workbench.task.outlier_rules import rules_of_outliers
from workbench.task.problem import Interrupted, TaskError, shorten
from workbench.task.reference import TaskName


@dataclass(frozen=True)
class OpenedTask:
    """A task that was built and rehearsed."""

    loaded: LoadedTask
    env: TaskEnv
    description: TaskDescription
    first: StepResult
    """Result of the reset with the requested seed."""
    milliseconds: dict[str, float]
    """Wall time of each part in milliseconds: import, build, reset, rehearse, geometry."""


class Clock:
    """Wall time of the parts of a load, in milliseconds."""

    def __init__(self) -> None:
        self._last = time.perf_counter()
        self.laps: dict[str, float] = {}

    def lap(self, name: str) -> None:
        now = time.perf_counter()
        self.laps[name] = self.laps.get(name, 0.0) + 1000 * (now - self._last)
        self._last = now


@dataclass(frozen=True)
class Opening:
    """Callbacks and switches of opening a task."""

    on_activity: Callable[[str], None] = lambda activity: None
    """Called before each part of the work with its name, for a status line."""
    on_finding: Callable[[Finding], None] = warn_of
    """Called once for each line at which a rule is broken without stopping the task."""
    begins_anew: bool = False
    """Whether each reset is an exact point (`BatchedCpuMixin.begins_anew`), for a session that seeks back."""
    clock: Clock = field(default_factory=Clock)


def with_advice(
    error: TaskError,
    loaded: LoadedTask,
    options: TaskOptions,
    again: Callable[[], LoadedTask],
    knows_others: bool = False,
) -> TaskError:
    """The error of a task that failed to open, with advice in its message: to open another task of the file,
    or to open only one env.

    Args:
        again: imports the task again, because the failed import was undone.
        knows_others: True: give no advice about other tasks of the file.
    """
    advice: list[str] = []
    if options.num_envs > 1 and _may_be_of_the_batch(error):
        tried = min(options.num_envs, _MAX_SEEDS_TRIED)
        if _runs_alone(again, options, tried):
            advice.append(
                f"the task works with 1 env, from each of {tried} seeds, but not with {options.num_envs}: open it "
                "with --num-envs 1, or set Envs to 1 on the page (Run tab, How the envs are made)"
            )
    # Another class does not help if an asset is missing, unless it is a task of its own.
    others = loaded.alternatives if isinstance(error.__cause__, MissingAssets) else loaded.others
    if others and loaded.file is not None and not knows_others:
        file = loaded.file.name
        advice.append(
            f"{loaded.chosen} of {file} was tried; the file also has {', '.join(others)}: name one of these, as "
            f"in {file}:{others[-1]}, or choose it as Task on the page (Run tab)"
        )
    if not advice:
        return error
    message = f"{error.problem.message} ({shorten('; '.join(advice))})"
    classes = (loaded.chosen, *loaded.others) if loaded.others else ()
    return TaskError(replace(error.problem, message=message), classes)


_MAX_SEEDS_TRIED = 8
"""Maximum number of seeds with which one env is tried: an error with 16 envs may come from the state of a
single env."""


def _may_be_of_the_batch(error: TaskError) -> bool:
    """Whether the task may be written for one env: the error is a broken rule, or it may be about a shape (from
    torch or numpy). False for refusals of the core, which have their own advice, and for wrong return values, which
    one env hides: their message names the shape that is right with any number of envs."""
    cause = error.__cause__
    if error.problem.stage == "returns" or isinstance(cause, BackendUnavailable):
        return False
    if isinstance(cause, CoreRefusal):
        return isinstance(cause, BrokenRule)
    return isinstance(cause, RuntimeError | ValueError | TypeError | IndexError)


def _runs_alone(again: Callable[[], LoadedTask], options: TaskOptions, tried: int) -> bool:
    """Whether the task opens with one env, and resets and steps it from each of `tried` seeds."""
    try:
        loaded = again()
    except TaskError:
        return False
    try:
        quietly = Opening(on_finding=lambda finding: None)
        opened = build_task(loaded, replace(options, num_envs=1), quietly)
        try:
            for seed in range(options.seed, options.seed + tried):
                rehearse(opened.env, loaded, seed)
        finally:
            opened.env.close()
    except TaskError as error:
        if isinstance(error.__cause__, Interrupted):
            raise
        return False
    finally:
        undo_load(loaded)
    return True


def open_task(
    reference: TaskName,
    options: TaskOptions,
    *,
    source: Mapping[str, str] | None = None,
    on_activity: Callable[[str], None] = lambda activity: None,
    on_finding: Callable[[Finding], None] = warn_of,
) -> OpenedTask:
    """Import, build, rehearse and reset a task, without a page.

    Args:
        source: as in `load_task`.

    Raises:
        TaskError: with the author's file and line; the import is undone.
    """
    opening = Opening(on_activity, on_finding)
    loaded = import_task(reference, options, source, opening)
    try:
        return build_task(loaded, options, opening)
    except TaskError as error:
        undo_load(loaded)
        raise with_advice(error, loaded, options, lambda: load_task(reference, source)) from error.__cause__
    except BaseException:
        undo_load(loaded)
        raise


def import_task(
    reference: TaskName, options: TaskOptions, source: Mapping[str, str] | None, opening: Opening
) -> LoadedTask:
    """Import a task's class, with `source` instead of the files on disk if given. Raises TaskError."""
    opening.on_activity(f"importing {str(reference).rsplit('/', 1)[-1]}")
    if "render_backend" not in options.env_kwargs and (renderer := find_renderer()) is not None:
        # Before the import: SAPIEN refuses another device while a material of the author's module or of a
        # failed build is alive.
        keep_render_device(renderer.render_backend)
    import_modules(options.imports)
    loaded = load_task(reference, source=source)
    opening.clock.lap("import")
    return loaded


def build_task(loaded: LoadedTask, options: TaskOptions, opening: Opening) -> OpenedTask:
    """Build, rehearse and reset an imported task. A task that uses a feature that works only with one env
    gets one env and a notice.

    On TaskError the caller undoes the import (`undo_load`).
    """
    try:
        return _built(loaded, options, opening)
    except TaskError as error:
        needs = error.__cause__
        if options.num_envs == 1 or not isinstance(needs, NeedsOneEnv):
            raise
    opened = _built(loaded, replace(options, num_envs=1), opening)
    notice = f"One env is open, not {options.num_envs}: {needs.reason}"
    if opened.env.broken_rules is not None:
        opened.env.broken_rules.report_breach("one-env-only", f"{notice}.", None, needs.place, needs)
    description = opened.description
    notice = f"{notice}{in_brackets(needs.place)}."
    return replace(opened, description=replace(description, notices=(*description.notices, notice)))


def _built(loaded: LoadedTask, options: TaskOptions, opening: Opening) -> OpenedTask:
    on_activity, clock = opening.on_activity, opening.clock
    on_activity(f"building {options.num_envs} {'env' if options.num_envs == 1 else 'envs'}")
    with blamed("build", loaded):
        env = make_env(
            loaded.cls,
            EnvOptions(
                num_envs=options.num_envs,
                backend=options.backend,
                pictures=options.pictures,
                rules=_rules(loaded, options),
                on_finding=opening.on_finding,
                kwargs=constructor_arguments(loaded.cls, options.env_kwargs, BaseEnv),
            ),
            asset_ids=loaded.asset_ids,
            default_kwargs=loaded.default_kwargs,
        )
    clock.lap("build")
    if opening.begins_anew and isinstance(env, BatchedCpuMixin):
        env.begins_anew = True
    try:
        with blamed("build", loaded):
            task = TaskEnv(env, loaded.max_episode_steps, check=returns_check(loaded, options.num_envs))
        on_activity("trying a reset and a step")
        rehearse(task, loaded, options.seed)
        clock.lap("rehearse")
        if task.broken_rules is not None:
            task.broken_rules.begin()
        with blamed("reset", loaded, task):
            first = task.reset(options.seed)
        clock.lap("reset")
        on_activity("the task's code has run; the workbench reads the shapes")
        loaded = with_late_imports(loaded)
        description = describe(loaded, task, options.env_kwargs, loaded.max_episode_steps)
        description = replace(
            description,
            notices=notices_of(loaded, options, description.cameras),
            outlier_rules=rules_of_outliers(loaded, options.rules),
        )
        clock.lap("geometry")
    except BaseException:
        env.close()
        raise
    return OpenedTask(loaded, task, description, first, clock.laps)


def rehearse(task: TaskEnv, loaded: LoadedTask, seed: int) -> None:
    """Do one reset, one step and one partial reset, and check what they return.

    A task that can be imported and built can still fail here. The failure must be found before the running
    version is replaced.

    Raises:
        TaskError: a reset or the step fails, or returns a wrong value.
    """
    with blamed("reset", loaded, task):
        task.reset(seed)
    with blamed("step", loaded, task):
        task.step(actions.hold_action(task.parts, task.num_envs))
    if task.num_envs > 1:
        with blamed("reset", loaded, task):
            task.reset(env_idx=[0])


def describe(
    loaded: LoadedTask, task: TaskEnv, given: Mapping[str, Any], max_episode_steps: int | None
) -> TaskDescription:
    """The task as plain data; `given` are the keyword arguments that it was made with."""
    env = task.env
    dimensions = [
        ActionDimension(name, float(low), float(high), actions.zero_holds(part))
        for part in task.parts
        for name, low, high in zip(part.names, part.low, part.high, strict=True)
    ]
    simulation = "gpu" if env.device.type == "cuda" else "cpu (batched)"
    can_render = bool(env.scene.can_render())
    renderer = find_renderer() if can_render else None
    return TaskDescription(
        env_id=loaded.env_id,
        class_name=loaded.class_name,
        file=None if loaded.file is None else str(loaded.file),
        source_files=tuple(str(path) for path in loaded.source_files) if loaded.followed else (),
        source_hash=loaded.source_hash,
        source=dict(loaded.source),
        backend=simulation,
        pictures=getattr(env.scene, "pictures", "exact"),
        device=f"{env.device}" + (f", pictures on {renderer.name}" if renderer else ", no pictures"),
        num_envs=task.num_envs,
        max_episode_steps=max_episode_steps,
        obs_mode=env.obs_mode,
        reward_mode=env.reward_mode,
        control_mode=control_mode_of(env),
        control_dt=task.control_dt,
        actions=tuple(dimensions),
        geometry=read_geometry(env),
        cameras=list_cameras(env),
        segmentation=segmentation_names(env),
        can_render=can_render,
        chosen=loaded.chosen,
        others=loaded.others if loaded.followed else (),
        in_place_of=None if loaded.in_place_of is None else loaded.in_place_of.name,
        env_kwargs=env_kwargs(env, {**loaded.default_kwargs, **given}),
        objects=objects_to_see(env),
        joints=joint_names(env),
        arms=tuple(ArmDescription(arm.name, arm.joint_names) for arm in find_arms(env)),
        armless=without_arms(env),
        robots=read_robots(env),
        parse_cameras=parse_cameras.__name__,
        made=describe_keywords(loaded.cls, env, given, loaded.default_kwargs, BaseEnv),
    )


def notices_of(loaded: LoadedTask, options: TaskOptions, cameras: Iterable[CameraInfo]) -> tuple[str, ...]:
    """Notices about a working task, as sentences."""
    own = loaded.notices if loaded.followed else ()
    of_cameras = [f"{each.file}:{each.line}: {each.message}" for each in findings_of_shaders(cameras)]
    of_machine = (unused_gpu_text(options.backend), version_notice(), rerun_notice())
    return (*own, *of_cameras, *(text for text in of_machine if text))


def _rules(loaded: LoadedTask, options: TaskOptions) -> Degree | None:
    """The degree of the rules. An installed task cannot be edited by its user: by default it gets warnings only."""
    if options.rules is None and not loaded.followed and class_is_installed(loaded.cls):
        return "warn"
    return options.rules


# --- warming up a process ------------------------------------------------------------------------------

_SMALL_TASK = "PickCube-v1"
"""A task that needs no download, has a sensor and a human camera, and has the robot that most tasks have."""


def warm_up(options: TaskOptions, keep_going: Callable[[], bool]) -> None:
    """Warm up a process: make a small env, render it, and close it. Ends early when `keep_going` returns False.

    Making the first batch of envs in a process and reading its shapes takes 1.2 s on two cores (measured with
    4 envs); the second batch takes 0.12 s. The first picture of each kind of camera compiles its shaders. The
    robot's files, the render system and the shaders are the same for any task.

    A TaskError of the build is ignored: the author's own load would fail too (no renderer, no GPU), and its
    report is better.
    """
    # Of the author's arguments, only ``render_backend`` decides whether rendering is possible.
    renderer = {name: value for name, value in options.env_kwargs.items() if name == "render_backend"}
    try:
        opened = open_task(_SMALL_TASK, replace(options, num_envs=1, env_kwargs=renderer, imports=()))
    except TaskError:
        return
    try:
        for camera in recorded_pictures(opened.description.cameras):
            if not keep_going():
                return
            take_pictures(opened.env.env, 0, [camera])
    finally:
        opened.env.close()
