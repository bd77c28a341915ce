"""Maps a line of one version of a file to the next version."""

from __future__ import annotations

import pytest

from workbench.task.call_graph import line_in

OLD = '''
LIMIT = 3


class Task:
    def lift(self):
        """Lift it."""
        self.up = 1
        self.up = 2  # twice

    @property
    def goal(self):
        def draw():
            return 1
        return draw()
'''


def at(text: str, words: str) -> int:
    (line,) = [i for i, one in enumerate(text.splitlines(), 1) if words in one]
    return line


@pytest.mark.parametrize("words", ["LIMIT = 3", "self.up = 2", "return 1", "return draw()"])
@pytest.mark.parametrize(
    "new",
    [
        OLD,
        "import torch\n\n\n" + OLD,
        OLD.replace("Lift it.", "Lift it,\n        and say so."),
        OLD.replace("self.up = 1", "# first\n        self.up = 1\n"),
        OLD.replace("LIMIT = 3\n", "OTHER = 5\n# three\nLIMIT = 3\n"),
    ],
)
def test_a_line_is_followed_where_only_its_surroundings_changed(words: str, new: str) -> None:
    assert line_in(OLD, new, at(OLD, words)) == at(new, words)


@pytest.mark.parametrize(
    ("words", "new"),
    [
        ("self.up = 2", OLD.replace("self.up = 1", "self.up = 5")),
        ("self.up = 2", OLD.replace("def lift(self)", "def lift(self, more=1)")),
        ("self.up = 2", OLD.replace("def lift", "def raises")),
        ("self.up = 2", OLD.replace("class Task", "class Other")),
        ("return 1", OLD.replace("return 1", "return 2")),
        ("LIMIT = 3", OLD.replace("LIMIT = 3", "LIMIT = 4")),
        ("self.up = 2", "class Task:\n    def lift(self"),
        ("self.up = 2", "\0"),
        ("self.up = 2", ""),
    ],
)
def test_a_changed_function_has_no_matching_line(words: str, new: str) -> None:
    assert line_in(OLD, new, at(OLD, words)) is None


def test_of_equal_lines_the_one_at_the_same_place_is_chosen() -> None:
    old = OLD.replace("self.up = 2  # twice", "self.up = 1")
    new = "import torch\n\n\n" + old.replace("class Task", "# the task\nclass Task")
    for line in (i for i, text in enumerate(old.splitlines(), 1) if "self.up = 1" in text):
        assert line_in(old, new, line) == line + 4


def test_a_line_whose_comment_has_changed_is_the_one_at_the_same_place() -> None:
    new = "import torch\n" + OLD.replace("# twice", "# two times")
    assert line_in(OLD, new, at(OLD, "self.up = 2")) == at(new, "self.up = 2")
