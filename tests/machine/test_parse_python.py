"""Text is parsed in several threads without an error that is none of the text's."""

from __future__ import annotations

import gc
import threading
import time
from pathlib import Path

import pytest

from workbench.machine.parse_python import parse_python


def test_threads_parse_at_once_while_garbage_is_collected(monkeypatch: pytest.MonkeyPatch) -> None:
    text, failures = Path(__file__).read_text() * 20, []

    def parse(depth: int) -> None:
        if depth:
            return parse(depth - 1)
        for _ in range(20):
            try:
                parse_python(text)
            except SystemError as error:
                failures.append(error)

    # What a finalizer does, and hypothesis: another thread may go on in the middle of a tree.
    callbacks = [*gc.callbacks, lambda phase, info: time.sleep(0)]
    monkeypatch.setattr(gc, "callbacks", callbacks)
    threads = [threading.Thread(target=parse, args=(depth,)) for depth in (0, 40, 80, 120)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert failures == []


def test_a_fault_of_the_text_is_told_with_its_line() -> None:
    with pytest.raises(SyntaxError) as told:
        parse_python("x = 1\nif\n", "task.py")
    assert (told.value.lineno, told.value.filename) == (2, "task.py")
