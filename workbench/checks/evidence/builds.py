"""Notes what a task builds and which poses it sets, while its hooks run."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable, Collection, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import wraps
from typing import Any

import numpy as np
import torch
from mani_skill.agents.base_agent import BaseAgent
from mani_skill.utils.building.actor_builder import ActorBuilder
from mani_skill.utils.building.articulation_builder import ArticulationBuilder
from mani_skill.utils.structs import Actor, Articulation, Link, Pose
from numpy.typing import NDArray

from workbench.envs.broken_rule import Place

_BUILDERS = ("mani_skill.utils.building", "sapien.", "workbench.")
"""Modules that build on behalf of their caller."""


@dataclass(frozen=True)
class Shape:
    """One shape of a builder. Equal shapes look and collide the same."""

    kind: str
    """``box sphere capsule cylinder plane file convex_mesh nonconvex_mesh multiple_convex_meshes``"""
    file: str
    """File of a mesh; empty for other shapes."""
    numbers: tuple[float, ...]
    """Sizes in metres and pose in the body; then the colour of a visual shape, or friction and density of a
    collision shape."""


@dataclass(frozen=True)
class Built:
    """An actor, or an articulation with all its links, that a builder made."""

    name: str
    kind: str
    """``dynamic``, ``kinematic``, ``static`` or ``articulation``"""
    of_robot: bool
    """Whether an agent class built it."""
    quaternion: NDArray[np.float32] | None
    """(M, 4) of the initial pose, wxyz; None if the builder was given no pose."""
    envs: tuple[int, ...]
    place: Place | None
    """The author's line; None where other code builds it."""
    collision: tuple[Shape, ...]
    visual: tuple[Shape, ...]


@dataclass(frozen=True)
class Merged:
    """One call of ``Actor.merge`` or ``Articulation.merge``."""

    name: str | None
    parts: frozenset[str]
    place: Place | None


@dataclass(frozen=True)
class PoseSet:
    """One pose that was set on an actor or an articulation."""

    name: str
    quaternions: NDArray[np.float32]
    """(b, 4) wxyz, as given."""
    place: Place | None
    """The author's line; None where other code sets it."""


@contextmanager
def noting_builds(built: list[Built], merged: list[Merged], files: Collection[str]) -> Iterator[None]:
    """Context in which builds and merges are added to the lists.

    Args:
        files: paths of the author's files.
    """

    def note(stock: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(stock)
        def build(builder: Any, *args: Any, **kwargs: Any) -> Any:
            # Read before the build, which sets a missing pose.
            pose = builder.initial_pose
            made = stock(builder, *args, **kwargs)
            built.append(_built(builder, made, pose, files))
            return made

        return build

    def note_merge(stock: Any) -> Any:
        stock = stock.__func__
        takes = inspect.signature(stock)

        @wraps(stock)
        def merge(*args: Any, **kwargs: Any) -> Any:
            made = stock(*args, **kwargs)
            given = takes.bind(*args, **kwargs).arguments
            _, structs = list(given.values())[:2]
            parts = frozenset(str(part.name) for part in structs)
            merged.append(Merged(given.get("name"), parts, author_place(files)))
            return made

        return classmethod(merge)

    with ExitStack() as stack:
        for owner in (ActorBuilder, ArticulationBuilder):
            stack.enter_context(_replaced(owner, "build", note))
        for owner in (Actor, Articulation):
            stack.enter_context(_replaced(owner, "merge", note_merge))
        yield


@contextmanager
def noting_poses(placed: list[PoseSet], files: Collection[str]) -> Iterator[None]:
    """Context in which each pose that is set on an actor or a root link is added to `placed`."""

    def note(stock: Any) -> Any:
        @wraps(stock.fset)
        def set_pose(struct: Any, pose: Any) -> None:
            name = struct.name if isinstance(struct, Actor) else struct.articulation.name
            placed.append(PoseSet(str(name), _quaternions(pose), author_place(files)))
            stock.fset(struct, pose)

        return property(stock.fget, set_pose)

    with _replaced(Actor, "pose", note), _replaced(Link, "pose", note):
        yield


@contextmanager
def _replaced(owner: type, name: str, by: Callable[[Any], Any]) -> Iterator[None]:
    stock = vars(owner)[name]
    setattr(owner, name, by(stock))
    try:
        yield
    finally:
        setattr(owner, name, stock)


def author_place(files: Collection[str]) -> Place | None:
    """The author's line that called the builder or setter; None if other code did, such as a scene builder or
    a robot."""
    frame = sys._getframe(1)
    while frame is not None:
        code = frame.f_code
        if code.co_filename in files:
            return code.co_filename, frame.f_lineno, code.co_name
        name = frame.f_globals.get("__name__", "")
        if not name.startswith(_BUILDERS) and "mani_skill.utils.structs" not in name:
            return None
        frame = frame.f_back
    return None


def shapes_of_env(built: list[Built], env: int) -> tuple[tuple[str, tuple[Shape, ...]], ...]:
    """Kind and shapes of each body of one env, in the order of the build; equal for two envs that look the same."""
    return tuple((each.kind, each.collision + each.visual) for each in built if env in each.envs)


def _built(builder: Any, made: Any, pose: Any, files: Collection[str]) -> Built:
    links: list[Any] = [builder]
    if isinstance(builder, ArticulationBuilder):
        links = builder.link_builders
    scenes: Any = builder.scene_idxs
    return Built(
        name=str(made.name),
        kind=getattr(builder, "physx_body_type", "articulation"),
        of_robot=_in_agent(),
        quaternion=None if pose is None else _quaternions(pose),
        envs=tuple(int(i) for i in scenes),
        place=author_place(files),
        collision=tuple(_shape(record) for link in links for record in link.collision_records),
        visual=tuple(_shape(record) for link in links for record in link.visual_records),
    )


def _in_agent() -> bool:
    frame = sys._getframe(1)
    while frame is not None:
        if isinstance(frame.f_locals.get("self"), BaseAgent):
            return True
        frame = frame.f_back
    return False


def _shape(record: Any) -> Shape:
    numbers = [*np.ravel(record.scale), record.radius, record.length, *record.pose.p, *record.pose.q]
    colour = getattr(record.material, "base_color", None)
    if colour is not None:
        numbers += list(colour)
    numbers += [
        getattr(thing, name)
        for thing, name in ((record.material, "static_friction"), (record, "density"))
        if hasattr(thing, name)
    ]
    return Shape(
        record.type,
        str(record.filename or ""),
        tuple(round(float(number), 5) for number in numbers),
    )


def _quaternions(pose: Any) -> NDArray[np.float32]:
    if isinstance(pose, Pose):
        rows: Any = pose.raw_pose.detach().cpu().numpy()[..., 3:]
    elif isinstance(pose, (torch.Tensor, np.ndarray)):
        rows = np.asarray(pose.detach().cpu() if isinstance(pose, torch.Tensor) else pose)[..., 3:7]
    else:
        rows = pose.q
    return np.array(rows, np.float32).reshape(-1, 4)
