"""Removes the current folder from ``sys.path``. Imported first, for that effect."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence


def without_current_folder(path: Sequence[str], python_path: str) -> list[str]:
    """`path` without the current folder. The folder stays if ``PYTHONPATH`` names it, or if this package, the
    standard library or installed packages are in it.

    ``python -m`` and an empty entry of ``PYTHONPATH`` add the current folder: in a downloaded folder, its
    ``numpy.py`` would run.

    Args:
        python_path: the variable ``PYTHONPATH``; folders named there stay, even ``.``.
    """
    try:
        here = os.getcwd()
    except FileNotFoundError:  # the current folder was removed
        return list(path)
    named = {os.path.realpath(entry) for entry in python_path.split(os.pathsep) if entry}
    package = os.path.dirname(os.path.dirname(os.path.dirname(os.path.dirname(os.path.realpath(__file__)))))
    libraries = os.path.dirname(os.path.realpath(os.__file__))
    if here in (*named, package, libraries) or os.path.basename(here) in ("site-packages", "dist-packages"):
        return list(path)
    return [entry for entry in path if os.path.realpath(entry) != here]


sys.path[:] = without_current_folder(sys.path, os.environ.get("PYTHONPATH", ""))
