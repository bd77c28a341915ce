"""Checks of what would slow or stop the hooks on a GPU: loops over envs, copies to the host, tensors on the host."""

from __future__ import annotations

import ast
from collections.abc import Iterator, Mapping

from workbench.checks.evidence.checkup import Check, Checkup, Found, NotApplicable, Note
from workbench.checks.evidence.places import Module
from workbench.checks.evidence.tensor_watch import TensorUses
from workbench.checks.evidence.time_step import EVERY_STEP
from workbench.envs.broken_rule import Place

_ONE_FOR_EACH_ENV = {"num_envs", "_num_envs", "_objs", "_bodies", "sub_scenes"}
_LOOPS = (ast.For, ast.comprehension)


def loop_over_envs(checkup: Checkup) -> Iterator[Found | Note]:
    """By the source of what the hooks of a step call, and by which tensors were iterated."""
    found: dict[tuple[str, int], Place] = {}
    for module, function in checkup.places.reached_from(*EVERY_STEP):
        for loop in _loops_over_envs(function):
            place = module.place(loop.iter, function.name)
            found.setdefault(place[:2], place)
    # Before anything runs: of a task that raises they are known too.
    yield from map(_found_loop, found.values())
    if not any(True for _ in checkup.places.reached_from(*EVERY_STEP)):
        raise NotApplicable("it has no hook of its own that runs at every step")
    for place in checkup.tensor_uses.iterated:
        if _is_loop(checkup, place) and place[:2] not in found:
            found[place[:2]] = place
            yield _found_loop(place)
    if not found:
        checkup.require_several()


def _found_loop(place: Place) -> Found:
    return Found(
        f"{place[2]}() goes through the envs one by one in Python, at every step. Write it once for the whole "
        "batch: pose.p is (N, 3), torch.linalg.norm(x, dim=1) gives (N,), torch.where(mask, a, b) chooses by env.",
        place,
    )


def device_copies(checkup: Checkup) -> Iterator[Found | Note]:
    """Over a few steps."""
    uses = checkup.tensor_uses
    for place, count in uses.copies.items():
        yield Found(
            f"{place[2]}() copies a tensor to the host {_how_often(count, uses)} ({uses.written[place]}): a GPU has to "
            "wait each time. Stay in tensors: torch.where for an if, x.any(dim=1) for a condition, indices and masks for "
            "rows.",
            place,
        )


def _how_often(count: int, uses: TensorUses) -> str:
    """``once in each step``, ``2 times for each env in each step``; ``4 times in 3 steps`` where they differ."""
    if count % uses.steps:
        return f"{_times(count)} in {uses.steps} steps"
    a_step = count // uses.steps
    if uses.num_envs > 1 and a_step % uses.num_envs == 0:
        return f"{_times(a_step // uses.num_envs)} for each env in each step"
    return f"{_times(a_step)} in each step"


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"


def foreign_device(checkup: Checkup) -> Iterator[Found | Note]:
    """At a build, a reset and a few steps."""
    uses: TensorUses = checkup.tensor_uses
    for place, mix in uses.mixes.items():
        here = "in this line" if mix.made[:2] == place[:2] else f"in line {mix.made[1]}"
        if mix.made[0] != place[0]:
            here = f"in {mix.made[0]}:{mix.made[1]}"
        yield Found(
            f"a tensor that was made {here} without a device meets one that is on self.device ({mix.operation}). "
            "On a GPU this raises. Make it with device=self.device, or within `with torch.device(self.device):`.",
            place,
        )


def _loops_over_envs(function: ast.FunctionDef) -> Iterator[ast.For | ast.comprehension]:
    counts = {"env_idx"} | {
        target.id
        for node in ast.walk(function)
        if isinstance(node, ast.Assign) and _is_count(node.value)
        for target in node.targets
        if isinstance(target, ast.Name)
    }
    for node in ast.walk(function):
        if isinstance(node, _LOOPS) and any(
            isinstance(part, ast.Attribute)
            and part.attr in _ONE_FOR_EACH_ENV
            or isinstance(part, ast.Name)
            and part.id in counts
            for part in ast.walk(node.iter)
        ):
            yield node


def _is_count(node: ast.expr) -> bool:
    """``self.num_envs``, ``len(env_idx)``."""
    if isinstance(node, ast.Attribute):
        return node.attr in ("num_envs", "_num_envs")
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "len":
        return any(isinstance(part, ast.Name) and part.id == "env_idx" for part in ast.walk(node))
    return False


def _is_loop(checkup: Checkup, place: Place) -> bool:
    """Whether a loop is in this line, and not ``x, y = tensor``."""
    module: Module | None = next((each for each in checkup.places.modules if each.file == place[0]), None)
    return module is not None and any(
        isinstance(node, _LOOPS) and node.iter.lineno <= place[1] <= (node.iter.end_lineno or 0)
        for node in ast.walk(module.tree)
    )


CHECKS: Mapping[str, Check] = {
    "foreign-device": foreign_device,
    "device-copies": device_copies,
    "loop-over-envs": loop_over_envs,
}
