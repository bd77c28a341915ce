"""Commands that select an env, and commands of the table of envs."""

from __future__ import annotations

from typing import Literal

from workbench.page.command import Command


class SelectEnv(Command, frozen=True):
    """Select this env."""

    env: int


class NextEnv(Command, frozen=True):
    """Next env."""

    key = "n"
    context = "live"
    repeats = True


class PreviousEnv(Command, frozen=True):
    """Previous env."""

    key = "p"
    context = "live"
    repeats = True


class NextFailedEnv(Command, frozen=True):
    """Next env whose last episode failed, at its end; if none failed, one at its time limit."""

    key = "e"
    context = "live"


class NextFlaggedEnv(Command, frozen=True):
    """Next flagged env, at its outlier."""

    key = "shift+e"
    context = "live"


class ToggleOnlySelected(Command, frozen=True):
    """Show all envs or the selected one."""

    key = "o"
    context = "live"


class ShowFirstFlagged(Command, frozen=True):
    """Select the first flagged env, at its outlier."""


class ShowEnvAtEvent(Command, frozen=True):
    """Select this env, at the first outlier of its episode, or else at the end of the episode."""

    env: int


class SortEnvs(Command, frozen=True):
    """Sort the table of envs by a column; the same column again reverses the order."""

    column: str


class FilterEnvs(Command, frozen=True):
    """List only these envs."""

    which: Literal["all", "unsolved", "failed", "limit", "running", "flagged"]


class ToggleEnvEntry(Command, frozen=True):
    """Show or hide an entry in the table of envs."""

    name: str


class ToggleEnvEntries(Command, frozen=True):
    """Open or close the list of entries for the table of envs."""


class TurnEnvs(Command, frozen=True):
    """Show the next (1) or the previous (-1) rows of the table of envs."""

    by: int


class ShowEnvs(Command, frozen=True):
    """Show all envs or only the selected one."""

    all_envs: bool
