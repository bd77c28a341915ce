"""Finds where the values of a running call are written; each call is made by source text that really runs."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from tests.cameras.edit.real_cameras import FILE, modules
from workbench.source.definitions import Project
from workbench.source.parsed import Trace, TracedValue
from workbench.source.read_values import DEGREE, trace_call

pytestmark = pytest.mark.usefixtures("clean_process")

HEAD = """\
import math
import numpy as np
import sapien
import torch
from mani_skill.utils import sapien_utils
from mani_skill.utils.sapien_utils import look_at
from mani_skill.utils.structs import Pose
from transforms3d.euler import euler2quat
"""
PLACES = "/author/places.py"


def traced(text: str, others: Mapping[str, str] | None = None, **instead: Any) -> tuple[Project, Trace]:
    """Trace the last call of ``note(a, b)`` in the text. `instead` replaces the values of its arguments."""
    sources = {FILE: HEAD + text, **(others or {})}
    project = Project(sources)
    found: list[Trace | None] = []

    def note(*given: Any, **named: Any) -> None:
        values = {**dict(zip("ab", given, strict=False)), **named, **instead}
        found.append(trace_call(project, sys._getframe(1), ("a", "b"), values))

    with modules(sources, note=note):
        pass
    assert found[-1] is not None
    return project, found[-1]


def described(text: str, others: Mapping[str, str] | None = None, **instead: Any) -> str:
    """Describe the trace of the first argument: its text, the values changed in it, and the names that led there."""
    project, trace = traced(text, others, **instead)
    if "a" in trace.unknown:
        assert "a" not in trace.parts
        return trace.unknown["a"]
    return description_of(project, trace.parts["a"])


def description_of(project: Project, part: TracedValue) -> str:
    text = project.texts[part.at.file][part.at.start : part.at.end]
    inside = ""
    if "of" in part.parts:
        per = "degrees" if part.slope == DEGREE else f"{part.slope:g}"
        inside = (
            f" {{{description_of(project, part.parts['of'])} times {per} plus {round(part.offset, 5) + 0:g}}}"
        )
    elif part.parts:
        inside = f" {{{', '.join(description_of(project, item) for item in part.parts.values())}}}"
    reads = [
        project.texts[read.at.file][read.at.start : read.at.end]
        + (f" ({read.others})" if read.others else "")
        for read in part.reads
    ]
    return f"{part.function}{text}{inside}" + "".join(f" < {read}" for read in reads)


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("note(1.5)", "1.5"),
        ("note(None)", "None"),
        ("X = 1.5\nnote(X)", "1.5 < X"),
        ("X: float = 1.5\nY = X\nnote(a=Y)", "1.5 < Y < X"),
        ("X, (Y, Z) = 1.5, (2.5, 3.5)\nnote(Y)", "2.5 < Y"),
        ("X = 2\nnote((1, X))", "(1, X) {1, 2 < X}"),
        ("X = 2\nnote(Y := X)", "`Y := X` is computed when the task runs"),
        # Numbers within an expression.
        ("note(60 * np.pi / 180)", "60 * np.pi / 180 {60 times degrees plus 0}"),
        ("note(math.radians(30))", "math.radians(30) {30 times degrees plus 0}"),
        ("A = 30\nnote(np.deg2rad(A))", "np.deg2rad(A) {30 < A times degrees plus 0}"),
        ("H = 0.2\nnote(H + 0.25)", "H + 0.25 {0.25 times 1 plus 0.2}"),
        ("H = 0.2\nnote(0.5 - H)", "0.5 - H {0.5 times 1 plus -0.2}"),
        ("H = 0.2\nnote(H - 0.5 + 0.25)", "H - 0.5 + 0.25 {0.25 times 1 plus -0.3}"),
        ("H = 0.2\nnote(2 * H)", "2 * H"),
        ("V = np.array([1, 2])\nnote(V + [0, 1])", "V + [0, 1]"),
        # Functions that only store their arguments.
        ("note(float(2))", "2"),
        ("note(np.array([1, 2]))", "[1, 2] {1, 2}"),
        ("V = [1, 2]\nnote(torch.tensor(V))", "torch.tensor(V) {1 < V, 2 < V}"),
        ("note(Pose.create(sapien.Pose([1, 2, 3])))", "posesapien.Pose([1, 2, 3]) {[1, 2, 3] {1, 2, 3}}"),
        (
            "note(look_at([1, 0, 1], [0, 0, 0], device=None))",
            "look_atlook_at([1, 0, 1], [0, 0, 0], device=None) {[1, 0, 1] {1, 0, 1}, [0, 0, 0] {0, 0, 0}}",
        ),
        ("note(euler2quat(0, 0, ak=1))", "eulereuler2quat(0, 0, ak=1) {0, 0, 1}"),
        # Choices.
        ("F = True\nnote(1.5 if F else 2.5)", "1.5"),
        ("F, K = False, 'b'\nX = 2.5 if not F and K != 'a' else 1.5\nnote(X)", "2.5 < X"),
        # Elements.
        ('D = {"x": 1, "eye": [1, 2]}\nnote(D["eye"])', '[1, 2] {1 < D["eye"], 2 < D["eye"]} < D["eye"]'),
        ('D = dict(x=1, eye=2)\nnote(D["eye"])', '2 < D["eye"]'),
        ('D = dict(x=1, eye=2)\nnote(D["eye"])\nD["eye"]', '2 < D["eye"] (line 11)'),
        ("L = [[1, 2], [3, 4]]\nnote(L[1][0])", "3 < L[1][0]"),
        ("L = (1, 2)\nM = L\nnote(M[-1])", "2 < M[-1]"),
        ("L, I = (1, 2), 1\nnote(L[I])", "2 < L[I]"),
    ],
)
def test_a_value_is_traced_to_where_it_is_written(text: str, what: str) -> None:
    assert described(text) == what


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("note(True)", "`True` is computed when the task runs"),
        ("note(f'{1}')", "`f'{1}'` is computed when the task runs"),
        ("note(np.sqrt(max(2, 3)))", "`max(2, 3)` is computed when the task runs"),
        ("note(np.sqrt(*[2]))", "`np.sqrt(*[2])` is computed when the task runs"),
        ("note(1.5 if max(1, 2) else 2)", "`max(1, 2)` is computed when the task runs"),
        ("note(*[1])", "`a` is given by * or **"),
        ("import places\nnote(places)", "`places` comes from places, which is not one of your files"),
        ("def f(x):\n    note(x)\nf(1)", "`x` cannot be read in the file: it is a parameter of f"),
        ("X = 1\nX += 1\nnote(X)", "`X` cannot be read in the file: it is computed"),
        ("L = [1, 2]\nL[0] = 3\nnote(L)", "`L` cannot be read in the file: a part of it is set"),
        ("for x in (1,):\n    note(x)", "`x` cannot be read in the file: it changes in a loop"),
        ("L = [1, 2]\nnote(L[int(0)])", "`L[int(0)]` depends on a value that only the running task has"),
        ('D = {**{"x": 1}, "y": 2}\nnote(D["y"])', '`D["y"]` is computed when the task runs'),
        (
            "class A(list):\n    def __eq__(self, other):\n        return self.pop() == other\n"
            "X = A([1])\nnote(1.5 if X == 1 else 2.5)",
            "`X == 1` is computed when the task runs",
        ),
        (
            "for _ in range(2):\n    if _:\n        X = 1\n    else:\n        X = 1\n    note(X)",
            "`X` gets the same value in lines 11 and 13, and it is unknown which of them ran",
        ),
    ],
)
def test_an_untraceable_value_is_unknown_with_the_reason(text: str, why: str) -> None:
    assert described(text, {PLACES: ""}) == why


def test_a_value_that_differs_from_the_text_is_computed() -> None:
    assert described("X = 1.5\nnote(X)", a=1.5000001) == "1.5 < X"
    assert described("X = 1.5\nnote(X)", a=1.6) == "`X` is computed when the task runs"
    assert described("X = [1, 2]\nnote(X)", a=[1, 2, 3]) == "`X` is computed when the task runs"
    assert described("note('x')", a="y") == "`'x'` is computed when the task runs"
    assert described("note(None)", a=0.0) == "`None` is computed when the task runs"
    assert described("note(None)", a=np.zeros(1)) == "`None` is computed when the task runs"


TASK = """\
class Parent:
    eye = 1.5
    far = 9.0

class Task(Parent):
    eye = 2.5
    near = 0.5
    def __init__(self):
        self.own = 3.5
    def hook(self, more=1.0):
        {}
    @classmethod
    def made(cls):
        note(cls.near)
    @property
    def half(self):
        return 0.5

task = Task()
task.hook()
"""


@pytest.mark.parametrize(
    ("call", "what"),
    [
        ("note(self.eye)", "2.5 < self.eye"),
        ("note(Task.eye)", "2.5 < Task.eye"),
        ("note(Parent.eye)", "1.5 < Parent.eye"),
        ("note(self.far)", "9.0 < self.far"),
        ("note(self.own)", "3.5 < self.own"),
        ("self.made()", "0.5 < cls.near"),
        ("note(self.half)", "`self.half` cannot be read in the file: half is a function or class"),
        ("note(more)", "`more` cannot be read in the file: it is a parameter of hook"),
        ("vars(self)['x'] = 1; note(self.x)", "the assignment of `self.x` is not found in the file"),
    ],
)
def test_attributes_are_those_of_the_running_object(call: str, what: str) -> None:
    assert described(TASK.format(call)) == what


OTHER = """
class Other:
    def __init__(self):
        self.own = 7.5
    def look(self):
        return self.own
    @staticmethod
    def move(task):
        {}
"""


def test_an_attribute_of_an_unrelated_class_is_not_followed() -> None:
    note = TASK.format("note(self.own)")
    assert described(OTHER.format("pass") + note) == "3.5 < self.own"
    assert described(f"import places\n{note}", {PLACES: OTHER.format("pass")}) == "3.5 < self.own"
    # A parameter may be any object, and a class that inherits from both gets the attribute from either.
    assert "places.py:9 in Other.move" in described(
        f"import places\n{note}", {PLACES: OTHER.format("task.own = 1.0")}
    )
    both = OTHER.format("pass") + note.replace("class Task(Parent)", "class Task(Parent, Other)")
    assert "in Other.__init__" in described(both) and "in Task.__init__" in described(both)
    child = note.replace(
        "task = Task()", "class Child(Task):\n    def look(self): return self.own\n\ntask = Task()"
    )
    assert described(child).startswith("3.5 < self.own (line "), (
        "editing the line would change the child's too"
    )


def test_an_attribute_of_a_class_within_a_function_is_followed() -> None:
    text = """
def made():
    class Rig:
        def __init__(self):
            self.height = 1.5
        def look(self):
            note(self.height)
    return Rig()
made().look()
"""
    assert described(text).startswith("1.5 < self.height")


def test_a_call_on_a_newly_created_owner_is_not_repeated() -> None:
    text = """\
made = []
class Eye:
    x = 1.5
def eye():
    made.append(1)
    return Eye()
note(eye().x)
assert len(made) == 1
"""
    assert described(text) == "`eye().x` is computed when the task runs"


@pytest.mark.parametrize(
    ("text", "others", "what"),
    [
        ("import places\nnote(places.X)", "X = 1.5", "1.5 < places.X"),
        (
            "from places import X\nnote(X)",
            "A = 0.5\nX = A + 0.25",
            "A + 0.25 {0.25 < X times 1 plus 0.5} < X",
        ),
        ("from places import X\nnote(X)", "from more import X", "1.5 < X (places.py, line 1)"),
        ("from places import *\nnote(X)", "X = 1.5", "X"),
        ("import places\nnote(places.X)", "Y = X = 1.5", "1.5 < places.X (line 1 gives it to several names)"),
        ("from math import *\nnote(pi / 180 * 5)", "", "pi / 180 * 5 {5 times degrees plus 0}"),
        ("from places import X\nnote(X)", "X = max(1, 2)", "`max(1, 2)` is computed when the task runs"),
        (
            "from places import X\nnote(X)",
            "X = 1\nX += 1",
            "none of the assignments to `X` (lines 1 and 2) gives its current value",
        ),
        (
            "import places\nnote(places.X)",
            "X = 1.5\ndef f():\n    return X",
            "1.5 < places.X (places.py, line 3)",
        ),
    ],
)
def test_constants_are_traced_into_neighbour_files(text: str, others: str, what: str) -> None:
    more = {"/author/more.py": "X = 1.5"} if "more" in others else {}
    assert described(text, {**more, PLACES: others}) == what


def test_of_several_assignments_the_one_with_the_running_value_is_chosen() -> None:
    text = "X = 1.5\ndef f():\n    note(X)\nif len('ab') > 1:\n    X = 2.5\nelse:\n    X = max(3, 4)\nf()"
    assert described(text) == "2.5 < X"
    text = text.removesuffix("f()") + "vars()['X'] = 7.5\nf()"
    assert described(text) == "none of the assignments to `X` (lines 9 and 13 and 15) gives its current value"


def test_values_in_a_function_are_read_from_its_frame() -> None:
    text = """\
X = 1.5
def f(flag):
    if flag:
        X = 2.5
    else:
        X = 3.5
    def g():
        note([X, Y])
    Y = 4.5
    g()
f(False)
"""
    assert described(text) == "[X, Y] {3.5 < X, 4.5 < Y}"
