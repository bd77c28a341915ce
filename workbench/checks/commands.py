"""Commands of the Checks and Try tabs: check rules, time a step, solve seeds."""

from __future__ import annotations

from typing import Annotated

import msgspec

from workbench.page.command import Command


class ShowChecks(Command, frozen=True):
    """Show the checks."""

    key = "w"
    context = "live"


class ToggleRule(Command, frozen=True):
    """Unfold or fold the text of a rule."""

    rule: str


class ToggleVerdict(Command, frozen=True):
    """Unfold or fold the text of a verdict on the reward."""

    rule: str


class ShowSolved(Command, frozen=True):
    """Watch the episode of this seed in the review."""

    seed: int


class CheckNow(Command, frozen=True):
    """Check the rules of the running version."""


class StopChecks(Command, frozen=True):
    """Stop checking."""


class CheckAfterSave(Command, frozen=True):
    """Check each version that loads, or only on request."""

    on: bool


class TimeStep(Command, frozen=True):
    """Time each hook and line over a few hundred control steps, in a separate process."""


class StopProfile(Command, frozen=True):
    """Stop timing."""


MOST_SEEDS = 256


class ChooseSeeds(Command, frozen=True):
    """Choose how many seeds to solve; seeds are counted from 0."""

    seeds: Annotated[int, msgspec.Meta(ge=1, le=MOST_SEEDS)]


class SolveSeeds(Command, frozen=True):
    """Solve the saved file from each seed, like workbench solve, with the settings of the Run tab."""


class StopSolving(Command, frozen=True):
    """Stop solving seeds."""
