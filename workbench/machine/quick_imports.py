"""What torch, ManiSkill and rerun take to be imported: a quarter less. For the beginning of a process."""

from __future__ import annotations

import gc
import sys
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def quick_imports() -> Iterator[None]:
    """Look for no garbage meanwhile, and never again among what was imported.

    Of a million objects that are made then ten thousand are garbage. Afterwards BaseEnv would look through the rest at
    every build and every close: 0.25 s each, most of a reload of 16 envs.
    """
    before, enabled = len(sys.modules), gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if len(sys.modules) > before:  # else what others have left by now would be kept with it
            gc.freeze()
        if enabled:
            gc.enable()
