"""Checks of what would slow or stop the hooks on a GPU: loops over envs, copies to the host, tensors on the host."""

from __future__ import annotations

import ast
from collections.abc import Iterator

from workbench.checks.evidence.collect import Checkup, Found, NotApplicable, Note
from workbench.checks.evidence.places import Module
from workbench.checks.evidence.tensor_watch import TensorUses
from workbench.checks.evidence.time_step import EVERY_STEP
from workbench.checks.register_rule import rule
from workbench.envs.broken_rule import Place

_ONE_FOR_EACH_ENV = {"num_envs", "_num_envs", "_objs", "_bodies", "sub_scenes"}
_LOOPS = (ast.For, ast.comprehension)


@rule("foreign-device", "warn", "_initialize_episode")
def foreign_device(checkup: Checkup) -> Iterator[Found | Note]:
    """Tensors are made on self.device, by `with torch.device(self.device):` or device=self.device.

    A GPU raises 'Expected all tensors to be on the same device'.

    ## Why
    `torch.zeros(3)` is made on the host. With the CPU backend everything is on the host, so the task works;
    on a GPU the first operation on this tensor and a pose raises *Expected all tensors to be on the same
    device*.

    ## Fix
    Make tensors within the context of the device, or name the device.

    ```python fragment
    with torch.device(self.device):
        offset = torch.tensor([0.0, 0.0, 0.08])
    height = torch.zeros(self.num_envs, device=self.device)
    ```

    ## How it is checked
    The rule runs a build, a reset and three steps with five envs, and follows each tensor from the line that
    makes it: a tensor that is made without a device counts as on the host until it is moved. The finding is
    the author's line in which such a tensor meets a tensor of the env's device. The rule leaves out what a
    GPU accepts: tensors without a dimension, indices from the host, values that are copied into a slice, and
    poses that ManiSkill itself copies to the device. It accepts tensors of unknown origin
    (`torch.Tensor([1])`), and does not see branches that do not run.
    """
    uses: TensorUses = checkup.tensor_uses
    for place, mix in uses.mixes.items():
        here = "in this line" if mix.made[:2] == place[:2] else f"in line {mix.made[1]}"
        if mix.made[0] != place[0]:
            here = f"in {mix.made[0]}:{mix.made[1]}"
        yield Found(
            f"A tensor that was made {here} without a device is combined ({mix.operation}) with one on self.device. On a GPU "
            "this raises. Make the first one with device=self.device, or within `with torch.device(self.device):`.",
            place,
        )


@rule("device-copies", "warn", "evaluate")
def device_copies(checkup: Checkup) -> Iterator[Found | Note]:
    """Hooks that run at every step leave tensors on their device: no `.cpu()`, `.item()`,
    `float(tensor)` or `if tensor:`.

    The GPU has to stop for each copy, in every step.

    ## Why
    A GPU works asynchronously: Python queues operations and goes on. `.item()`, `float(tensor)`, `.cpu()`
    and `if tensor:` need the number now, so Python waits until the queue is empty, and the GPU then waits for
    Python. One copy for each of 4096 envs makes 4096 stops in every step.

    ## Fix
    Compute with tensors only, and choose values by masks.

    ```python fragment
    reward = 1 - torch.tanh(5 * distance)
    reward = torch.where(info["success"], 2.0, reward)  # not: if info["success"][i].item()
    ```

    ## How it is checked
    The rule watches three steps with five envs, after a build and a reset. It counts each copy that a line of
    the author's files makes, including copies by `pose.sp` or `common.to_numpy`. It leaves out copies of
    tensors that would be on the host anyway, and copies in a build or a reset. It does not count an index by
    a mask (`x[mask]`), or copies in other code of ManiSkill.
    """
    uses = checkup.tensor_uses
    for place, count in uses.copies.items():
        yield Found(
            f"{place[2]}() copies a tensor to the host {_how_often(count, uses)} ({uses.written[place]}): a GPU has to "
            "wait each time. Use tensor operations: torch.where instead of if, x.any(dim=1) for a condition, indices and "
            "masks to select rows.",
            place,
        )


def _how_often(count: int, uses: TensorUses) -> str:
    """Text such as ``once in each step``, ``2 times for each env in each step``, or ``4 times in 3 steps`` if steps differ."""
    if count % uses.steps:
        return f"{_times(count)} in {uses.steps} steps"
    a_step = count // uses.steps
    if uses.num_envs > 1 and a_step % uses.num_envs == 0:
        return f"{_times(a_step // uses.num_envs)} for each env in each step"
    return f"{_times(a_step)} in each step"


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"


@rule("loop-over-envs", "warn", "evaluate")
def loop_over_envs(checkup: Checkup) -> Iterator[Found | Note]:
    """Hooks that run at every step do not loop over envs in Python.

    With 4096 envs the loop takes longer than the simulation.

    ## Why
    A loop over N envs runs N small operations instead of one operation on the whole batch. With 16 envs the
    difference does not show. With 4096 envs on a GPU, each operation costs some 10 microseconds, whatever its
    size: a loop of five operations takes 0.2 s, longer than the simulation.

    ## Fix
    Write the operation once for the batch, with `dim=1`, masks and `torch.where`.

    ```python fragment
    distance = torch.linalg.norm(self.cube.pose.p - self.goal.pose.p, dim=1)  # (N,)
    reward = torch.where(distance < 0.05, 1.0, 0.5 - distance)
    ```

    ## How it is checked
    The rule reads the source of the hooks of a step and of the functions that they call, and looks for loops
    and comprehensions over `self.num_envs`, `_objs` and `sub_scenes`. It also runs a build, a reset and three
    steps with five envs, and looks for iterations over the rows of a tensor in the steps. With one env it
    reads only the source: without a finding there, the result is *not known*. Loops in a build or a reset are
    left out. The rule does not see a loop over the length of another batch, as in `range(len(distance))`.
    """
    found: dict[tuple[str, int], Place] = {}
    for module, function in checkup.places.reached_from(*EVERY_STEP):
        for loop in _loops_over_envs(function):
            place = module.place(loop.iter, function.name)
            found.setdefault(place[:2], place)
    # These findings come before anything runs, since the task may raise.
    yield from map(_found_loop, found.values())
    if not any(True for _ in checkup.places.reached_from(*EVERY_STEP)):
        raise NotApplicable("the task has no hook of its own that runs at every step")
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


def _loops_over_envs(function: ast.FunctionDef) -> Iterator[ast.For | ast.comprehension]:
    """The loops and comprehensions of a function that go over the envs: their iterable names something with
    an item for each env."""
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
    """Whether the expression is ``self.num_envs`` or ``len(env_idx)``."""
    if isinstance(node, ast.Attribute):
        return node.attr in ("num_envs", "_num_envs")
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "len":
        return any(isinstance(part, ast.Name) and part.id == "env_idx" for part in ast.walk(node))
    return False


def _is_loop(checkup: Checkup, place: Place) -> bool:
    """Whether a loop or comprehension iterates at this line, in contrast to ``x, y = tensor``."""
    module: Module | None = next((each for each in checkup.places.modules if each.file == place[0]), None)
    return module is not None and any(
        isinstance(node, _LOOPS) and node.iter.lineno <= place[1] <= (node.iter.end_lineno or 0)
        for node in ast.walk(module.tree)
    )
