"""While a process imports, garbage is not looked for; afterwards it is, and not among what was imported."""

from __future__ import annotations

import gc
import sys
from collections.abc import Iterator
from contextlib import redirect_stdout
from io import StringIO

import pytest

from workbench.machine.processes.child_python import quick_imports


@pytest.fixture
def nothing_frozen() -> Iterator[None]:
    frozen = gc.get_freeze_count()
    gc.unfreeze()
    yield
    if frozen:
        gc.freeze()


@pytest.mark.usefixtures("nothing_frozen")
def test_garbage_is_left_alone_meanwhile_and_looked_for_afterwards() -> None:
    sys.modules.pop("this", None)
    with quick_imports(), redirect_stdout(StringIO()):
        import this  # noqa: F401  one that nobody has imported yet

        assert not gc.isenabled() and gc.get_freeze_count() == 0
    assert gc.isenabled() and gc.get_freeze_count() > 10_000


@pytest.mark.usefixtures("nothing_frozen")
def test_where_all_is_imported_already_nothing_is_kept_and_who_had_it_off_has_it_off() -> None:
    gc.disable()
    try:
        with quick_imports():
            import json  # noqa: F401
        assert not gc.isenabled() and gc.get_freeze_count() == 0
    finally:
        gc.enable()


@pytest.mark.usefixtures("nothing_frozen")
def test_an_import_that_fails_is_the_callers_and_garbage_is_looked_for() -> None:
    with pytest.raises(ModuleNotFoundError), quick_imports():
        import no_such_module  # noqa: F401  # pyright: ignore[reportMissingImports]
    assert gc.isenabled()
