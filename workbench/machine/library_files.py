"""Tells source files of libraries from those that a person wrote."""

from __future__ import annotations

import importlib.util
import os
import sysconfig
from functools import cache
from pathlib import Path


@cache
def is_installed(file: str) -> bool:
    """Whether a source file belongs to Python, to an installed package or to the workbench.

    Also True for a name that is not an absolute path: such a name belongs to an executed string, or to
    compiled code, which names its sources by relative paths.
    """
    if not os.path.isabs(file) or file.startswith(_roots()):
        return True
    return not {"site-packages", "dist-packages"}.isdisjoint(Path(file).parts)


@cache
def _roots() -> tuple[str, ...]:
    """Folders of Python, ManiSkill (which may be installed from its repository) and the workbench."""
    folders = [Path(sysconfig.get_paths()["stdlib"]), Path(__file__).parents[1]]
    spec = importlib.util.find_spec("mani_skill")
    folders += [] if spec is None else [Path(place) for place in spec.submodule_search_locations or ()]
    return tuple(f"{folder}{os.sep}" for folder in folders)
