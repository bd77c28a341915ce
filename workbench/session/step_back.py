"""From an episode that was read to what an env needs to stand in it: the run, the task, the options.

A recording names its task by id and by file, and holds the text that it was made with. Which of these is opened
is a choice: today's code of it, that a person is about to try on an old situation; or the recorded text, to see again
what happened. The text is written into a folder of its own, which goes when whoever opened it is done; so it can be
looked at, even edited, and nobody's file is touched. What lay beside the file and is no Python (meshes, say) is
not in a recording, but named there: where it still lies beside the task it is linked into that folder, as it is today.
"""

from __future__ import annotations

import ast
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from workbench.authoring.reference import RecordedTask
from workbench.authoring.task_content import CannotRead, read_text
from workbench.core.env_kwargs import HOW_IT_IS_RUN
from workbench.core.recorded_run import RecordedRun
from workbench.recording.episode import Episode, EpisodeInfo
from workbench.recording.side_files import folder_of, place_of
from workbench.session.messages import TaskDescription, TaskOptions
from workbench.session.recorded_text import NoText, below_one_folder

_IMPORTED = (".py", ".pyc", ".pyo", ".so", ".pyd", ".pth", ".zip", ".egg")
"""Ends of the names of files that Python imports or reads at an import."""


class CannotStepIn(ValueError):
    """The recording cannot be gone into; the message says why, and what to do."""


def run_of(episode: Episode, state: int | None = None) -> RecordedRun:
    """What of an episode is lived through again, up to `state`; to its end if None.

    Raises:
        CannotStepIn: it has no such state.
    """
    if state is not None and not 0 <= state <= episode.length:
        raise CannotStepIn(f"this episode has states 0 to {episode.length}, and not {state}")
    info = episode.info
    run = RecordedRun(
        name=name_of(info),
        seed=info.seed,
        reset_options=dict(info.reset_options),
        action=np.asarray(episode.action, np.float32),
        env_states={name: np.asarray(rows) for name, rows in episode.env_states.items()},
        evaluate=dict(episode.evaluate),
        reward=np.asarray(episode.reward, np.float32),
    )
    return run if state is None else run.until(state)


def name_of(info: EpisodeInfo) -> str:
    """What a person calls the episode."""
    return f"{info.task}, seed {info.seed}" if info.seed >= 0 else info.task


def why_not_into(task: TaskDescription, info: EpisodeInfo) -> str:
    """Why an episode cannot be gone into with the task that is open; empty where it can."""
    if task.env_id == info.task:
        return ""
    return f"it is an episode of {info.task}, and {task.env_id} is open"


def reference_of(info: EpisodeInfo) -> RecordedTask:
    """Today's code of a recording's task. What of it may be opened is for `Clearances` to say.

    Its file where that is still there, with the class where the file has several; else the id, which may be one of
    ManiSkill's own.
    """
    file = None if info.source_file is None else Path(info.source_file)
    if (
        file is None
        or not file.is_absolute()
        or file.suffix != ".py"
        or not file.is_file()
        or _is_installed(file)
    ):
        return RecordedTask(info.task)
    try:
        return RecordedTask(info.task, str(file), _class_of(read_text(file), info.task))
    except CannotRead:
        return RecordedTask(info.task, str(file))


def class_in(file: Path, env_id: str) -> str | None:
    """What would be opened for this task of this file; None if the file has no such task, or cannot be read."""
    try:
        name = _class_of(read_text(file), env_id)
    except CannotRead:
        return None
    return None if name is None else f"{file}:{name}"


def options_of(info: EpisodeInfo, num_envs: int, base: TaskOptions | None = None) -> TaskOptions:
    """How the recording's task is made: with its own robot, modes and control."""
    kwargs = dict(info.env_kwargs)
    if info.control_mode is not None:
        kwargs.setdefault("control_mode", info.control_mode)
    for name in (*HOW_IT_IS_RUN, "human_render_camera_configs"):
        kwargs.pop(name, None)
    base = base or TaskOptions()
    return replace(base, num_envs=num_envs, seed=max(info.seed, 0), env_kwargs=kwargs)


@contextmanager
def recorded_source(info: EpisodeInfo) -> Iterator[str]:
    """The task as it was recorded, in a folder that is removed at the end; what is to be opened.

    Raises:
        CannotStepIn: the recording holds no text, or the folder cannot be written.
    """
    folder, reference = write_source(info)
    try:
        yield reference
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def write_source(info: EpisodeInfo) -> tuple[Path, str]:
    """A fresh folder with the recorded text, to be removed by the caller, and what is to be opened of it.

    Raises:
        CannotStepIn: as of `recorded_source`.
    """
    if not info.source or info.source_file is None:
        raise CannotStepIn("this recording does not hold the text of its task")
    try:
        main, texts = below_one_folder(info.source_file, info.source)
    except NoText as error:
        raise CannotStepIn(str(error)) from error
    folder = Path(tempfile.mkdtemp(prefix="workbench-recorded-"))
    try:
        for name, text in texts.items():
            path = folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, encoding="utf-8")
        _link_side_files(info, folder)
    except OSError as error:
        shutil.rmtree(folder, ignore_errors=True)
        raise CannotStepIn(f"the recorded text cannot be written: {error}") from error
    name = _class_of(texts[main], info.task)
    return folder, str(folder / main) if name is None else f"{folder / main}:{name}"


def _link_side_files(info: EpisodeInfo, folder: Path) -> None:
    """Those that are there; that one is not, or is another now, is said where the recorded text is offered."""
    for name in info.side_files:
        if name.endswith(_IMPORTED):
            continue  # it could be imported, and is none of the texts that were agreed to
        there, here = place_of(folder_of(info.source_file), name), place_of(folder, name)
        if there is not None and here is not None and there.is_file() and not here.exists():
            here.parent.mkdir(parents=True, exist_ok=True)
            here.symlink_to(there)


def _class_of(text: str, env_id: str) -> str | None:
    """The class that is registered under, or has, this name; None if there is none."""
    try:
        tree = ast.parse(text)
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        return None
    classes = [node for node in tree.body if isinstance(node, ast.ClassDef)]
    for node in classes:
        if any(_registers(decorator, env_id) for decorator in node.decorator_list):
            return node.name
    return env_id if any(node.name == env_id for node in classes) else None


def _registers(decorator: ast.expr, env_id: str) -> bool:
    """Whether it is ``@register_env("this id", ...)``."""
    if not isinstance(decorator, ast.Call):
        return False
    called = decorator.func
    name = called.attr if isinstance(called, ast.Attribute) else getattr(called, "id", "")
    values = [*decorator.args[:1], *(k.value for k in decorator.keywords if k.arg == "uid")]
    return name == "register_env" and any(isinstance(v, ast.Constant) and v.value == env_id for v in values)


def _is_installed(file: Path) -> bool:
    """Whether it is a file of ManiSkill, or of another installed package: that is opened by its id."""
    if {"site-packages", "dist-packages"} & set(file.parts):
        return True
    spec = find_spec("mani_skill")  # does not import it
    folders = [] if spec is None else list(spec.submodule_search_locations or [])
    return any(file.is_relative_to(folder) for folder in folders)
