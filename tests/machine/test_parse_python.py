"""Text is parsed in several threads without an error that is none of the text's."""

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


def test_threads_parse_at_once_while_garbage_is_collected() -> None:
    text, failures = (PACKAGE / "envs" / "maniskill_private.py").read_text(), []

    def parse(depth: int) -> None:
        if depth:
            return parse(depth - 1)
        for _ in range(25):
            try:
                parse_python(text)
            except SystemError as error:
                failures.append(error)

    def go_on(phase: str, info: dict[str, int]) -> None:
        """As a finalizer may, and what hypothesis does: another thread goes on in the middle of a tree."""
        time.sleep(0)

    threads = [threading.Thread(target=parse, args=(depth,)) for depth in (0, 30, 60, 90)]
    before = sys.getswitchinterval()
    gc.callbacks.append(go_on)
    sys.setswitchinterval(1e-5)
    try:
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    finally:
        sys.setswitchinterval(before)
        gc.callbacks.remove(go_on)
    assert failures == []


def test_a_fault_of_the_text_is_told_with_its_line() -> None:
    with pytest.raises(SyntaxError) as told:
        parse_python("x = 1\nif\n", "task.py")
    assert (told.value.lineno, told.value.filename) == (2, "task.py")
