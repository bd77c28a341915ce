"""Answers questions about cameras in the worker, and leaves the env unchanged."""

from __future__ import annotations

import ast
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

from workbench.authoring.camera_source.cameras import HookCameras
from workbench.authoring.camera_source.run_hooks import run_hooks
from workbench.authoring.loading.load import LoadedTask, load_task, undo_load
from workbench.authoring.loading.reference import reference_to_class
from workbench.authoring.source.names import Project
from workbench.authoring.source.read_values import module_of
from workbench.authoring.source.text import plain_line_ends
from workbench.core import maniskill_private
from workbench.core.camera_data import Picture
from workbench.core.cameras.place import PlacedCameras
from workbench.core.cameras.render import take_pictures
from workbench.core.cameras.report import CameraReport
from workbench.core.cameras.search import suggest_cameras
from workbench.core.cameras.visibility import (
    Placement,
    measure_placement,
    picture_of,
    placement_of,
    small_size,
)
from workbench.core.env.hot_swap import put_class, undone
from workbench.jobs.open_task import OpenedTask, blamed
from workbench.session.protocol.questions import CameraQuestion, DrawCamera, MeasureCamera, RunCameras
from workbench.session.worker.pacing import throttled

REPORT_SIDE = 128
"""At most so many pixels on the shorter side of a measured picture: an object too small for these is hardly visible."""
LARGEST_SCALE = 4.0
_PROGRESS_PERIOD = 0.2


def answer(
    opened: OpenedTask,
    placed: PlacedCameras,
    question: CameraQuestion,
    on_progress: Callable[[int, int], None],
    cancelled: Callable[[], bool],
) -> object:
    """Answer one question. No picture may be under way.

    Args:
        on_progress: called with done and total during a long search.
        cancelled: whether to end a search early.

    Raises:
        ValueError, IndexError, RuntimeError, TaskError: there is no answer.
    """
    if isinstance(question, DrawCamera):
        return _draw(opened, placed, question)
    if isinstance(question, MeasureCamera):
        return _measure(opened, question)
    if isinstance(question, RunCameras):
        return run_cameras(opened, question)
    progress = throttled(on_progress, _PROGRESS_PERIOD)
    return suggest_cameras(
        opened.env.env, question.space, question.envs, progress=progress, cancelled=cancelled
    )


def _draw_temporary(opened: OpenedTask, question: DrawCamera) -> Picture:
    """A picture in another size than the camera's, or by a camera that the env does not have."""
    settings, scale = question.settings, question.scale
    if settings is None or not 0 < scale <= LARGEST_SCALE:
        raise ValueError(f"a picture can have up to {LARGEST_SCALE} times its camera's size, not {scale}")
    size = (max(1, round(settings.width * scale)), max(1, round(settings.height * scale)))
    info = opened.description.camera(question.key)
    placement = Placement(settings, question.key[0], None if info is None else info.mount)
    picture = picture_of(opened.env.env, question.env, placement, question.poses, size)
    wanted = question.modalities
    return replace(
        picture,
        camera=question.key[1],
        depth=picture.depth if "depth" in wanted else None,
        segmentation=picture.segmentation if "segmentation" in wanted else None,
    )


def _draw(opened: OpenedTask, placed: PlacedCameras, question: DrawCamera) -> Picture:
    env, key = opened.env.env, question.key
    if question.scale != 1.0 or opened.description.camera(key) is None:
        return _draw_temporary(opened, question)
    before = placed.settings(key)
    if question.settings is not None:
        placed.place(env, key, question.settings)
    try:
        info = opened.description.camera(key)
        gives = question.modalities if info is None else info.modalities
        wanted = tuple(m for m in question.modalities if m in gives)
        return take_pictures(env, question.env, [(key[1], key[0], wanted)], question.poses)[0]
    finally:
        if question.settings is not None:
            placed.place(env, key, before)


def _measure(opened: OpenedTask, question: MeasureCamera) -> CameraReport:
    env = opened.env.env
    placement = placement_of(env, question.key, question.env, question.settings)
    size = small_size(placement.settings.width, placement.settings.height, REPORT_SIDE)
    return measure_placement(env, question.env, placement, question.poses, size)


# --- the hooks of another text ---------------------------------------------------------------------


def run_cameras(opened: OpenedTask, question: RunCameras) -> HookCameras:
    """Call the camera hooks on the live env, which has the new text's classes meanwhile.

    Raises:
        TaskError: the text does not load, or a hook fails.
    """
    file, env, found = opened.loaded.file, opened.env.env, list[HookCameras]()
    if file is None:
        raise ValueError("the task has no file")
    loaded = load_task(reference_to_class(question.task, file, opened.loaded.chosen), source=question.texts)
    try:
        with (
            blamed("build", loaded, opened.env),
            _with_classes_of(env, opened.loaded, loaded, question.texts),
        ):
            undone(env, lambda: found.append(run_hooks(env, question.texts)))
    finally:
        undo_load(loaded)
    return found[0]


@contextmanager
def _with_classes_of(
    env: Any, before: LoadedTask, after: LoadedTask, texts: Mapping[str, str]
) -> Iterator[None]:
    """Give the env and its robots the new text's classes, and the attributes that its constructors set, within this."""
    agents = [] if env.agent is None else getattr(env.agent, "agents", [env.agent])
    classes = [(agent, type(agent)) for agent in agents]
    task, kept = maniskill_private.task_class(env), [(owner, dict(vars(owner))) for owner in (env, *agents)]
    try:
        put_class(env, after.cls)
        for agent, cls in classes:
            module = sys.modules.get(cls.__module__)
            if getattr(module, "__file__", None) in texts:
                agent.__class__ = getattr(module, cls.__qualname__, cls)
        for owner, _ in kept:
            for name, value in _changed_attributes(before.source, texts, owner).items():
                vars(owner)[name] = value
        yield
    finally:
        put_class(env, task)
        for agent, cls in classes:
            agent.__class__ = cls
        for owner, names in kept:
            vars(owner).clear()
            vars(owner).update(names)


def _changed_attributes(before: Mapping[str, str], after: Mapping[str, str], owner: Any) -> dict[str, Any]:
    """The attributes of an object that the new text sets to another value, with that value.

    A live env has its attributes from the text that built it, and a camera's pose may depend on one.
    """
    old, new = Project(before), Project(after)
    edited = [path for path, text in after.items() if before.get(path) != plain_line_ends(text)]
    named = {n.attr for path in edited for n in new.file(path).nodes if isinstance(n, ast.Attribute)}
    found: dict[str, Any] = {}
    for name in named & vars(owner).keys():
        was, stores = old.attribute_stores(name), new.attribute_stores(name)
        if len(was) != 1 or len(stores) != 1 or was[0].value is None or stores[0].value is None:
            continue
        if ast.dump(was[0].value) != ast.dump(stores[0].value):
            path = stores[0].file.path
            code = compile(ast.Expression(stores[0].value), path, "eval")
            found[name] = eval(code, vars(module_of(path)), {"self": owner})
    return found
