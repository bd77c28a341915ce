"""Checks of the task's rules, and solving it."""

from __future__ import annotations

from typing import Annotated

import msgspec

from workbench.page.command import Command


class ShowChecks(Command, frozen=True):
    """Show the checks."""

    key = "w"
    context = "live"


class ToggleRule(Command, frozen=True):
    """Fold out what a rule says, or fold it in."""

    rule: str


class ToggleVerdict(Command, frozen=True):
    """Fold out what a verdict on the reward says, or fold it in."""

    rule: str


class ShowSolved(Command, frozen=True):
    """Watch the episode of this seed in the review."""

    seed: int


class CheckNow(Command, frozen=True):
    """Check the rules of the running version."""


class StopChecks(Command, frozen=True):
    """Stop checking."""


class CheckAfterSave(Command, frozen=True):
    """Check each version that loads, or none."""

    on: bool


class TimeStep(Command, frozen=True):
    """Time each hook and line over some hundred control steps, in a process of its own."""


class StopProfile(Command, frozen=True):
    """Stop timing."""


MOST_SEEDS = 256


class ChooseSeeds(Command, frozen=True):
    """How many seeds to solve, from 0 on."""

    seeds: Annotated[int, msgspec.Meta(ge=1, le=MOST_SEEDS)]


class SolveSeeds(Command, frozen=True):
    """Solve the file as it is saved from each seed, as workbench solve does, with the sliders of the Run tab."""


class StopSolving(Command, frozen=True):
    """Stop solving from many seeds."""
