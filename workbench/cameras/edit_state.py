"""The part of the studio's state about edits of the author's file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from workbench.cameras.commands import CopyTask, DropCameraChange, RevertCameraChange, SaveCameraChange
from workbench.cameras.events import (
    ChangeFile,
    CopyToFolder,
    DrawNewCamera,
    EditFailed,
    EditWanted,
    FileChanged,
    FileNotChanged,
    FindPlan,
    NewCameraDrawn,
    PlanFound,
    StopJobs,
    StudioClosed,
    StudioEffect,
    TaskCopied,
)
from workbench.cameras.questions import DrawCamera
from workbench.cameras.state import Change, EditAsked, Edits, Studio, info_of
from workbench.cameras.view import EditKind, EditRequest, EditStage, EditState
from workbench.envs.camera_data import CameraInfo, CameraKey, CameraSettings, differences, setting_text
from workbench.live.run import Run
from workbench.page.command import Command, Refused
from workbench.source.parsed import plain_line_ends
from workbench.task.description import TaskDescription
from workbench.task.write_edits import SourceEdit

IN_FILE: tuple[EditStage, ...] = ("written", "checked", "mismatch")
"""Stages in which the change is in the file."""
_PREVIEW_PIXELS = 256
"""Shorter side of a new camera's preview."""
_STOP_DRAWING = StopJobs(("new camera",))
SENTENCES: dict[EditKind, tuple[str, str, str]] = {
    "edit": ("This changes {old} in {file}.", "{old}: saved to {file} and verified.", ""),
    "add": ("This adds {new} to {file}.", "{old}: added to {file} and verified.", "{new} was not added."),
    "duplicate": (
        "This adds {new}, a copy of {old}, to {file}.",
        "{new}, a copy of {old}: added to {file} and verified.",
        "{new} was not added.",
    ),
    "rename": (
        "This renames {old} to {new} in {file}.",
        "{old}: renamed to {new} in {file} and verified.",
        "{old} was not renamed.",
    ),
    "remove": (
        "This removes {old} from {file}.",
        "{old}: removed from {file} and verified.",
        "{old} was not removed.",
    ),
}
"""Sentences by kind of change: for the plan, for the finished change, and for a plan that is replaced by another."""
PLANNED, DONE, LEFT = range(3)
"""Index into an entry of `SENTENCES`."""


def change_text(request: EditRequest, when: int, file: str = "") -> str:
    """The sentence of `SENTENCES` for a change."""
    return SENTENCES[request.what][when].format(old=request.key[1], new=request.result[1], file=file)


def with_edits(studio: Studio, **values: Any) -> Studio:
    return replace(studio, edits=replace(studio.edits, **values))


def do_edit(studio: Studio, command: Command, run: Run) -> Change:
    """Carry out a command about the file."""
    match command:
        case SaveCameraChange():
            shown = studio.edits.shown
            if shown.stage != "planned" or _is_stale(studio, shown.request):
                raise Refused("Show the change first: only what you have read is saved.")
            return _ask(studio, command, run)
        case RevertCameraChange() | CopyTask():
            return _ask(studio, command, run)
        case DropCameraChange():
            return _drop(studio, run)
        case _:
            raise AssertionError(f"{command} is not in DOES")


def apply_to_edits(studio: Studio, event: object, run: Run) -> Change:
    """The studio after an event about the file. Edits are made one after another.

    Placements change only when the version with the edit is loaded.
    """
    match event:
        case EditWanted(request=request):
            if request.settings is None:
                event = EditWanted(replace(request, settings=studio.placements.now(request.key)))
            return _ask(studio, event, run)
        case PlanFound():
            return _plan_found(studio, event, run)
        case NewCameraDrawn(request=request, picture=picture) if request == studio.edits.shown.request:
            shown = replace(studio.edits.shown, picture=picture, drawing=False)
            return with_edits(studio, shown=shown), []
        case FileChanged():
            return _ended(studio, run)
        case FileNotChanged(reason=reason):
            shown, done = studio.edits.before
            stage = "refused" if shown.stage == "planned" else shown.stage
            shown = replace(shown, stage=stage, message=f"The file was not changed: {reason}.")
            return _ended(with_edits(studio, shown=shown, done=done), run)
        case TaskCopied(file=file, state=state):
            # Keep the request until the copy is loaded.
            studio = with_edits(
                studio,
                copied=file,
                shown=replace(state, request=studio.edits.shown.request),
                just_copied="" if file is None else f"This is your copy of the task, {file}.",
                done=studio.edits.done if file is None else (),  # those edits are in the original file
            )
            return _ended(studio, run)
        case EditFailed(error=error):
            problem = (
                f"A bug of the workbench ended the edit ({error}). Check the file; the Log has the traceback."
            )
            return _ended(replace(studio, problem=problem), run)
        case StudioClosed():
            return with_edits(studio, closed=True, waiting=()), []
    return studio, []


def _is_stale(studio: Studio, request: EditRequest | None) -> bool:
    """Whether the camera was moved since its change was planned."""
    if request is None or request.what == "add":
        return False
    now = studio.placements.now(request.key)
    return now is not None and now != request.settings


def _ask(studio: Studio, asked: EditAsked, run: Run) -> Change:
    """Queue an edit behind those that were requested earlier."""
    if studio.edits.closed:
        return studio, []
    studio = with_edits(
        studio,
        waiting=(*studio.edits.waiting, asked),
        shown=replace(studio.edits.shown, drawing=False),
    )
    studio, effects = _go_on(studio, run)
    return studio, [_STOP_DRAWING, *effects]


def _ended(studio: Studio, run: Run) -> Change:
    """Handle the end of the current edit."""
    return _go_on(with_edits(studio, busy=False), run)


def _go_on(studio: Studio, run: Run) -> Change:
    """Start the next edit, unless one is in progress."""
    effects: list[StudioEffect] = []
    while studio.edits.waiting and not studio.edits.busy:
        first, *rest = studio.edits.waiting
        studio, begun = _begin(with_edits(studio, waiting=tuple(rest)), first, run)
        effects += begun
    return studio, effects


def _begin(studio: Studio, asked: EditAsked, run: Run) -> Change:
    shown, task = studio.edits.shown, run.task
    match asked:
        case EditWanted(request=request) if task is not None:
            left = shown.request if shown.stage == "planned" else None
            # Clear the result of the previous request, but keep a written edit while its version is loading.
            shown = shown if shown.loading else EditState(request=request)
            find = FindPlan(request, task, info_of(run, request.key), run.running_load())
            return with_edits(studio, shown=shown, left=left, busy=True), [find]
        case SaveCameraChange() if shown.edit is not None and shown.stage == "planned":
            return _change_file(studio, shown.edit, "written", "Saved to {file}; loading it.")
        case RevertCameraChange() if shown.edit is not None and shown.stage in IN_FILE:
            return _change_file(studio, shown.edit, "undone", "Edit reverted in {file}; loading it.")
        case CopyTask() if task is not None and shown.can_copy:
            return with_edits(studio, busy=True), [CopyToFolder(task, studio.edits.folder)]
    return studio, []


def _change_file(studio: Studio, edit: SourceEdit, stage: EditStage, message: str) -> Change:
    edits = studio.edits
    # Set the stage before the file is written: the version with the edit may be loaded before the write is
    # reported as done.
    studio = _with_stage(studio, message.format(file=edit.names), stage, loading=True)
    done = edits.done[:-1] if stage == "undone" else (*edits.done, studio.edits.shown)
    studio = with_edits(studio, done=done, before=(edits.shown, edits.done), busy=True)
    return studio, [ChangeFile(edit, revert=stage == "undone")]


def _plan_found(studio: Studio, found: PlanFound, run: Run) -> Change:
    request, left, first = found.request, studio.edits.left, studio.edits.just_copied
    if left is not None and (left.what, left.key) != (request.what, request.key):
        first = change_text(left, LEFT)
    drawing = found.state.stage == "planned" and request.what == "add"
    message = f"{first} {found.state.message}".strip()
    shown = replace(found.state, message=message, drawing=drawing)
    studio, effects = _ended(with_edits(studio, shown=shown, just_copied=""), run)
    if not drawing or request.settings is None:
        return studio, effects
    moment, settings = run.shown_moment(), request.settings
    scale = min(1.0, _PREVIEW_PIXELS / min(settings.width, settings.height))
    question = DrawCamera(request.key, settings, moment.env, poses=moment.of(moment.env), scale=scale)
    return studio, [DrawNewCamera(request, question), *effects]


def _drop(studio: Studio, run: Run) -> Change:
    """Drop the shown plan, and show the newest edit in the file again. If an edit in the file is shown
    already, forget all edits; the file keeps them."""
    done = () if studio.edits.shown.stage in IN_FILE else studio.edits.done
    shown = done[-1] if done else EditState()
    studio = with_edits(studio, done=done, shown=shown, copied=None, just_copied="")
    if run.task is not None:
        studio, _ = edit_loaded(studio, run.task)  # the version with that edit may have loaded meanwhile
    return studio, [_STOP_DRAWING]


def edit_loaded(studio: Studio, task: TaskDescription) -> tuple[Studio, frozenset[CameraKey]]:
    """Compare the running version with the written or reverted edit.

    Returns:
        The studio, and the cameras that the edit changed; no cameras if the running version does not result
        from the edit.
    """
    request, edit = studio.edits.shown.request, studio.edits.shown.edit
    if request is None or edit is None or not _is_in(studio.edits, task, edit):
        return studio, frozenset()
    changed = frozenset({request.key, request.result})
    infos = {info.key: info for info in task.cameras}
    had = infos.get(request.key)
    studio, went_back = _with_placements(studio, request, None if had is None else had.settings)
    done = studio.edits.done
    if studio.edits.shown.stage == "undone":
        back = f" {request.key[1]} is where the file places it; Undo restores your placement."
        message = f"Edit reverted in {edit.names}.{back if went_back else ''}"
        if not done:
            return _with_stage(studio, message, "undone"), changed
        # Show the previous edit, which can be reverted next.
        shown = replace(done[-1], message=f"{message} The edit before it: {done[-1].message}")
        return with_edits(studio, shown=shown), changed
    if wrong := mismatch(request, infos, edit.settings):
        more = "Revert the change, or look for what else in the task places this camera."
        studio = _with_stage(studio, f"{wrong} {more}", "mismatch")
    else:
        studio = _with_stage(studio, change_text(request, DONE, edit.names), "checked")
    return with_edits(studio, done=(*done[:-1], studio.edits.shown)), changed


def _is_in(edits: Edits, task: TaskDescription, edit: SourceEdit) -> bool:
    """Whether an edited file is being loaded and `task` is the expected version: with the edit if it was
    written, without the edit if it was reverted."""
    written = edits.shown.stage == "written"
    return edits.shown.loading and all(
        task.source.get(change.file) == plain_line_ends(change.new_text if written else change.old_text)
        for change in edit.changes
    )


def plan_in_copy(studio: Studio, run: Run) -> Change:
    """Plan the refused request in the copy of the task, if the running task is that copy."""
    edits = studio.edits
    if edits.copied is None or run.task is None or run.task.file != str(edits.copied):
        return studio, []
    studio, request = with_edits(studio, copied=None), edits.shown.request
    return (studio, []) if request is None else _ask(studio, EditWanted(request), run)


def _with_placements(
    studio: Studio, request: EditRequest, in_file: CameraSettings | None
) -> tuple[Studio, bool]:
    """Update the placements after an edit was written or reverted; placements that are not in the file are
    kept.

    Args:
        in_file: the camera's settings in the loaded version; None if there is no such camera.

    Returns:
        The studio, and whether the camera moved from its placement to the file's pose.
    """
    key, went_back = request.key, False
    placements, removed = studio.placements, dict(studio.edits.removed)
    undone = studio.edits.shown.stage == "undone"
    now, placed = placements.now(key), placements.placed.get(key)
    if request.what == "rename":
        placements = placements.rename(*((request.result, key) if undone else (key, request.result)))
    elif request.what == "duplicate" and not undone and placed is not None:
        placements = placements.with_placed(request.result, placed)
    elif request.what == "edit" and request.settings is not None:
        if undone and in_file is not None:
            back = placements.edit_undone(key, request.settings, in_file)
            went_back, placements = back is not None, back or placements
        elif not undone and now is not None and not differences(now, request.settings):
            placements = placements.without(key)  # the file now has it, up to rounding
    elif request.what == "remove":
        if not undone and placed is not None:
            removed[key] = placed
        elif undone and key in removed:
            placements = placements.with_placed(key, removed.pop(key))
    studio = with_edits(replace(studio, placements=placements), removed=removed)
    if not undone and request.what in ("add", "duplicate", "rename"):
        studio = replace(studio, selected=request.result)
    return studio, went_back


def edit_failed_to_load(studio: Studio) -> Studio:
    """Handle a version that failed to load."""
    edits = studio.edits
    if edits.copied is not None:
        why = f"{edits.copied} was made, but does not load: fix or delete it."
        studio = with_edits(studio, shown=EditState("refused", edits.shown.request, message=why))
    shown = studio.edits.shown
    if not shown.loading or shown.edit is None:
        return studio
    undone = shown.stage == "undone"
    hint = "the camera's change is in it; revert the change if it is the cause"
    if undone:
        hint = "the camera's change was reverted, so something else is the cause"
    does = "does" if len(shown.edit.changes) == 1 else "do"
    message = f"{shown.edit.names} {does} not load: {hint}."
    return _with_stage(studio, message, shown.stage, loading=not undone)


def _with_stage(studio: Studio, message: str, stage: EditStage, loading: bool = False) -> Studio:
    shown = replace(studio.edits.shown, stage=stage, message=message, snippet="", loading=loading)
    return with_edits(studio, shown=shown)


def mismatch(
    request: EditRequest, infos: Mapping[CameraKey, CameraInfo], written: CameraSettings | None
) -> str:
    """Text: how the cameras of the reloaded env differ from the request; empty if they do not.

    The reload builds the camera from the file, so only this check proves that the edit is right."""
    kind, name = request.result
    info = infos.get(request.result)
    if request.what == "remove":
        return f"The new env still has the {kind} camera {name}." if info is not None else ""
    if info is None or info.settings is None:
        return f"The new env has no {kind} camera {name}."
    if request.what == "rename" and request.key in infos:
        return f"The new env still has the {kind} camera {request.key[1]}."
    numbers = "" if written is None else difference_text(written, info.settings)
    return f"The new env's {name} is not what was written ({numbers})." if numbers else ""


def difference_text(written: CameraSettings, now: CameraSettings) -> str:
    """Text: the settings that differ, with both values; empty if none does."""

    def value(settings: CameraSettings, what: str) -> str:
        return setting_text(vars(settings)["quaternion" if what == "orientation" else what])

    differing = differences(written, now)
    return "; ".join(f"{what}: {value(now, what)}, not {value(written, what)}" for what in differing)
