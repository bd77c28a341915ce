"""The way of a camera's change into the author's file: planned, shown, written, reloaded, compared, taken back.

What was written is believed only when it was seen: the reload builds the camera anew, and the config that comes out
is compared number by number with what the edit was to say. A difference is told as the error that it is.

Plans are made of the files as they are on disk at that moment, since that is what is edited; the worker runs them, and
what comes of the plan, and if they say something else of the camera than the env has, the plan is refused. None of
this runs on the page's thread, and nothing here is thread-safe.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from workbench.authoring.camera_source import members
from workbench.authoring.camera_source.cameras import RunHooks
from workbench.authoring.camera_source.disk import SourceEdit, why_not_writable
from workbench.authoring.camera_source.hooks import HOOK_OF, snippet
from workbench.authoring.camera_source.plan import plan_edit
from workbench.authoring.loading.copy_task import CannotCopy, copy_task
from workbench.authoring.loading.modules import read_exactly
from workbench.authoring.source.text import RefusedEdit
from workbench.core.camera_data import CameraInfo, CameraKey, CameraSettings, differences, setting_text
from workbench.jobs.task import TaskDescription
from workbench.session.cameras.view import Change, Wish, Writing

SENTENCES: dict[Change, tuple[str, str, str]] = {
    "edit": ("This changes {old} in {file}.", "{old} is written to {file}, and the new env has it.", ""),
    "add": ("This adds {new} to {file}.", "{old} is in {file}, and the env has it.", "{new} was not added."),
    "duplicate": (
        "This adds {new}, a copy of {old}, to {file}.",
        "{new} is in {file}, a copy of {old}.",
        "{new} was not added.",
    ),
    "rename": (
        "This makes {old} {new} in {file}.",
        "{old} is {new} in {file} now.",
        "{old} was not renamed.",
    ),
    "remove": ("This takes {old} out of {file}.", "{old} is no longer in {file}.", "{old} was not removed."),
}
"""Of a change: what it would do, what it did, and what becomes of it when another plan comes in its place."""
PLANNED, DONE, LEFT = range(3)


def said(wish: Wish, when: int, file: str = "") -> str:
    """The sentence of `SENTENCES`."""
    return SENTENCES[wish.what][when].format(old=wish.key[1], new=wish.result[1], file=file)


def plan(task: TaskDescription, info: CameraInfo | None, wish: Wish, run: RunHooks) -> Writing:
    """The edit that fulfils a wish, or why there is none.

    Args:
        info: of the live camera; None where one is added.
        run: asks the worker.
    """
    placed = None if wish.what == "remove" else wish.settings
    text = "" if placed is None else snippet(wish.result[1], placed)
    elsewhere = "" if wish.what == "add" or info is None else _made_elsewhere(task, info)
    try:
        texts = _texts(task)
        if elsewhere and info is not None:
            edit = _made_of_a_parents(task, texts, info, wish, elsewhere, run)
        elif not task.source_files:
            where = "" if task.file is None else f" ({task.file})"
            raise RefusedEdit(
                f"{task.class_name} is installed{where}, and an installed file is not to be edited: copy the task into a "
                "folder of your own",
                text,
            )
        else:
            edit = _made(task, texts, info, wish, run)
        blocked = next(filter(None, (why_not_writable(change.file) for change in edit.changes)), None)
        if blocked is not None:
            raise RefusedEdit(blocked, text)
    except RefusedEdit as refused:
        can_copy = not elsewhere and _could_be_copied(task)
        ways = (
            " You can copy the text below into the file yourself." if refused.snippet and not can_copy else ""
        )
        if elsewhere and info is not None and (not task.source_files or _is_a_robots(info)):
            ways = " The text below is for a class of your own that inherits from it."
        message = f"Not written: {refused.reason}.{ways}"
        return Writing("refused", wish, None, refused.snippet, message, can_copy)
    message = f"{said(wish, PLANNED, edit.names)} Nothing is written yet."
    return Writing("planned", wish, edit, message=message)


def _made_elsewhere(task: TaskDescription, info: CameraInfo) -> str:
    """Why neither the task's file nor a copy of it holds this camera; empty where one of them may."""
    own = {Path(file).resolve() for file in (task.file, *task.source_files) if file is not None}
    if info.site is None or Path(info.site.file).resolve() in own:
        return ""
    owner = info.site.function.rpartition(".")[0] or "another file"
    brings = "the robot brings it, by" if _is_a_robots(info) else "it is made by"
    return f"{info.name} is not the task's own: {brings} {owner} ({info.site.file}, line {info.site.line})"


def _is_a_robots(info: CameraInfo) -> bool:
    return info.site is not None and info.site.function.rpartition(".")[2] == "_sensor_configs"


def _made_of_a_parents(
    task: TaskDescription, texts: dict[str, str], info: CameraInfo, wish: Wish, elsewhere: str, run: RunHooks
) -> SourceEdit:
    """A hook that puts another camera in place of a parent's, in the task's own class or to be copied."""
    if wish.settings is None or wish.what == "remove":
        raise RefusedEdit(elsewhere)
    (kind, _), (_, uid), site = wish.key, wish.result, info.site
    assert site is not None
    link = (info.mount or "").partition("/")[2]
    robot = "self.robot" if _is_a_robots(info) else "self.agent.robot"
    more = [f'mount={robot}.links_map["{link}"]'] if link else []
    if site.function.rpartition(".")[2] not in HOOK_OF.values():
        raise RefusedEdit(elsewhere, snippet(uid, wish.settings, more=more))
    whole = members.override_text(kind, uid, wish.settings, more)
    if wish.what != "edit" or task.file is None or task.file not in texts:
        raise RefusedEdit(elsewhere, whole)
    if info.varies:
        reason = (
            f"{elsewhere}; the task's own code moves it besides, so one pose in the file would not place it"
        )
        raise RefusedEdit(reason, whole)
    return members.plan_override(texts, task.file, task.class_name, kind, uid, wish.settings, site, run, more)


def _could_be_copied(task: TaskDescription) -> bool:
    """Whether the task's file is one that is not to be edited, and is all that the task is made of."""
    if task.file is None or len(task.source_files) > 1:
        return False
    return not task.source_files or why_not_writable(task.file) is not None


def copy(task: TaskDescription, folder: Path) -> tuple[Path | None, Writing]:
    """Copy the task's file into a folder; the copy, or None, and what is said of it."""
    if task.file is None:
        return None, Writing("refused", message="Not copied: the task has no file.")
    try:
        made = copy_task(Path(task.file), folder)
    except CannotCopy as reason:
        return None, Writing("refused", message=f"Not copied: {reason}.")
    named = ", ".join(f"{new} for {old}" for old, new in made.ids)
    ids = f" It registers {named}." if named else ""
    return made.file, Writing(message=f"The task is copied to {made.file}, which is being opened.{ids}")


def _made(
    task: TaskDescription, texts: dict[str, str], info: CameraInfo | None, wish: Wish, run: RunHooks
) -> SourceEdit:
    kind, uid = wish.key
    if wish.what == "add":
        assert wish.settings is not None
        file = task.file or task.source_files[0]
        return members.plan_add(texts, file, task.class_name, wish.key, wish.settings, run)
    if info is None or info.settings is None:
        raise RefusedEdit(f"there is no {kind} camera {uid!r} whose settings are known")
    if wish.what == "remove":
        return members.plan_remove(texts, wish.key, run)
    if wish.what == "rename":
        return members.plan_rename(texts, wish.key, wish.name, info.settings, run)
    if wish.what == "duplicate":
        return members.plan_duplicate(texts, wish.key, wish.name, info.settings, run)
    assert wish.settings is not None
    if info.varies:
        raise RefusedEdit(
            f"the task's own code moves {uid!r} (it is randomised, or moved after it was made), so one pose in the "
            "file would not place it",
            snippet(uid, wish.settings),
        )
    return plan_edit(texts, wish.key, info.settings, wish.settings, run)


def _texts(task: TaskDescription) -> dict[str, str]:
    """The author's files as they are on disk, with the line ends that they have. Raises RefusedEditEdit."""
    texts: dict[str, str] = {}
    for path in task.source_files:
        try:
            texts[path] = read_exactly(path)[1]
        except (OSError, SyntaxError) as error:
            said = error.msg if isinstance(error, SyntaxError) else error.strerror
            raise RefusedEdit(f"{path} cannot be read: {said}") from error
    return texts


def was_before(edit: SourceEdit) -> str:
    return "is as it was" if len(edit.changes) == 1 else "are as they were"


def mismatch(wish: Wish, infos: Mapping[CameraKey, CameraInfo], wanted: CameraSettings | None) -> str:
    kind, name = wish.result
    info = infos.get(wish.result)
    if wish.what == "remove":
        return f"The new env still has the {kind} camera {name}." if info is not None else ""
    if info is None or info.settings is None:
        return f"The new env has no {kind} camera {name}."
    if wish.what == "rename" and wish.key in infos:
        return f"The new env still has the {kind} camera {wish.key[1]}."
    numbers = "" if wanted is None else not_as_written(wanted, info.settings)
    return f"The new env's {name} is not what was written ({numbers})." if numbers else ""


def not_as_written(wanted: CameraSettings, now: CameraSettings) -> str:
    """The numbers that are not as wanted, with both; empty where all are."""

    def said(settings: CameraSettings, what: str) -> str:
        return setting_text(vars(settings)["quaternion" if what == "orientation" else what])

    apart = differences(wanted, now)
    return "; ".join(f"{what}: {said(now, what)}, not {said(wanted, what)}" for what in apart)
