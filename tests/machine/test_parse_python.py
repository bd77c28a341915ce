"""Parsing in several threads raises only errors of the text itself."""

from __future__ import annotations

import gc
import sys
import threading
import time
from pathlib import Path

import pytest

from workbench.machine.parse_python import parse_python

pytestmark = pytest.mark.thorough

PACKAGE = Path(__file__).parents[2] / "workbench"


def test_threads_can_parse_during_garbage_collection() -> None:
    text, failures = (PACKAGE / "envs" / "maniskill_private.py").read_text(), []

    def parse(depth: int) -> None:
        if depth:
            return parse(depth - 1)
        for _ in range(25):
            try:
                parse_python(text)
            except SystemError as error:
                failures.append(error)

    def switch_thread(phase: str, info: dict[str, int]) -> None:
        """Switch threads during a collection, as a finalizer may, while the parser builds a tree."""
        time.sleep(0)

    threads = [threading.Thread(target=parse, args=(depth,)) for depth in (0, 30, 60, 90)]
    before = sys.getswitchinterval()
    gc.callbacks.append(switch_thread)
    sys.setswitchinterval(1e-5)
    try:
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    finally:
        sys.setswitchinterval(before)
        gc.callbacks.remove(switch_thread)
    assert failures == []


def test_a_syntax_error_has_its_line_and_file() -> None:
    with pytest.raises(SyntaxError) as raised:
        parse_python("x = 1\nif\n", "task.py")
    assert (raised.value.lineno, raised.value.filename) == (2, "task.py")
