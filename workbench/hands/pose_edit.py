"""State of writing a body's new first pose into the author's file, and how events change it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

from workbench.hands.commands import DropPoseChange, RevertPoseChange, SavePoseChange
from workbench.live.effects import Asked
from workbench.live.events import VersionLoaded
from workbench.live.messages import Load, TaskFailed
from workbench.live.run import Run
from workbench.page.command import Command, Refused
from workbench.source.parsed import plain_line_ends
from workbench.task.description import TaskDescription
from workbench.task.write_edits import SourceEdit

DOES: frozenset[type[Command]] = frozenset({SavePoseChange, RevertPoseChange, DropPoseChange})
"""Commands that `apply` handles."""
IN_FILE = ("written", "checked", "mismatch")
"""Stages in which the change is in the file."""
Pose = tuple[float, ...]


@dataclass(frozen=True)
class PoseEdit:
    """A change of the file that gives a body another first pose. Also the view of this feature."""

    stage: Literal["none", "planning", "planned", "refused", "written", "checked", "mismatch", "undone"] = (
        "none"
    )
    number: int = 0
    """Number of the request; results of older requests are dropped."""
    body: str = ""
    pose: Pose = ()
    """(7,) requested position in metres and quaternion wxyz, in the env's frame."""
    edit: SourceEdit | None = None
    message: str = ""
    snippet: str = ""
    """Lines to copy, if the change was refused."""
    writing: bool = False
    """Whether the file is being written, or its new version has not loaded yet."""


@dataclass(frozen=True)
class PoseWanted:
    """A person asks to write this pose of a body into the file."""

    body: str
    pose: Pose
    """(7,) as in `PoseEdit.pose`."""


@dataclass(frozen=True)
class PosePlanned:
    """The change is planned, and a run of the new text has shown that it does what was asked."""

    number: int
    edit: SourceEdit


@dataclass(frozen=True)
class PoseRefused:
    """The requested change cannot be made."""

    number: int
    why: str
    snippet: str


@dataclass(frozen=True)
class PoseFileFailed:
    """The file could not be written."""

    number: int
    why: str


@dataclass(frozen=True)
class PoseChecked:
    """Resets of the version with the change were compared with the request."""

    number: int
    why: str
    """How they differ; empty if they do not."""


@dataclass(frozen=True)
class PlanPose:
    """Plan the change, and run the task with it."""

    number: int
    task: TaskDescription
    load: Load
    seeds: tuple[int, ...]
    body: str
    pose: Pose


@dataclass(frozen=True)
class ChangePoseFile:
    """Write the change, or undo it."""

    number: int
    edit: SourceEdit
    revert: bool


@dataclass(frozen=True)
class CheckPose:
    """Reset this version, and compare the body with the request."""

    number: int
    task: TaskDescription
    load: Load
    seeds: tuple[int, ...]
    body: str
    pose: Pose


PoseEvent = PoseWanted | PosePlanned | PoseRefused | PoseFileFailed | PoseChecked
PoseEffect = PlanPose | ChangePoseFile | CheckPose
Change = tuple[PoseEdit, list[PoseEffect]]


def apply(edit: PoseEdit, event: object, run: Run) -> Change:
    """The next state after an event, and the effects to perform.

    Raises:
        Refused: the command makes no sense now; nothing has changed.
    """
    match event:
        case PoseWanted(body=body, pose=pose):
            return _plan(edit, run, body, pose)
        case PosePlanned(number=edit.number, edit=planned) if edit.stage == "planning":
            message = f"This writes where {edit.body} begins into {planned.names}. Nothing is written yet."
            return replace(edit, stage="planned", edit=planned, message=message), []
        case PoseRefused(number=edit.number, why=why, snippet=snippet) if edit.stage == "planning":
            advice = " You can copy the lines below into the file yourself." if snippet else ""
            message = f"Not written: {why}.{advice}"
            return replace(edit, stage="refused", message=message, snippet=snippet), []
        case PoseFileFailed(number=edit.number, why=why):
            stage = "refused" if edit.stage == "written" else "checked"
            return replace(edit, stage=stage, message=f"The file was not changed: {why}.", writing=False), []
        case Asked(command=SavePoseChange()):
            return _change_file(edit, revert=False)
        case Asked(command=RevertPoseChange()):
            return _change_file(edit, revert=True)
        case Asked(command=DropPoseChange()):
            return PoseEdit(number=edit.number + 1), []
        case VersionLoaded() if edit.writing and _is_loaded(edit, run):
            return _loaded(edit, run)
        case VersionLoaded() if edit.writing and not _is_loaded(edit, run, other=True):
            # The author has edited the file again, or opened another task.
            return PoseEdit(number=edit.number + 1), []
        case TaskFailed(at_run=False) if edit.writing and edit.stage == "written":
            message = "The file does not load. The change is in it: revert it if it is the cause."
            return replace(edit, message=message), []
        case PoseChecked(number=edit.number, why=why) if edit.stage == "written":
            if why:
                message = f"{why}. Revert the change, or look for what else moves {edit.body}."
                return replace(edit, stage="mismatch", message=message), []
            return replace(edit, stage="checked", message=f"{edit.body}: written and verified."), []
    return edit, []


def _plan(edit: PoseEdit, run: Run, body: str, pose: Pose) -> Change:
    load = run.running_load()
    if run.task is None or load is None:
        raise Refused("No task is loaded yet.")
    if run.playing:
        raise Refused("Pause first, and move the body to where it shall begin.")
    if edit.writing:
        raise Refused("Wait until the last change has loaded.")
    wanted = PoseEdit("planning", edit.number + 1, body, pose, message="Running the task with the change ...")
    return wanted, [PlanPose(wanted.number, run.task, load, _seeds(run), body, pose)]


def _seeds(run: Run) -> tuple[int, ...]:
    """Two seeds: a pose that is the same after a reset with each of them counts as fixed."""
    return run.seed, run.seed + run.num_envs


def _change_file(edit: PoseEdit, revert: bool) -> Change:
    fits = edit.stage in IN_FILE if revert else edit.stage == "planned"
    if edit.edit is None or not fits:
        raise Refused(
            "There is no change to revert."
            if revert
            else "Show the change first: only what you have read is saved."
        )
    # Set the stage before the file is written: the new version may load before the write is reported.
    what = f"Reverted in {edit.edit.names}" if revert else f"Saved to {edit.edit.names}"
    stage = "undone" if revert else "written"
    changed = replace(edit, stage=stage, message=f"{what}; loading it.", writing=True)
    return changed, [ChangePoseFile(edit.number, edit.edit, revert)]


def _is_loaded(edit: PoseEdit, run: Run, other: bool = False) -> bool:
    """Whether the running version has the new text of the change or, after a revert, the old text.

    Args:
        other: ask for the text that the file had before instead.
    """
    old = (edit.stage == "undone") != other
    return (
        run.task is not None
        and edit.edit is not None
        and all(
            run.task.source.get(change.file) == plain_line_ends(change.old_text if old else change.new_text)
            for change in edit.edit.changes
        )
    )


def _loaded(edit: PoseEdit, run: Run) -> Change:
    load = run.running_load()
    if edit.stage == "undone" or edit.edit is None or run.task is None or load is None:
        return replace(edit, writing=False, message="Reverted in the file."), []
    check = CheckPose(edit.number, run.task, load, _seeds(run), edit.body, edit.pose)
    return replace(edit, writing=False, message="Loaded; resetting the task to check it."), [check]
