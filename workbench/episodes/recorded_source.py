"""Task, options, source and run of a recorded episode, and what has changed in its source since the
recording."""

from __future__ import annotations

import ast
import os
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path, PurePath

import numpy as np

from workbench.envs.recorded_run import RUN_KEYWORDS, RecordedRun
from workbench.episodes.episode import Episode, EpisodeInfo
from workbench.episodes.side_files import folder_of, side_file_path
from workbench.machine.library_files import is_installed
from workbench.machine.parse_python import parse_python
from workbench.task.call_graph import TwoVersions
from workbench.task.content import CannotRead, read_text, source_hash
from workbench.task.copy import registrations_in
from workbench.task.description import TaskDescription, TaskOptions
from workbench.task.modules import read_source
from workbench.task.reference import RecordedTask


class NoRecordedSource(ValueError):
    """The source of the task's own file is missing."""


def relative_sources(main: str, source: Mapping[str, str]) -> tuple[str, dict[str, str]]:
    """(name of the task's own file, all texts by name). The names are relative to the task's folder and never
    lead out of it, because recordings are untrusted.

    Raises:
        NoRecordedSource: the source of the task's own file is missing.
    """
    names = {path: PurePath(path) for path in source}
    # Paths are absolute when recorded, and relative to the main file's folder when read.
    folder = PurePath(main).parent
    found: dict[str, str] = {}
    chosen = ""
    for path, pure in names.items():
        relative = pure.relative_to(folder) if pure.is_absolute() and pure.is_relative_to(folder) else pure
        if relative.is_absolute() or ".." in relative.parts or not relative.parts:
            relative = PurePath(pure.name)
        found[str(relative)] = source[path]
        if path == main or (pure.name == PurePath(main).name and not chosen):
            chosen = str(relative)
    if not chosen:
        raise NoRecordedSource("this recording does not hold the text of its task's own file")
    return chosen, found


def recorded_version(info: EpisodeInfo) -> str:
    """`source_hash` computed from the recorded text, instead of the recorded hash; empty if there is no text."""
    try:
        _, texts = relative_sources(info.source_file or "", info.source)
    except NoRecordedSource:
        return ""
    return source_hash(texts, Path())


MAX_NAMES = 4


def changed_since(
    then_file: str | None, then: Mapping[str, str], now_file: str | None, now: Mapping[str, str]
) -> str:
    """Names of the symbols that differ, such as ``CUBE_HALF_SIZE, evaluate``; empty if none differs or a text
    is missing.

    Compares symbol by symbol, as the reload after a save does: comparing lines would also report comments,
    layout and moved code.

    Args:
        then_file, now_file: the task's file.
        then, now: texts by path, of that file and the modules in its folder.
    """
    if then_file is None or now_file is None:
        return ""
    try:
        (old_main, old), (new_main, new) = relative_sources(then_file, then), relative_sources(now_file, now)
    except NoRecordedSource:
        return ""
    # A copy of the file may have another name.
    old = {new_main if name == old_main else name: text for name, text in old.items()}
    if old == new:
        return ""
    try:
        changed = TwoVersions(old, new).changed
    except (SyntaxError, ValueError, RecursionError):
        return ""
    names = list(dict.fromkeys(_symbol_text(path, name, new_main) for path, name in changed))
    more = f" and {len(names) - MAX_NAMES} more" if len(names) > MAX_NAMES else ""
    return ", ".join(names[:MAX_NAMES]) + more


def changed_on_disk(info: EpisodeInfo) -> str:
    """`changed_since` for the recording and the current state of its files on disk."""
    file = None if info.source_file is None else Path(info.source_file)
    if file is None or not file.is_absolute() or not os.path.isfile(file):
        return ""
    try:
        _, then = relative_sources(info.source_file or "", info.source)
    except NoRecordedSource:
        return ""
    now = {}
    for name in then:
        path = file.parent / name
        # Not `Path.is_file`, which raises for an invalid file name.
        if os.path.isfile(path):
            try:
                now[str(path)] = read_source(path)
            except (OSError, SyntaxError):
                return ""
    return changed_since(info.source_file, info.source, str(file), now)


def _symbol_text(path: str, name: str, main: str) -> str:
    short = name.rpartition(".")[2].strip("()")
    return short if path == main else f"{short} of {PurePath(path).name}"


_IMPORTED = (".py", ".pyc", ".pyo", ".so", ".pyd", ".pth", ".zip", ".egg")
"""Suffixes of files that Python reads during an import."""


class CannotEnterRecording(ValueError):
    """A recording cannot be entered; the message gives the reason and advice."""


def run_of(episode: Episode, state: int | None = None) -> RecordedRun:
    """The part of an episode to replay, up to `state`; the whole episode if `state` is None.

    Raises:
        CannotEnterRecording: it has no such state.
    """
    if state is not None and not 0 <= state <= episode.length:
        raise CannotEnterRecording(f"this episode has states 0 to {episode.length}, not {state}")
    info = episode.info
    run = RecordedRun(
        name=episode_name(info),
        seed=info.seed,
        reset_options=dict(info.reset_options),
        action=np.asarray(episode.action, np.float32),
        env_states={name: np.asarray(rows) for name, rows in episode.env_states.items()},
        evaluate=dict(episode.evaluate),
        reward=np.asarray(episode.reward if info.has_reward else np.zeros(0), np.float32),
    )
    return run if state is None else run.until(state)


def episode_name(info: EpisodeInfo) -> str:
    """The episode's name on the page."""
    return f"{info.task}, seed {info.seed}" if info.seed >= 0 else info.task


def why_not_enter(task: TaskDescription, info: EpisodeInfo) -> str:
    """Why an episode cannot be entered with the open task; empty if it can."""
    if task.env_id == info.task:
        return ""
    return f"it is an episode of {info.task}, and {task.env_id} is open"


def reference_of(info: EpisodeInfo) -> RecordedTask:
    """Reference to the current code of a recording's task; `Clearances` decides whether it may be opened.

    If the task's file still exists, the reference names the file and the class; otherwise it has only the id,
    which may be the id of one of ManiSkill's own tasks.
    """
    file = None if info.source_file is None else Path(info.source_file)
    if (
        file is None
        or not file.is_absolute()
        or file.suffix != ".py"
        or not os.path.isfile(file)
        or is_installed(str(file))
    ):
        return RecordedTask(info.task)
    try:
        return RecordedTask(info.task, str(file), _class_of(read_text(file), info.task))
    except CannotRead:
        return RecordedTask(info.task, str(file))


def class_in(file: Path, env_id: str) -> str | None:
    """``file.py:Class`` of this task in a file; None if the file has no such task, or cannot be read."""
    try:
        name = _class_of(read_text(file), env_id)
    except CannotRead:
        return None
    return None if name is None else f"{file}:{name}"


def options_of(info: EpisodeInfo, num_envs: int, base: TaskOptions | None = None) -> TaskOptions:
    """Options that open the recording's task with the recorded robot and modes."""
    kwargs = dict(info.env_kwargs)
    # Older versions recorded the control modes of several robots as the text of a dict.
    if info.control_mode is not None and info.control_mode.isidentifier():
        kwargs.setdefault("control_mode", info.control_mode)
    for name in (*RUN_KEYWORDS, "human_render_camera_configs"):
        kwargs.pop(name, None)
    base = base or TaskOptions()
    return replace(base, num_envs=num_envs, seed=max(info.seed, 0), env_kwargs=kwargs, pictures=info.pictures)


@contextmanager
def recorded_source(info: EpisodeInfo) -> Iterator[str]:
    """Context manager that writes the recorded source to a temporary folder; yields the reference to open.

    Raises:
        CannotEnterRecording: the recording holds no text, or the folder cannot be written.
    """
    folder, reference = write_source(info)
    try:
        yield reference
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def write_source(info: EpisodeInfo) -> tuple[Path, str]:
    """Write the recorded source to a new folder, which the caller removes; returns the folder and the reference to open.

    Other files of the task's folder, such as meshes, are not in a recording, but their names are; the files
    that still exist are linked into the new folder, in their current state.

    Raises:
        CannotEnterRecording: as `recorded_source` does.
    """
    if not info.source or info.source_file is None:
        raise CannotEnterRecording("this recording does not hold the text of its task")
    try:
        main, texts = relative_sources(info.source_file, info.source)
    except NoRecordedSource as error:
        raise CannotEnterRecording(str(error)) from error
    folder = Path(tempfile.mkdtemp(prefix="workbench-recorded-"))
    try:
        for name, text in texts.items():
            path = folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, encoding="utf-8")
        _link_side_files(info, folder)
    except (OSError, ValueError) as error:  # a null byte in a name
        shutil.rmtree(folder, ignore_errors=True)
        raise CannotEnterRecording(f"the recorded text cannot be written: {error}") from error
    name = _class_of(texts[main], info.task)
    return folder, str(folder / main) if name is None else f"{folder / main}:{name}"


def _link_side_files(info: EpisodeInfo, folder: Path) -> None:
    """Link the side files that exist. Where the page offers the recorded text, it warns of missing and
    changed side files."""
    for name in info.side_files:
        if name.endswith(_IMPORTED):
            continue  # importable, but not among the texts that the person trusted
        there, here = side_file_path(folder_of(info.source_file), name), side_file_path(folder, name)
        if there is not None and here is not None and os.path.isfile(there) and not os.path.lexists(here):
            here.parent.mkdir(parents=True, exist_ok=True)
            here.symlink_to(there)


def _class_of(text: str, env_id: str) -> str | None:
    """Name of the class that is registered under the id `env_id`, else of the class with that name; None if
    there is neither."""
    try:
        tree = parse_python(text)
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        return None
    for cls, _, id_node in registrations_in(tree):
        if isinstance(id_node, ast.Constant) and id_node.value == env_id:
            return cls.name
    return (
        env_id if any(isinstance(node, ast.ClassDef) and node.name == env_id for node in tree.body) else None
    )
