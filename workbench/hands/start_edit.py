"""State of writing into the author's file how episodes begin, and how events change it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

from workbench.hands.commands import DropStartChange, RevertStartChange, SaveStartChange
from workbench.live.effects import Asked
from workbench.live.events import VersionLoaded
from workbench.live.messages import Load, TaskFailed
from workbench.live.run import Run
from workbench.page.command import Command, Refused
from workbench.source.parsed import plain_line_ends
from workbench.task.description import TaskDescription
from workbench.task.write_edits import SourceEdit

DOES: frozenset[type[Command]] = frozenset({SaveStartChange, RevertStartChange, DropStartChange})
"""Commands that `apply` handles."""
IN_FILE = ("written", "checked", "mismatch")
"""Stages in which the change is in the file."""
MIN_EPISODES = 12
"""Minimum number of episodes over all envs in which a change is tried."""


@dataclass(frozen=True)
class BodyPose:
    """Episodes begin with a body at this pose."""

    of: str
    """Name of the body."""
    pose: tuple[float, ...]
    """(7,) position in metres and quaternion wxyz, in the env's frame."""


@dataclass(frozen=True)
class SpawnRange:
    """Episodes begin with a body at a uniformly drawn place."""

    of: str
    """Name of the body."""
    x: tuple[float, float] | None
    y: tuple[float, float] | None
    """Minimum and maximum in metres, in the env's frame; None keeps what the task does."""


@dataclass(frozen=True)
class RobotQpos:
    """Episodes begin with the joints of a robot at these positions, apart from noise that the task adds."""

    of: str
    """Name of the robot, as in `RobotDescription.name`."""
    qpos: tuple[float, ...]
    """A position for each of `RobotDescription.joints`, in rad or m."""


Beginning = BodyPose | SpawnRange | RobotQpos


@dataclass(frozen=True)
class StartEdit:
    """A change of the file that changes where episodes start. Also the view of this feature."""

    stage: Literal["none", "planning", "planned", "refused", "written", "checked", "mismatch", "undone"] = (
        "none"
    )
    number: int = 0
    """Number of the request; results of older requests are dropped."""
    wanted: Beginning | None = None
    """None in the stage ``none``."""
    edit: SourceEdit | None = None
    message: str = ""
    snippet: str = ""
    """Lines to copy, if the change was refused."""
    writing: bool = False
    """Whether the file is being written, or its new version has not loaded yet."""


@dataclass(frozen=True)
class StartWanted:
    """A person asks to write this into the file."""

    wanted: Beginning


@dataclass(frozen=True)
class StartPlanned:
    """The change is planned, and a run of the new text has shown that it does what was asked."""

    number: int
    edit: SourceEdit


@dataclass(frozen=True)
class StartRefused:
    """The requested change cannot be made."""

    number: int
    why: str
    snippet: str


@dataclass(frozen=True)
class StartFileFailed:
    """The file could not be written."""

    number: int
    why: str


@dataclass(frozen=True)
class StartChecked:
    """Resets of the version with the change were compared with the request."""

    number: int
    why: str
    """How they differ; empty if they do not."""


@dataclass(frozen=True)
class PlanStart:
    """Plan the change, and run the task with it."""

    number: int
    task: TaskDescription
    load: Load
    seeds: tuple[int, ...]
    wanted: Beginning


@dataclass(frozen=True)
class ChangeStartFile:
    """Write the change, or undo it."""

    number: int
    edit: SourceEdit
    revert: bool


@dataclass(frozen=True)
class CheckStart:
    """Reset this version, and compare the body with the request."""

    number: int
    task: TaskDescription
    load: Load
    seeds: tuple[int, ...]
    wanted: Beginning


StartEvent = StartWanted | StartPlanned | StartRefused | StartFileFailed | StartChecked
StartEffect = PlanStart | ChangeStartFile | CheckStart
Change = tuple[StartEdit, list[StartEffect]]


def apply(edit: StartEdit, event: object, run: Run) -> Change:
    """The next state after an event, and the effects to perform.

    Raises:
        Refused: the command makes no sense now; nothing has changed.
    """
    match event:
        case StartWanted(wanted=wanted):
            return _plan(edit, run, wanted)
        case StartPlanned(number=edit.number, edit=planned) if edit.stage == "planning":
            message = f"This writes where {_named(edit)} begins into {planned.names}. Nothing is written yet."
            return replace(edit, stage="planned", edit=planned, message=message), []
        case StartRefused(number=edit.number, why=why, snippet=snippet) if edit.stage == "planning":
            advice = " You can copy the lines below into the file yourself." if snippet else ""
            message = f"Not written: {why}.{advice}"
            return replace(edit, stage="refused", message=message, snippet=snippet), []
        case StartFileFailed(number=edit.number, why=why):
            stage = "refused" if edit.stage == "written" else "checked"
            return replace(edit, stage=stage, message=f"The file was not changed: {why}.", writing=False), []
        case Asked(command=SaveStartChange()):
            return _change_file(edit, revert=False)
        case Asked(command=RevertStartChange()):
            return _change_file(edit, revert=True)
        case Asked(command=DropStartChange()):
            return StartEdit(number=edit.number + 1), []
        case VersionLoaded() if edit.writing and _is_loaded(edit, run):
            return _loaded(edit, run)
        case VersionLoaded() if edit.writing and not _is_loaded(edit, run, other=True):
            # The author has edited the file again, or opened another task.
            return StartEdit(number=edit.number + 1), []
        case TaskFailed(at_run=False) if edit.writing and edit.stage == "written":
            message = "The file does not load. The change is in it: revert it if it is the cause."
            return replace(edit, message=message), []
        case StartChecked(number=edit.number, why=why) if edit.stage == "written":
            if why:
                message = f"{why}. Revert the change, or look for what else moves {_named(edit)}."
                return replace(edit, stage="mismatch", message=message), []
            return replace(edit, stage="checked", message=f"{_named(edit)}: written and verified."), []
    return edit, []


def _named(edit: StartEdit) -> str:
    return "" if edit.wanted is None else edit.wanted.of


def _plan(edit: StartEdit, run: Run, wanted: Beginning) -> Change:
    load = run.running_load()
    if run.task is None or load is None:
        raise Refused("No task is loaded yet.")
    if run.playing and not isinstance(wanted, SpawnRange):
        raise Refused("Pause first, and move it to where it shall begin.")
    if edit.writing:
        raise Refused("Wait until the last change has loaded.")
    planning = StartEdit("planning", edit.number + 1, wanted, message="Running the task with the change ...")
    return planning, [PlanStart(planning.number, run.task, load, seeds_to_try(run), wanted)]


def seeds_to_try(run: Run) -> tuple[int, ...]:
    """Seeds for resets of all envs, for `MIN_EPISODES` episodes that differ."""
    resets = max(2, math.ceil(MIN_EPISODES / run.num_envs))
    return tuple(run.seed + reset * run.num_envs for reset in range(resets))


def _change_file(edit: StartEdit, revert: bool) -> Change:
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
    return changed, [ChangeStartFile(edit.number, edit.edit, revert)]


def _is_loaded(edit: StartEdit, run: Run, other: bool = False) -> bool:
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


def _loaded(edit: StartEdit, run: Run) -> Change:
    load = run.running_load()
    if edit.stage == "undone" or edit.wanted is None or run.task is None or load is None:
        return replace(edit, writing=False, message="Reverted in the file."), []
    check = CheckStart(edit.number, run.task, load, seeds_to_try(run), edit.wanted)
    return replace(edit, writing=False, message="Loaded; resetting the task to check it."), [check]
