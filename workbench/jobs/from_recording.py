"""From an episode that was read to what an env needs to stand in it: the run, the task, the options.

A recording names its task by id and by file, and holds the text that it was made with. Which of these is opened
is a choice: today's code of it, that a person is about to try on an old situation; or the recorded text, to see again
what happened. The text is written into a folder of its own, which goes when whoever opened it is done; so it can be
looked at, even edited, and nobody's file is touched. What lay beside the file and is no Python (meshes, say) is
not in a recording, but named there: where it still lies beside the task it is linked into that folder, as it is today.

Whoever goes live from a recording, or has it judged again, wants to know what of the task is another now, by name:
``CUBE_HALF_SIZE, evaluate``. Lines would say too much (comments, layout, what was moved); so both texts are compared
symbol by symbol, as a save is, and what changed is named as its author calls it.
"""

from __future__ import annotations

import ast
import shutil
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path, PurePath

import numpy as np

from workbench.authoring.loading.copy_task import registrations_in
from workbench.authoring.loading.modules import read_source
from workbench.authoring.loading.reference import RecordedTask
from workbench.authoring.loading.task_content import CannotRead, read_text, source_hash
from workbench.authoring.reload.call_graph import TwoVersions
from workbench.core.capture.recorded_run import HOW_IT_IS_RUN, RecordedRun
from workbench.jobs.task import TaskDescription, TaskOptions
from workbench.recording.episode.episode import Episode, EpisodeInfo
from workbench.recording.episode.side_files import folder_of, side_file_path


class NoText(ValueError):
    """The text of the task's own file is not among them."""


def below_one_folder(main: str, source: Mapping[str, str]) -> tuple[str, dict[str, str]]:
    """The name of the task's own file, and all texts by name. None of the names leads out of the folder: a recording is
    somebody else's file.

    Raises:
        NoText
    """
    names = {path: PurePath(path) for path in source}
    # As it was recorded every path is absolute; as it is read, as seen from the main file's folder.
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
        raise NoText("this recording does not hold the text of its task's own file")
    return chosen, found


def version_of(info: EpisodeInfo) -> str:
    """`source_hash` of the text that a recording holds, and not what it says of it; empty where it holds none."""
    try:
        _, texts = below_one_folder(info.source_file or "", info.source)
    except NoText:
        return ""
    return source_hash(texts, Path())


MOST_NAMED = 4
LOOK_EVERY = 2.0
"""Seconds between two looks at the files."""


def changed_since(
    then_file: str | None, then: Mapping[str, str], now_file: str | None, now: Mapping[str, str]
) -> str:
    """The symbols that differ; empty where none does, or where that cannot be said.

    Args:
        then_file, now_file: of the task.
        then, now: texts by path, of that file and the modules beside it.
    """
    if then_file is None or now_file is None:
        return ""
    try:
        (old_main, old), (new_main, new) = below_one_folder(then_file, then), below_one_folder(now_file, now)
    except NoText:
        return ""
    # It may be called otherwise now, a copy say; it is the task all the same.
    old = {new_main if name == old_main else name: text for name, text in old.items()}
    if old == new:
        return ""
    try:
        changed = TwoVersions(old, new).changed
    except (SyntaxError, ValueError, RecursionError):
        return ""
    names = list(dict.fromkeys(_called(path, name, new_main) for path, name in changed))
    more = f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else ""
    return ", ".join(names[:MOST_NAMED]) + more


def changed_on_disk(info: EpisodeInfo) -> str:
    """The same of the file that a recording names, as it is now, and of those beside it that it was recorded with."""
    file = None if info.source_file is None else Path(info.source_file)
    if file is None or not file.is_absolute() or not file.is_file():
        return ""
    try:
        _, then = below_one_folder(info.source_file or "", info.source)
    except NoText:
        return ""
    now = {}
    for name in then:
        path = file.parent / name
        if path.is_file():
            try:
                now[str(path)] = read_source(path)
            except (OSError, SyntaxError):
                return ""
    return changed_since(info.source_file, info.source, str(file), now)


class ChangesOnDisk:
    """`changed_on_disk` for who asks many times a second."""

    def __init__(self, look_every: float = LOOK_EVERY) -> None:
        self._look_every = look_every
        self._known: tuple[str, float, str] | None = None

    def of(self, info: EpisodeInfo) -> str:
        now = time.monotonic()
        if self._known is None or self._known[0] != info.id or now - self._known[1] > self._look_every:
            self._known = info.id, now, changed_on_disk(info)
        return self._known[2]


def _called(path: str, name: str, main: str) -> str:
    short = name.rpartition(".")[2].strip("()")
    return short if path == main else f"{short} of {PurePath(path).name}"


_IMPORTED = (".py", ".pyc", ".pyo", ".so", ".pyd", ".pth", ".zip", ".egg")
"""Ends of the names of files that Python imports or reads at an import."""


class CannotEnterRecording(ValueError):
    """The recording cannot be gone into; the message says why, and what to do."""


def run_of(episode: Episode, state: int | None = None) -> RecordedRun:
    """What of an episode is lived through again, up to `state`; to its end if None.

    Raises:
        CannotStepIn: it has no such state.
    """
    if state is not None and not 0 <= state <= episode.length:
        raise CannotEnterRecording(f"this episode has states 0 to {episode.length}, and not {state}")
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
        raise CannotEnterRecording("this recording does not hold the text of its task")
    try:
        main, texts = below_one_folder(info.source_file, info.source)
    except NoText as error:
        raise CannotEnterRecording(str(error)) from error
    folder = Path(tempfile.mkdtemp(prefix="workbench-recorded-"))
    try:
        for name, text in texts.items():
            path = folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, encoding="utf-8")
        _link_side_files(info, folder)
    except OSError as error:
        shutil.rmtree(folder, ignore_errors=True)
        raise CannotEnterRecording(f"the recorded text cannot be written: {error}") from error
    name = _class_of(texts[main], info.task)
    return folder, str(folder / main) if name is None else f"{folder / main}:{name}"


def _link_side_files(info: EpisodeInfo, folder: Path) -> None:
    """Those that are there; that one is not, or is another now, is said where the recorded text is offered."""
    for name in info.side_files:
        if name.endswith(_IMPORTED):
            continue  # it could be imported, and is none of the texts that were agreed to
        there, here = side_file_path(folder_of(info.source_file), name), side_file_path(folder, name)
        if there is not None and here is not None and there.is_file() and not here.exists():
            here.parent.mkdir(parents=True, exist_ok=True)
            here.symlink_to(there)


def _class_of(text: str, env_id: str) -> str | None:
    """The class that is registered under, or has, this name; None if there is none."""
    try:
        tree = ast.parse(text)
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        return None
    for cls, _, said in registrations_in(tree):
        if isinstance(said, ast.Constant) and said.value == env_id:
            return cls.name
    return (
        env_id if any(isinstance(node, ast.ClassDef) and node.name == env_id for node in tree.body) else None
    )


def _is_installed(file: Path) -> bool:
    """Whether it is a file of ManiSkill, or of another installed package: that is opened by its id."""
    if {"site-packages", "dist-packages"} & set(file.parts):
        return True
    spec = find_spec("mani_skill")  # does not import it
    folders = [] if spec is None else list(spec.submodule_search_locations or [])
    return any(file.is_relative_to(folder) for folder in folders)
