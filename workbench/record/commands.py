"""Commands that record running or past episodes."""

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
    """Save the episode at the shown moment, or stop a save that is running."""

    key = "shift+k"
    context = "live"


class RecordNextEpisode(Command, frozen=True):
    """Wait for the next reset, then record one episode."""


class SavePreviousEpisode(Command, frozen=True):
    """Save the episode that precedes the shown one."""


class ChooseRecordedEnvs(Command, frozen=True):
    """Choose the envs that are recorded and saved."""

    envs: Literal["selected", "all"]


class SaveSolved(Command, frozen=True):
    """Save the solved episode as a recording, which can be exported as a demonstration."""
