"""Commands that set how actions are planned and what is shown of a plan."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec

from workbench.page.command import Command
from workbench.page.commands import ShownOn

MAX_HORIZON_SECONDS = 3.0


class ChoosePlannedEnvs(Command, frozen=True):
    """Plan for the selected env while the others hold still, or for all envs in turn."""

    envs: Literal["selected", "all"]


class ChooseMethod(Command, frozen=True):
    """Choose how the plan is computed from the rollouts."""

    method: Literal["mppi", "predictive", "cem"]


class SetRollouts(Command, frozen=True):
    """Try this many candidates at a time, each in its own env."""

    rollouts: Annotated[int, msgspec.Meta(ge=8, le=256)]


class SetHorizon(Command, frozen=True):
    """Plan this many seconds ahead."""

    horizon: Annotated[float, msgspec.Meta(ge=0.1, le=MAX_HORIZON_SECONDS)]


class SetNoise(Command, frozen=True):
    """Sample candidates with this noise around the plan, as a share of half the range of each action."""

    noise: Annotated[float, msgspec.Meta(ge=0.05, le=2.0)]


class SetTemperature(Command, frozen=True):
    """Set the temperature of the weights of rollouts: the lower it is, the more the best ones count."""

    temperature: Annotated[float, msgspec.Meta(ge=0.01, le=2.0)]


class SetPlanEvery(Command, frozen=True):
    """Replan after this many control steps."""

    every: Annotated[int, msgspec.Meta(ge=1, le=10)]


class ShowRollouts(Command, frozen=True):
    """Show the rollouts as lines in the 3D view."""

    where: ShownOn


class FollowBody(Command, frozen=True):
    """Draw the paths of this body in the rollouts, from the next plan on; without a name, those of the robot's tool."""

    body: str


class LookAtRollout(Command, frozen=True):
    """Show a rollout of the last plan: 1 is the best of those drawn, the last number the worst."""

    number: Annotated[int, msgspec.Meta(ge=1)]
