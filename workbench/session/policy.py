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


def load_policy(reference: str) -> Policy:
    """Import the function that `reference` names.

    Raises:
        ValueError: the reference is not of that form, or names nothing callable.
        Exception: whatever the policy's module raises while it is imported.
    """
    name, separator, attribute = reference.rpartition(":")
    if not separator or not name or not attribute:
        raise ValueError(f"'{reference}' is not of the form module:function or file.py:function")
    if name.endswith(".py"):
        path = Path(name).expanduser().resolve()
        if not path.is_file():
            raise ValueError(f"there is no file {path}")
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
