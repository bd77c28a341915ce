"""A policy that the author names: ``module:function`` or ``file.py:function``, obs to action.

The function is called with the task's observation (as its ``obs_mode`` gives it, batched) and returns
an action for all envs: an array or tensor (N, A), one action (A,) for all, or a dict for several
robots.
"""

from __future__ import annotations

import importlib
import importlib.util
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

Policy = Callable[[Any], Any]


def load_policy(reference: str, beside: Path | None = None) -> Policy:
    """Import the function that `reference` names.

    Args:
        beside: a folder in which a relative file is looked for when it is not in the current one.

    Raises:
        ValueError: the reference is not of that form, or names nothing callable.
        Exception: whatever the policy's module raises while it is imported.
    """
    if not reference.strip():
        raise ValueError("name a policy: module:function or file.py:function")
    name, separator, attribute = reference.rpartition(":")
    if not separator or not name or not attribute:
        raise ValueError(f"'{reference}' is not of the form module:function or file.py:function")
    if name.endswith(".py"):
        path = _find(name, beside)
        spec = importlib.util.spec_from_file_location(f"workbench_policy_{path.stem}", path)
        if spec is None or spec.loader is None:
            raise ValueError(f"{path} cannot be imported")
        module = importlib.util.module_from_spec(spec)
        sys.path.insert(0, str(path.parent))
        try:
            spec.loader.exec_module(module)
        finally:
            sys.path.remove(str(path.parent))
    else:
        module = importlib.import_module(name)
    function = getattr(module, attribute, None)
    if not callable(function):
        raise ValueError(f"{name} has no function {attribute}")
    return function


def _find(name: str, beside: Path | None) -> Path:
    """Where the file is: in the folder where the command was started, or else beside the task."""
    path = Path(name).expanduser()
    here = path.resolve()
    if here.is_file():
        return here
    if path.is_absolute() or beside is None or (beside / path).resolve() == here:
        raise ValueError(f"there is no file {here}")
    there = (beside / path).resolve()
    if not there.is_file():
        raise ValueError(
            f"there is no {name} in {Path.cwd()}, where the command was started, nor beside the task in {beside}"
        )
    return there
