"""Hides actors of a batched CPU scene from cameras without moving them."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import cache, wraps
from typing import Any

import sapien.render
from mani_skill.utils.structs.actor import Actor

from workbench.envs import maniskill_private
from workbench.envs.error_notes import RefusedCall
from workbench.envs.simulation.cpu_system import batched_system

_VISIBILITY_ATTRIBUTE = "_workbench_visibility"
"""Attribute of a hidden actor: the actor's render bodies, each with its visibility before it was hidden."""


@cache
def install_hiding() -> None:
    """Make ``Actor.hide_visual`` and ``show_visual`` set the visibility in batched CPU scenes; applied once
    per process.

    Stock ManiSkill does so on the CPU too. In GPU simulation it moves the hidden actor 99999 m away and
    stores its pose. If another struct (a merged actor that contains it) then moves or reads the actor, poses
    are wrong and the actor is visible again (ManiSkill #1447). In scenes that are not batched, the stock
    code still runs.
    """
    stock: property = Actor.__dict__["pose"]
    Actor.pose = property(  # type: ignore[assignment]
        _where_it_is(stock.fget), _where_it_is(stock.fset), doc=stock.__doc__
    )
    Actor.hide_visual = _in_batched_scenes(_hide, Actor.hide_visual)  # type: ignore[method-assign]
    Actor.show_visual = _in_batched_scenes(_show, Actor.show_visual)  # type: ignore[method-assign]


def _in_batched_scenes(ours: Callable[[Any], None], stock: Callable[[Any], None]) -> Callable[[Any], None]:
    @wraps(stock)
    def act(self: Any) -> None:
        if batched_system(self.scene) is None:
            stock(self)
        elif why := why_not_hidden(self):
            raise RefusedCall(f"ManiSkill cannot hide {self.name!r} from cameras: {why}.")
        else:
            ours(self)

    return act


def why_not_hidden(thing: Any) -> str:
    """Why ManiSkill cannot hide a member of ``_hidden_objects``, as a clause; empty if it can.

    Hiding such a member raises RuntimeError in a batched CPU scene, else AssertionError or AttributeError.
    """
    if not isinstance(thing, Actor):
        return f"it is a {type(thing).__name__}, and only actors can be hidden"
    if thing.merged and "has_collision_shapes" not in vars(thing):
        return "it is merged, and may collide. If it does not, set its has_collision_shapes to False first"
    if thing.px_body_type == "static":
        return "it is static. Build it with build_kinematic()"
    return (
        "it has collision shapes. Hide an actor that has visual shapes only"
        if thing.has_collision_shapes
        else ""
    )


def _where_it_is(stock: Any) -> Callable[..., Any]:
    """Wrap ManiSkill's getter or setter of a pose to use the present pose, not the stored pose of a hidden
    actor."""

    @wraps(stock)
    def call(self: Any, *args: Any) -> Any:
        if not self.hidden or batched_system(self.scene) is None:
            return stock(self, *args)
        self.hidden = False
        try:
            return stock(self, *args)
        finally:
            self.hidden = True

    return call


def _hide(actor: Any) -> None:
    if actor.hidden:
        return
    actor.hidden = True
    bodies = (
        thing.find_component_by_type(sapien.render.RenderBodyComponent)
        for thing in maniskill_private.objects_of(actor)
    )
    kept = [(body, body.visibility) for body in bodies if body is not None and body.visibility > 0]
    setattr(actor, _VISIBILITY_ATTRIBUTE, kept)
    for body, _ in kept:
        body.visibility = 0.0


def _show(actor: Any) -> None:
    actor.hidden = False
    for body, visibility in vars(actor).pop(_VISIBILITY_ATTRIBUTE, ()):
        body.visibility = visibility


def shown_visibility(actors: Iterable[Any], body: Any) -> float:
    """Visibility of a render body when it is not hidden, such as 0.3 for a transparent body.

    Args:
        actors: actors that may hide the body.
    """
    hidden = (kept for actor in actors for kept in vars(actor).get(_VISIBILITY_ATTRIBUTE, ()))
    return next((was for other, was in hidden if other is body), body.visibility) or 1.0
