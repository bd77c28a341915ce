"""Commands of the running task: play, step, reset, actions, log, reload, env options."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec

from workbench.actions.sources import ActionSource
from workbench.page.command import Command
from workbench.page.commands import ShownOn

MAX_SEED = 2**31 - 1


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
    """Rebuild the envs with this control mode."""

    mode: str


class ResetEnvOptions(Command, frozen=True):
    """Rebuild the envs with the task's own options."""


class ToggleCurve(Command, frozen=True):
    """Show or hide the curve of an entry."""

    group: Literal["reward", "reward term", "evaluate", "joint", "contact force"]
    name: str


class ChooseBeside(Command, frozen=True):
    """Draw the curves over this env's last episodes, or over the episodes of the other envs."""

    beside: Literal["last", "batch"]


class SetSeed(Command, frozen=True):
    """Reset all envs with this seed."""

    seed: Annotated[int, msgspec.Meta(ge=0, le=MAX_SEED)]


class SetPolicy(Command, frozen=True):
    """Take the actions from this policy: ``module:function`` or ``file.py:function``."""

    policy: str


class FilterLog(Command, frozen=True):
    """Show only the lines of the log that contain this text."""

    text: str


class SetSpeed(Command, frozen=True):
    """Play at this speed: simulated seconds per real second."""

    speed: Annotated[float, msgspec.Meta(gt=0)] | None
    """None: as fast as possible."""


class ChooseEpisodeEnd(Command, frozen=True):
    """Choose what happens when an episode ends."""

    rule: Literal["reset", "continue", "pause"]


class ChoosePauseEntry(Command, frozen=True):
    """Pause when this number of the selected env meets a condition; empty for never."""

    entry: str


class ChoosePauseTest(Command, frozen=True):
    """Choose the condition at which to pause."""

    test: Literal["becomes true", "becomes false", "rises above", "falls below"]


class SetPauseLevel(Command, frozen=True):
    """Set the threshold at which to pause."""

    level: float


class ChooseActions(Command, frozen=True):
    """Choose the source of the actions."""

    source: ActionSource


class MoveSlider(Command, frozen=True):
    """Set one dimension of the robot's action to this value."""

    dimension: Annotated[int, msgspec.Meta(ge=0)]
    value: float


class ChooseMoved(Command, frozen=True):
    """Choose the envs whose robots the action sliders move."""

    envs: Literal["selected", "all"]


class HoldStill(Command, frozen=True):
    """Stop each joint where it is; the sliders follow."""


class PauseLog(Command, frozen=True):
    """Hold back new lines of the log, or show them."""

    on: bool


class ClearLog(Command, frozen=True):
    """Clear the log."""


class ChooseInspected(Command, frozen=True):
    """Choose what to inspect in the selected env."""

    what: Literal["nothing", "joints", "contacts", "bodies", "observation", "state"]


class FindBodies(Command, frozen=True):
    """List the bodies whose name contains this text; empty for all."""

    text: Annotated[str, msgspec.Meta(max_length=256)]


class SelectBody(Command, frozen=True):
    """Select this body of the selected env, in the view and in Inspect; empty for none."""

    body: str


class HoverBody(Command, frozen=True):
    """Light this body of the selected env in the view while the pointer is on its row; empty for none."""

    body: str


class ShowForces(Command, frozen=True):
    """Show the contact forces of the selected env, as arrows in the 3D view."""

    where: ShownOn


class RebuildScene(Command, frozen=True):
    """Reload the file, rebuild the scene and restore the current state."""


class ReloadCode(Command, frozen=True):
    """Only reload code, even if the change needs more than that: old and new code may then be mixed."""


class ReloadCameras(Command, frozen=True):
    """Only reload cameras and code, even if the change needs more: old and new code may then be mixed."""


class ChooseClass(Command, frozen=True):
    """Load this task of the file."""

    name: str


class FillEmptyFile(Command, frozen=True):
    """Write the minimal task into the empty file."""


MAX_NUM_ENVS = 4096
MAX_VALUE_CHARACTERS = 2000


class SetNumEnvs(Command, frozen=True):
    """Enter this number of envs in the form of env options."""

    num_envs: Annotated[int, msgspec.Meta(ge=1, le=MAX_NUM_ENVS)]


class SetKeyword(Command, frozen=True):
    """Enter this value of a keyword argument in the form of env options."""

    name: str
    value: Annotated[str, msgspec.Meta(max_length=MAX_VALUE_CHARACTERS)] | int | float | bool


class ApplyEnvOptions(Command, frozen=True):
    """Rebuild the envs with the options in the form."""


class DiscardEnvOptions(Command, frozen=True):
    """Revert the form to the current env options."""


class ChoosePictures(Command, frozen=True):
    """Show exact pictures, fast ones, or fast ones while something moves."""

    pictures: Literal["auto", "exact", "fast"]
