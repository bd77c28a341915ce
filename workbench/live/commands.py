"""The task that runs: play, step, reset, which code."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec

from workbench.actions.sources import ActionSource
from workbench.page.command import Command

LARGEST_SEED = 2**31 - 1


class TogglePlay(Command, frozen=True):
    """Play or pause."""

    key = "space"


class PlayRun(Command, frozen=True):
    """Play."""

    context = "live"


class PauseRun(Command, frozen=True):
    """Pause."""

    context = "live"


class Step(Command, frozen=True):
    """One control step; pauses first."""

    key = "s"
    context = "live"
    repeats = True


class ResetAll(Command, frozen=True):
    """Reset all envs."""

    key = "shift+r"
    context = "live"


class ResetSelected(Command, frozen=True):
    """Reset the selected env."""

    key = "shift+s"
    context = "live"


class ReloadFile(Command, frozen=True):
    """Reload the file."""

    key = "l"
    context = "live"


class Interrupt(Command, frozen=True):
    """Interrupt the task."""

    key = "shift+i"
    context = "live"


class RestartWorker(Command, frozen=True):
    """Restart the worker."""

    key = "shift+l"
    context = "live"


class UseControlMode(Command, frozen=True):
    """Make the envs anew with this control mode."""

    mode: str


class ResetEnvOptions(Command, frozen=True):
    """Make the envs as the task does."""


class ToggleCurve(Command, frozen=True):
    """Draw the curve of an entry, or leave it out."""

    group: Literal["reward", "reward term", "evaluate", "joint"]
    name: str


class SetSeed(Command, frozen=True):
    """Reset all envs with this seed."""

    seed: Annotated[int, msgspec.Meta(ge=0, le=LARGEST_SEED)]


class SetPolicy(Command, frozen=True):
    """Let this policy act: ``module:function`` or ``file.py:function``."""

    policy: str


class FilterLog(Command, frozen=True):
    """Show the lines of the log that have this text."""

    text: str


class SetSpeed(Command, frozen=True):
    """Play at this speed: simulated seconds in one second."""

    speed: Annotated[float, msgspec.Meta(gt=0)] | None
    """None is as fast as it goes."""


class ChooseEpisodeEnd(Command, frozen=True):
    """What to do when an episode ends."""

    rule: Literal["reset", "continue", "pause"]


class ChooseActions(Command, frozen=True):
    """Where the actions come from."""

    source: ActionSource


class MoveSlider(Command, frozen=True):
    """Tell the robot this value of one dimension of its action."""

    dimension: Annotated[int, msgspec.Meta(ge=0)]
    value: float


class ChooseMoved(Command, frozen=True):
    """Whose robot the sliders of the action move."""

    envs: Literal["selected", "all"]


class HoldStill(Command, frozen=True):
    """Stop each joint where it is; the sliders follow."""


class PauseLog(Command, frozen=True):
    """Let new lines of the log wait, or show them."""

    on: bool


class ClearLog(Command, frozen=True):
    """Forget what was printed."""


class ChooseInspected(Command, frozen=True):
    """Read this of the selected env, or nothing."""

    what: Literal["nothing", "joints", "contacts", "poses", "observation", "state"]


class ShowForces(Command, frozen=True):
    """Draw the contact forces of the selected env as arrows in the 3D view, or not."""

    on: bool


class RebuildScene(Command, frozen=True):
    """Reload the file and rebuild the scene, with the moment restored."""


class ReloadCode(Command, frozen=True):
    """Only reload code, also where that was not found safe: old and new code may then be mixed."""


class ReloadCameras(Command, frozen=True):
    """Only reload cameras and code, also where that was not found safe: old and new code may then be mixed."""


class ChooseClass(Command, frozen=True):
    """Load this one of the file's tasks."""

    name: str


class FillEmptyFile(Command, frozen=True):
    """Write the minimal task into the empty file."""


MOST_ENVS = 4096
LONGEST_VALUE = 2000
"""Characters."""


class SetNumEnvs(Command, frozen=True):
    """Write this number of envs into the form of how the envs are made."""

    num_envs: Annotated[int, msgspec.Meta(ge=1, le=MOST_ENVS)]


class SetKeyword(Command, frozen=True):
    """Write this value of a keyword argument into the form of how the envs are made."""

    name: str
    value: Annotated[str, msgspec.Meta(max_length=LONGEST_VALUE)] | int | float | bool


class ApplyEnvOptions(Command, frozen=True):
    """Make the envs anew with what the form says."""


class DiscardEnvOptions(Command, frozen=True):
    """Show again in the form how the envs are made now."""


class ChoosePictures(Command, frozen=True):
    """Show exact pictures, fast ones, or fast ones while something moves."""

    pictures: Literal["auto", "exact", "fast"]
