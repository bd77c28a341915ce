"""Commands of the terminal, run in the tests' process."""

from __future__ import annotations

from pathlib import Path

import pytest

from workbench.cli.main import main


def exit_code(*words: object) -> int:
    """Run ``workbench`` with these words; returns its exit code."""
    with pytest.raises(SystemExit) as ended:
        main([str(word) for word in words])
    return int(ended.value.code or 0)


def line_of(file: Path, words: str) -> int:
    """The number of the first line of a file with these words."""
    text = file.read_text()
    return text[: text.index(words)].count("\n") + 1
