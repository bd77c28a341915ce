"""Plans the edit of the author's file that a request of the studio asks for."""

from __future__ import annotations

from pathlib import Path

from workbench.cameras.edit import members
from workbench.cameras.edit.hook_cameras import RunHooks
from workbench.cameras.edit.hook_text import HOOK_OF, snippet
from workbench.cameras.edit.plan import plan_edit
from workbench.cameras.edit_state import PLANNED, change_text
from workbench.cameras.view import EditRequest, EditState
from workbench.envs.camera_data import CameraInfo
from workbench.source.parsed import RefusedEdit
from workbench.task.copy import CannotCopy, copy_task
from workbench.task.description import TaskDescription
from workbench.task.modules import read_exactly
from workbench.task.write_edits import SourceEdit, why_not_writable


def plan(task: TaskDescription, info: CameraInfo | None, request: EditRequest, run: RunHooks) -> EditState:
    """Plan the edit of the files on disk for a request, or report why there is none.

    The worker runs the edited files too, and a plan that gives the camera other settings than requested is
    refused. Not thread-safe, and too slow for the page's thread.

    Args:
        info: description of the live camera; None for a camera to add.
        run: runs the hooks in the worker.
    """
    placed = None if request.what == "remove" else request.settings
    text = "" if placed is None else snippet(request.result[1], placed)
    owner_text = "" if request.what == "add" or info is None else _owner_text(task, info)
    try:
        texts = texts_on_disk(task)
        if owner_text and info is not None:
            edit = _override_edit(task, texts, info, request, owner_text, run)
        elif not task.source_files:
            where = "" if task.file is None else f" ({task.file})"
            raise RefusedEdit(
                f"{task.class_name} is installed{where}, and installed files are not edited: copy the task into a "
                "folder of your own",
                text,
            )
        else:
            edit = _own_edit(task, texts, info, request, run)
        blocked = next(filter(None, (why_not_writable(change.file) for change in edit.changes)), None)
        if blocked is not None:
            raise RefusedEdit(blocked, text)
    except RefusedEdit as refused:
        can_copy = not owner_text and _can_be_copied(task)
        advice = (
            " You can copy the text below into the file yourself." if refused.snippet and not can_copy else ""
        )
        if (
            refused.snippet
            and owner_text
            and info is not None
            and (not task.source_files or _is_robot_camera(info))
        ):
            advice = " The text below is for a subclass of your own."
        message = f"Not written: {refused.reason}.{advice}"
        return EditState("refused", request, None, refused.snippet, message, can_copy)
    message = f"{change_text(request, PLANNED, edit.names)} Nothing is written yet."
    return EditState("planned", request, edit, message=message)


def _owner_text(task: TaskDescription, info: CameraInfo) -> str:
    """Reason why neither the task's file nor a copy of it contains this camera; empty if one of the two may
    contain it."""
    own = {Path(file).resolve() for file in (task.file, *task.source_files) if file is not None}
    if info.site is None or Path(info.site.file).resolve() in own:
        return ""
    owner = info.site.function.rpartition(".")[0] or "another file"
    made = "the robot makes it, in" if _is_robot_camera(info) else "it is made by"
    return f"{info.name} is not the task's own: {made} {owner} ({info.site.file}, line {info.site.line})"


def _is_robot_camera(info: CameraInfo) -> bool:
    return info.site is not None and info.site.function.rpartition(".")[2] == "_sensor_configs"


def _override_edit(
    task: TaskDescription,
    texts: dict[str, str],
    info: CameraInfo,
    request: EditRequest,
    owner_text: str,
    run: RunHooks,
) -> SourceEdit:
    """The edit that adds a hook to the task's own class to replace an inherited camera. If the edit is
    refused, the user is offered text to copy: the hook, if a camera hook of the task makes the camera; else
    only the camera's config. A refused removal has no text to copy."""
    if request.settings is None or request.what == "remove":
        raise RefusedEdit(owner_text)
    (kind, _), (_, uid), site = request.key, request.result, info.site
    assert site is not None
    link = (info.mount or "").partition("/")[2]
    robot = "self.robot" if _is_robot_camera(info) else "self.agent.robot"
    more = [f'mount={robot}.links_map["{link}"]'] if link else []
    if site.function.rpartition(".")[2] not in HOOK_OF.values():
        raise RefusedEdit(owner_text, snippet(uid, request.settings, more=more))
    whole = members.override_text(kind, uid, request.settings, task.parse_cameras, more)
    if request.what != "edit" or task.file is None or task.file not in texts:
        raise RefusedEdit(owner_text, whole)
    if info.varies:
        reason = (
            f"{owner_text}; the task's own code also moves the camera, so one pose in the file would not "
            "place it"
        )
        raise RefusedEdit(reason, whole)
    return members.plan_override(
        texts, task.file, task.class_name, kind, uid, request.settings, site, run, task.parse_cameras, more
    )


def _can_be_copied(task: TaskDescription) -> bool:
    """Whether the task consists of one file that must not be edited."""
    if task.file is None or len(task.source_files) > 1:
        return False
    return not task.source_files or why_not_writable(task.file) is not None


def copy(task: TaskDescription, folder: Path) -> tuple[Path | None, EditState]:
    """Copy the task's file into a folder; returns the copy (None on failure) and the new state."""
    if task.file is None:
        return None, EditState("refused", message="Not copied: the task has no file.")
    try:
        made = copy_task(Path(task.file), folder)
    except CannotCopy as reason:
        return None, EditState("refused", message=f"Not copied: {reason}.")
    named = ", ".join(f"{new} for {old}" for old, new in made.ids)
    ids = f" It registers {named}." if named else ""
    return made.file, EditState(message=f"The task was copied to {made.file}; opening it.{ids}")


def _own_edit(
    task: TaskDescription, texts: dict[str, str], info: CameraInfo | None, request: EditRequest, run: RunHooks
) -> SourceEdit:
    kind, uid = request.key
    if request.what == "add":
        assert request.settings is not None
        file = task.file or task.source_files[0]
        return members.plan_add(texts, file, task.class_name, request.key, request.settings, run)
    if info is None or info.settings is None:
        raise RefusedEdit(f"the settings of the {kind} camera {uid!r} are not known")
    if request.what == "remove":
        return members.plan_remove(texts, request.key, run)
    if request.what == "rename":
        return members.plan_rename(texts, request.key, request.name, info.settings, run)
    if request.what == "duplicate":
        return members.plan_duplicate(texts, request.key, request.name, info.settings, run)
    assert request.settings is not None
    if info.varies:
        raise RefusedEdit(
            f"the task's own code moves {uid!r} (it is randomised, or moved after it was made), so one pose in the "
            "file would not place it",
            snippet(uid, request.settings),
        )
    return plan_edit(texts, request.key, info.settings, request.settings, run)


def texts_on_disk(task: TaskDescription) -> dict[str, str]:
    """The author's files on disk, with their own line endings. Raises RefusedEdit."""
    texts: dict[str, str] = {}
    for path in task.source_files:
        try:
            texts[path] = read_exactly(path)[1]
        except (OSError, SyntaxError) as error:
            reason = error.msg if isinstance(error, SyntaxError) else error.strerror
            raise RefusedEdit(f"{path} cannot be read: {reason}") from error
    return texts
