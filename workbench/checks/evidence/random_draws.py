"""Calls in the author's source that draw random numbers."""

from __future__ import annotations

import ast
from collections.abc import Callable

from workbench.checks.evidence.places import Module, Places
from workbench.envs.broken_rule import Place

_SEEDED = {"RandomState", "default_rng", "Generator", "SeedSequence", "PCG64", "Philox", "MT19937", "Random"}
"""Generators that are random only if no seed is given."""
_NO_DRAW = {"seed", "get_state", "set_state", "getstate", "setstate"}
"""Functions of the random modules that draw nothing."""
_TORCH = {
    "bernoulli", "multinomial", "normal", "poisson", "rand", "rand_like", "randint", "randint_like", "randn", "randn_like",
    "randperm",
}  # fmt: skip
_IN_PLACE = {
    "bernoulli_",
    "cauchy_",
    "exponential_",
    "geometric_",
    "log_normal_",
    "normal_",
    "random_",
    "uniform_",
}
"""Methods of a tensor that draw."""
_MANISKILL = "mani_skill.envs.utils.randomization."
"""Module whose functions draw from torch."""


def global_draw(node: ast.AST, module: Module) -> str | None:
    """The call as text, such as ``np.random.rand()``, if the node draws from NumPy's or Python's global
    generator, or from a new generator without a seed. No reset seeds these generators."""
    if not isinstance(node, ast.Call):
        return None
    written, full = _names(node, module)
    first = written.split(".")[0]
    for owner in ("numpy.random.", "random."):
        name = full.removeprefix(owner)
        if name == full or first not in module.imports:
            continue
        top = name.split(".")[0]
        if top in _NO_DRAW or "(" in top or (top in _SEEDED and (node.args or node.keywords)):
            return None
        return f"{written}()"
    if full == "scipy.spatial.transform.Rotation.random" and len(node.args) < 2 and not node.keywords:
        return f"{written}()"
    return None


def torch_draw(node: ast.AST, module: Module) -> str | None:
    """The call as text, such as ``torch.rand()``, if the node draws from torch's global generator, which only a reset seeds."""
    if not isinstance(node, ast.Call) or any(keyword.arg == "generator" for keyword in node.keywords):
        return None
    written, full = _names(node, module)
    of_torch = full.startswith("torch.") and full.removeprefix("torch.") in _TORCH
    in_place = isinstance(node.func, ast.Attribute) and node.func.attr in _IN_PLACE
    return f"{written}()" if of_torch or in_place or full.startswith(_MANISKILL) else None


Draws = Callable[[ast.AST, Module], str | None]


def first_draw(places: Places, draws: Draws, *hooks: str) -> tuple[Place, str] | None:
    """Place and text of the first call that `draws` finds in these hooks and in the author's functions that
    they name."""
    for module, function in places.reached_from(*hooks):
        for node in ast.walk(function):
            if (written := draws(node, module)) is not None:
                return module.place(node, function.name), written
    return None


def _names(node: ast.Call, module: Module) -> tuple[str, str]:
    """The called name as written, and with its first part replaced by what it was imported from."""
    written = ast.unparse(node.func)
    first, *rest = written.split(".")
    return written, ".".join([module.imports.get(first, first), *rest])
