"""Arms that follow the handles at their end effectors, which a person drags."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

from workbench.live.events import Send
from workbench.live.messages import Reached, ReachPose
from workbench.live.run import Run
from workbench.page.command import Refused
from workbench.task.description import Stepped

ArmKey = tuple[int, str]
"""Env, and body name of the end effector."""


@dataclass(frozen=True)
class ArmDragged:
    """A person drags the handles at an end effector."""

    arm: str
    """Body name of the end effector."""
    env: int
    pose: tuple[float, ...]
    """(7,) position and quaternion wxyz in the env's frame."""
    ends: bool = False
    """Whether the drag ends here."""


@dataclass(frozen=True)
class ArmsReleased:
    """A drag was cancelled, for example because its page has closed: no arm follows its handle any more."""


@dataclass(frozen=True)
class Reach:
    """The targets of the arms."""

    shown: bool = False
    """Whether the handles are shown."""
    targets: Mapping[ArmKey, tuple[float, ...]] = field(default_factory=lambda: MappingProxyType({}))
    """(7,) pose that an arm is to reach, in the env's frame."""
    reached: Mapping[ArmKey, Reached] = field(default_factory=lambda: MappingProxyType({}))
    """The worker's newest answer for each target."""


Change = tuple[Reach, list[Any]]


def toggle(reach: Reach, run: Run) -> Change:
    """Show the handles, or hide them and let go of the arms. Raises Refused if no robot has an arm."""
    if reach.shown:
        return Reach(), let_go(reach)
    if run.task is None:
        raise Refused("There is nothing to move until the task has loaded.")
    if not run.task.arms:
        raise Refused(why_no_arm(run.task.armless))
    return Reach(shown=True), []


def why_no_arm(robots: tuple[str, ...]) -> str:
    """Why the robots of these names have no handles."""
    if not robots:
        return "The task has no robot."
    return (
        f"No arm in {', '.join(robots)}: no end-effector controller, no tcp, and fewer than three joints before the first "
        "branch."
    )


def lead(reach: Reach, event: ArmDragged, run: Run) -> Change:
    """Handle a drag. While the envs play, the arm follows; while paused, it moves when the drag ends."""
    assert run.past is not None, "there is a live moment"
    # While paused, ``try`` asks only for the joint positions, which the page shows.
    how = "follow" if run.playing else "set" if event.ends else "try"
    key = event.env, event.arm
    targets = MappingProxyType({**reach.targets, key: event.pose})
    request = ReachPose(event.arm, event.env, event.pose, how, run.past.history.last)
    return replace(reach, targets=targets), [Send(request)]


def answered(reach: Reach, event: Reached) -> Reach:
    """Store an answer of the worker."""
    key = event.env, event.arm
    if key not in reach.targets:
        return reach
    return replace(reach, reached=MappingProxyType({**reach.reached, key: event}))


def stepped(reach: Reach, event: Stepped) -> Reach:
    """Drop the targets and answers of envs that were reset or restored."""
    gone = {key for key in {*reach.targets, *reach.reached} if event.reset_mask[key[0]]}
    if not gone:
        return reach
    # The answer to a move that fell short stays until the next reset, so that a person can read why.
    moved = "" if event.restored is None else event.restored.moved
    fell_short = {key for key in gone if key[1] == moved and key in reach.reached and reach.reached[key].why}
    return _without(reach, gone, gone - fell_short)


def let_go(reach: Reach, env: int | None = None) -> list[Any]:
    """The requests that let go of all arms, or of the arms of one env."""
    envs = dict.fromkeys(of for of, _ in reach.targets if env in (None, of))
    return [Send(ReachPose(env=of)) for of in envs]


def loaded(reach: Reach, run: Run) -> Reach:
    """Another version runs, perhaps of another task: there are no targets, and without an arm no handles."""
    return Reach(shown=reach.shown and run.task is not None and bool(run.task.arms))


def without(reach: Reach, env: int | None = None) -> Reach:
    """The state without the targets of this env; without any targets if `env` is None."""
    gone = {key for key in reach.targets if env in (None, key[0])}
    return _without(reach, gone, gone) if gone else reach


def _without(reach: Reach, targets: Collection[ArmKey], answers: Collection[ArmKey]) -> Reach:
    return replace(
        reach,
        targets=MappingProxyType({key: pose for key, pose in reach.targets.items() if key not in targets}),
        reached=MappingProxyType({key: one for key, one in reach.reached.items() if key not in answers}),
    )
