"""Garbage collection is off during imports, and afterwards skips the imported objects."""

from __future__ import annotations

import gc
import sys
from contextlib import redirect_stdout
from io import StringIO

import pytest

from workbench.machine.processes.child_environment import quick_imports


def test_garbage_collection_is_off_during_imports_and_on_again_even_after_an_error() -> None:
    frozen = gc.get_freeze_count()
    gc.unfreeze()
    try:
        with pytest.raises(ModuleNotFoundError), quick_imports():
            import no_such_module  # noqa: F401  # pyright: ignore[reportMissingImports]
        assert gc.isenabled()
        sys.modules.pop("this", None)
        with quick_imports(), redirect_stdout(StringIO()):
            import this  # noqa: F401  a module that is not imported yet

            assert not gc.isenabled()
        assert gc.isenabled() and gc.get_freeze_count() > 10_000
    finally:
        gc.unfreeze()
        if frozen:
            gc.freeze()
