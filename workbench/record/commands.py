"""Commands of the recorder: record the running envs, or save steps of the history."""

from __future__ import annotations

from typing import Literal

from workbench.page.command import Command


class ToggleRecording(Command, frozen=True):
    """Start or stop recording."""

    key = "shift+c"
    context = "live"


class StopRecording(Command, frozen=True):
    """Stop recording."""


class ToggleSavePast(Command, frozen=True):
    """Save what I just saw; again: stop saving it."""

    key = "shift+k"
    context = "live"


class RecordNextEpisode(Command, frozen=True):
    """Wait for the next reset and record that one episode."""


class SavePreviousEpisode(Command, frozen=True):
    """Save the episode before the shown one."""


class ChooseRecordedEnvs(Command, frozen=True):
    """Choose which envs are recorded and saved."""

    envs: Literal["selected", "all"]


class SaveSolved(Command, frozen=True):
    """Save the solved episode to the recordings, from where it can be exported as a demonstration."""
