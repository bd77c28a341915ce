"""An exception is reported with the author's line, the hook and a message."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from workbench.task.load import LoadedTask, load_task
from workbench.task.problem import (
    Interrupted,
    Problem,
    TaskError,
    definition_line,
    hook_definition,
    problem_from_exception,
    shorten,
)

pytestmark = pytest.mark.thorough

Write = Callable[..., Path]


def caught(
    call: Callable[[], object], files: tuple[Path, ...], stage: str = "step", cls: type | None = None
) -> Problem:
    try:
        call()
    except BaseException as exc:
        assert exc.__traceback__ is not None
        return problem_from_exception(exc.with_traceback(exc.__traceback__.tb_next), stage, files, cls)
    raise AssertionError("nothing was raised")


def of_a_library(text: str, **names: Any) -> Callable[[], object]:
    """The function that `text` defines, as if it came from an installed package."""
    exec(compile(text, "/x/site-packages/library.py", "exec"), names)
    return next(reversed(names.values()))


@pytest.fixture
def task(write: Write) -> LoadedTask:
    return load_task(str(write("push.py", TASK, task=True)))


TASK = """
import torch

def ping(n):
    return pong(n)

def pong(n):
    return ping(n)

class PushEnv(BaseEnv):
    def __init__(self):
        pass

    def evaluate(self):
        raise KeyError("cube")

    def compute_dense_reward(self, obs, action, info):
        return torch.zeros(2) + torch.zeros(3)

    def compute_normalized_dense_reward(self, obs, action, info):
        return self.compute_dense_reward(obs, action, info) / 2

    def _get_obs_extra(self, info):
        return self.evaluate()

    def _load_scene(self, options):
        try:
            self.evaluate()
        except KeyError as exc:
            raise RuntimeError("no scene") from exc

    def _initialize_episode(self, env_idx, options):
        try:
            {}["a"]
        except KeyError:
            {}["b"]

    @property
    def _default_sensor_configs(self):
        return unknown_name

    def helper(self):
        assert self.evaluate is None

    def swallowed(self):
        try:
            1 / 0
        except ZeroDivisionError as exc:
            import json
            json.loads("{")

    def deep(self):
        ping(0)

    def long(self):
        raise ValueError("x" * 100_000 + "\\nsecond")

    def unprintable(self):
        class Odd(Exception):
            def __str__(self):
                raise RuntimeError
        raise Odd
"""


@pytest.mark.parametrize(
    ("method", "args", "stage", "message", "code"),
    [
        ("evaluate", 0, "evaluate", "KeyError: 'cube'", 'raise KeyError("cube")'),
        (
            "compute_normalized_dense_reward",
            3,
            "reward",
            "RuntimeError: The size of tensor",
            "return torch.zeros(2) + torch.zeros(3)",
        ),
        ("_get_obs_extra", 1, "evaluate", "KeyError: 'cube'", 'raise KeyError("cube")'),
        ("_load_scene", 1, "build", "RuntimeError: no scene", 'raise RuntimeError("no scene") from exc'),
        ("_initialize_episode", 2, "reset", "KeyError: 'b'", '{}["b"]'),
        ("helper", 0, "step", "AssertionError: assert self.evaluate is None", "assert self.evaluate is None"),
        ("swallowed", 0, "step", "JSONDecodeError", 'json.loads("{")'),
        ("unprintable", 0, "step", "its __str__ raised RuntimeError", "raise Odd"),
    ],
)
def test_the_place_is_the_authors_innermost_line_and_the_stage_is_the_hook(
    method: str, args: int, stage: str, message: str, code: str, task: LoadedTask
) -> None:
    env = task.cls()
    problem = caught(lambda: getattr(env, method)(*[None] * args), task.source_files)
    assert (problem.stage, problem.code) == (stage, code)
    assert message in problem.message
    assert problem.file == str(task.file)
    text = task.source[str(task.file)].splitlines()
    assert problem.line is not None and text[problem.line - 1].strip() == code
    assert problem.message.partition(":")[0].split(" ")[0] in problem.traceback or method == "unprintable"


def test_a_library_error_caused_by_the_authors_code_has_the_authors_line(task: LoadedTask) -> None:
    env = task.cls()

    call = of_a_library(
        "def call():\n try: env.evaluate()\n except KeyError as exc: raise OSError('could not go on') from exc",
        env=env,
    )
    problem = caught(call, task.source_files)
    assert problem.code == 'raise KeyError("cube")'
    assert problem.message.index(f"KeyError: 'cube' (push.py:{problem.line})") < problem.message.index(
        "OSError"
    )


def test_where_no_author_line_ran_the_message_names_the_line_that_raised() -> None:
    call = of_a_library("def inner(): raise OSError('no device')\n\n\ndef outer(): inner()")
    problem = caught(call, ())
    assert problem.message.endswith("(raised at /x/site-packages/library.py:1)")


def test_where_no_author_line_ran_the_hook_with_the_wrong_result_is_blamed(task: LoadedTask) -> None:
    env = task.cls()

    # ManiSkill fails like this when evaluate() returns None.
    get_info = of_a_library("def get_info(): dict(**None)")
    problem = caught(get_info, task.source_files, "step", type(env))
    assert (problem.stage, problem.code) == ("evaluate", "def evaluate(self):")
    nobody = caught(get_info, (), "step", type(env))
    assert (nobody.stage, nobody.file, nobody.line, nobody.code) == ("evaluate", None, None, None)


def test_endless_recursion_and_endless_messages_are_bounded(task: LoadedTask) -> None:
    env = task.cls()
    deep = caught(env.deep, task.source_files)  # type: ignore[attr-defined]
    assert deep.code in ("return pong(n)", "return ping(n)")
    assert "lines left out" in deep.traceback and len(deep.traceback.splitlines()) < 250
    long = caught(env.long, task.source_files)  # type: ignore[attr-defined]
    assert len(long.message) <= 500 and "\n" not in long.message
    assert len(long.traceback) < 20_000
    # People read the end of a traceback first.
    assert deep.traceback.splitlines()[-1].startswith("RecursionError")


def test_the_stage_of_a_policy_or_an_import_is_kept(task: LoadedTask) -> None:
    for stage in ("policy", "import", "worker", "syntax"):
        assert caught(task.cls().evaluate, task.source_files, stage).stage == stage


def test_a_hook_with_other_arguments_is_blamed_for_a_call_that_it_cannot_take(write: Write) -> None:
    text = """
class Base(BaseEnv):
    def __init__(self): pass
    def evaluate(self): pass
    def fine(self, obs): pass

class PushEnv(Base):
    def evaluate(self, obs): pass
    def fine(self, obs, more=1): pass
"""
    task = load_task(str(write("push.py", text, task=True)))
    env = task.cls()
    call = of_a_library("def call(): env.fine(); env.evaluate()", env=env)
    problem = caught(call, task.source_files, "step", type(env))
    assert problem.code == "def evaluate(self, obs): pass"
    call = of_a_library("def call(): return len(3)", env=env)
    assert caught(call, task.source_files, "step", type(env)).line is None


def test_a_similar_name_is_suggested_where_there_is_one(write: Write) -> None:
    text = """
class PushEnv(BaseEnv):
    height = 1
    def __init__(self): pass
    def wrong_attribute(self): return self.heigth
    def wrong_name(self):
        distance = 1
        return distanse
    def far_off(self): return self.qqqqqqqq
    def loop(self):
        try:
            return self.wrong_attribute()
        except AttributeError as error:
            raise AttributeError("no height. Did you mean 'x'?", name="heigth", obj=self) from error
"""
    task = load_task(str(write("push.py", text, task=True)))
    env: Any = task.cls()
    assert "'height'" in caught(env.wrong_attribute, task.source_files).message
    assert "'distance'" in caught(env.wrong_name, task.source_files).message
    assert "mean" not in caught(env.far_off, task.source_files).message
    assert caught(env.loop, task.source_files).message.count("Did you mean") <= 2


def test_a_constructor_that_only_calls_its_base_is_not_blamed_for_a_hook(write: Write) -> None:
    text = """
class Base(BaseEnv):
    def __init__(self, fails=""):
        self.fails = fails
        library(self)

class PushEnv(Base):
    def __init__(self, fails=""):
        super().__init__(fails)
        if fails == "own":
            1 / 0
"""
    task = load_task(str(write("push.py", text, task=True)))
    module = sys.modules[task.cls.__module__]
    vars(module)["library"] = of_a_library("def library(env):\n if env.fails == 'base': [][1]")
    own = caught(lambda: task.cls("own"), task.source_files, "build")  # type: ignore[arg-type]
    assert own.code == "1 / 0"
    base = caught(lambda: task.cls("base"), task.source_files, "build")  # type: ignore[arg-type]
    assert base.code == "library(self)"


def test_an_assertion_with_a_message_is_shown_with_it_and_a_stop_by_hand_as_one(task: LoadedTask) -> None:
    def stops() -> None:
        raise Interrupted("by hand")

    def asserts() -> None:
        raise AssertionError("too far")

    assert caught(stops, task.source_files).interrupted and not caught(asserts, task.source_files).interrupted
    assert caught(asserts, (Path(__file__),)).message == "AssertionError: too far"


def test_a_syntax_error_has_its_column_and_a_definition_its_line(write: Write) -> None:
    path = write("push.py", "if True:\n    x = = 1\n")
    with pytest.raises(TaskError) as wrong:
        load_task(str(path))
    problem = wrong.value.problem
    assert (problem.line, problem.code, problem.column) == (2, "x = = 1", 5)
    decorated = write(
        "more.py",
        """
import functools
def note(function):
    @functools.wraps(function)
    def inner(*args): return function(*args)
    return inner
class Task(BaseEnv):
    @note
    @note
    def hook(self): pass
    @property
    def far(self): pass
    plain = 1
""",
        task=True,
    )
    cls = load_task(str(decorated)).cls
    lines = decorated.read_text().splitlines()
    for name in ("hook", "far"):
        place = definition_line(vars(cls)[name])
        assert place is not None and place[0] == str(decorated)
        assert lines[place[1] - 1].strip().startswith(f"def {name}")
    assert definition_line(vars(cls)["plain"]) is None
    assert hook_definition(cls, ("gone", "far", "hook"), [decorated]) == (
        "far",
        definition_line(vars(cls)["far"]),
    )
    inherits = type("Sub", (cls,), {})
    found = hook_definition(inherits, ("hook",), [decorated])
    assert found is not None and found[0] == "hook"
    assert hook_definition(cls, ("hook",), []) is None


@given(st.text(), st.integers(min_value=1, max_value=80))
def test_a_shortened_text_is_one_line_of_bounded_length(text: str, limit: int) -> None:
    short = shorten(text, limit)
    assert len(short) <= limit
    assert len(short.splitlines()) <= 1
    if len(text) <= limit and text == " ".join(text.split()):
        assert short == text
    elif len(text) > 8 * limit and not text[: 8 * limit].isspace():
        assert short
    if short != " ".join(text[: 8 * limit].split()):
        assert len(short) == limit
