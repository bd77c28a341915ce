"""How actions are planned, and what is shown of a plan."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec

from workbench.page.command import Command

LONGEST_HORIZON = 3.0
"""Seconds."""


class ChoosePlannedEnvs(Command, frozen=True):
    """Plan for the selected env while the others hold still, or for all envs in turn."""

    envs: Literal["selected", "all"]


class ChooseMethod(Command, frozen=True):
    """Choose what of all rollouts becomes the plan."""

    method: Literal["mppi", "predictive", "cem"]


class SetRollouts(Command, frozen=True):
    """Try this many candidates at a time, each in its env."""

    rollouts: Annotated[int, msgspec.Meta(ge=8, le=256)]


class SetHorizon(Command, frozen=True):
    """Plan this many seconds ahead."""

    horizon: Annotated[float, msgspec.Meta(ge=0.1, le=LONGEST_HORIZON)]


class SetNoise(Command, frozen=True):
    """Draw candidates this far around the plan, in halves of the range of each action."""

    noise: Annotated[float, msgspec.Meta(ge=0.05, le=2.0)]


class SetTemperature(Command, frozen=True):
    """Weigh rollouts by what they earned: the lower this is, the more the best ones count."""

    temperature: Annotated[float, msgspec.Meta(ge=0.01, le=2.0)]


class SetPlanEvery(Command, frozen=True):
    """Take this many control steps before the next plan."""

    every: Annotated[int, msgspec.Meta(ge=1, le=10)]


class ShowRollouts(Command, frozen=True):
    """Draw what was tried as lines in the 3D view, or not."""

    on: bool


class FollowBody(Command, frozen=True):
    """Draw the ways of this body in the rollouts, from the next plan on; without a name those of the robot's tool."""

    body: str


class LookAtRollout(Command, frozen=True):
    """Look at a rollout of the last plan: 1 is the best that is drawn, the last one the worst."""

    number: Annotated[int, msgspec.Meta(ge=1)]
