"""Names of the parts of a task that have changed since it was recorded."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from tests.drive.episodes import made
from workbench.episodes.recorded_source import changed_on_disk, changed_since

THEN = "import numpy as np\n\nSIZE = 1\n\n\nclass Push:\n    def evaluate(self):\n        return {}\n"
NOW = THEN.replace("SIZE = 1", "SIZE = 2  # larger").replace("return {}", "return {'success': 1}")


def test_changed_parts_are_named_and_changed_comments_are_ignored() -> None:
    def since(now: str) -> str:
        return changed_since("push.py", {"push.py": THEN}, "/a/copy.py", {"/a/copy.py": now})

    assert since(NOW) == "SIZE, evaluate"
    assert since(THEN + "# the end\n") == ""
    assert since(THEN.replace("class Push:", "class Push(Base):")) == "Push"
    assert since("".join(f"A{k} = 1\n" for k in range(6)) + THEN) == "A0, A1, A2, A3 and 2 more"
    assert since("def (") == ""
    assert changed_since(None, {}, "/a/copy.py", {}) == ""


def test_the_recorded_task_file_is_compared_with_its_neighbour_modules(tmp_path: Path) -> None:
    (tmp_path / "helpers").mkdir()
    file, beside = tmp_path / "push.py", tmp_path / "helpers" / "shapes.py"
    file.write_text(THEN)
    beside.write_text("WIDTH = 1\n")
    source = {"push.py": THEN, "helpers/shapes.py": "WIDTH = 1\n"}
    info = replace(made(1).info, source_file=str(file), source=source)
    assert changed_on_disk(info) == ""
    beside.write_text("WIDTH = 2\n")
    assert changed_on_disk(info) == "WIDTH of shapes.py"
    beside.unlink()
    assert changed_on_disk(info) == "WIDTH of shapes.py", "a module that is gone has changed too"
    file.unlink()
    assert changed_on_disk(info) == ""
