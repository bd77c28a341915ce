"""What a hand does to a body, and the requests that follow."""

from __future__ import annotations

from dataclasses import dataclass

from workbench.live.events import Send
from workbench.live.messages import MoveBody, PullBody
from workbench.live.run import Run
from workbench.page.command import Refused


@dataclass(frozen=True)
class BodyMoved:
    """A person put a body at a pose."""

    body: str
    env_idx: tuple[int, ...]
    pose: tuple[float, ...]
    """(7,) position and quaternion wxyz in the frame of each env."""


@dataclass(frozen=True)
class BodyPulled:
    """A person pulls a body, or has let go."""

    pull: PullBody


HandEvent = BodyMoved | BodyPulled


def apply(event: object, run: Run) -> list[Send]:
    """The requests to the worker that follow from an event.

    Raises:
        Refused: the body cannot be moved or pulled now.
    """
    match event:
        case BodyMoved(body=body, env_idx=env_idx, pose=pose):
            _require_live(run)
            if run.playing:
                raise Refused("Pause first: a body is moved while the envs stand still.")
            if why := why_not_moved(_kind_of(run, body)):
                raise Refused(why)
            assert run.past is not None, "there is a live moment"
            return [Send(MoveBody(body, env_idx, pose, run.past.history.last))]
        case BodyPulled(pull=PullBody(body="")):
            return [Send(event.pull)]
        case BodyPulled(pull=pull):
            _require_live(run)
            assert run.task is not None, "there is a live moment"
            on_gpu = run.task.backend == "gpu"
            if why := why_not_pulled(_kind_of(run, pull.body), on_gpu):
                raise Refused(why)
            return [Send(pull)]
    return []


def why_not_moved(kind: str) -> str:
    """Why a body of this kind cannot be moved; empty if it can."""
    if kind == "static":
        return "A static body cannot be moved: its place is fixed when the scene is built."
    if kind == "link":
        return "A link cannot be moved alone: play, and drag the link to pull it."
    return "" if kind else "The task has no such body."


def why_not_pulled(kind: str, on_gpu: bool) -> str:
    """Why a body of this kind cannot be pulled; empty if it can."""
    if kind in ("static", "kinematic"):
        return f"A {kind} body does not react to forces."
    if kind == "link" and on_gpu:
        return "SAPIEN applies no forces to links in GPU simulation."
    return "" if kind else "The task has no such body."


def _require_live(run: Run) -> None:
    if run.task is None or run.past is None or run.step is None:
        raise Refused("There is nothing to move until the task has loaded.")
    if run.past.pinned is not None:
        raise Refused("This is a past moment. Press End to go live, or Shift+G to continue from here.")


def _kind_of(run: Run, body: str) -> str:
    assert run.task is not None, "`_require_live` was called"
    geometry = run.task.geometry
    return dict(zip(geometry.body_names, geometry.body_kinds, strict=True)).get(body, "")
