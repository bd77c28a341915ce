"""The command line that the page shows gives the same options when typed."""

from __future__ import annotations

import shlex
from typing import Any

import pytest
import tyro
from hypothesis import given, settings
from hypothesis import strategies as st

from workbench.cli.arguments import EnvArguments
from workbench.task.description import TaskOptions, changed_options, command_line

pytestmark = pytest.mark.thorough

JSON = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**60), 2**60) | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(max_size=12),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner, max_size=2),
    max_leaves=5,
)  # fmt: skip
NAMES = st.from_regex(r"[a-z_]{1,8}", fullmatch=True)


def typed(line: str) -> tuple[str, TaskOptions]:
    """Reference and options of a command line, parsed as the command parses it."""
    workbench, command, reference, *rest = shlex.split(line)
    assert (workbench, command) == ("workbench", "open")
    config = (tyro.conf.OmitArgPrefixes, tyro.conf.DisallowNone)
    return reference, tyro.cli(EnvArguments, args=rest, config=config).options()


@settings(max_examples=60)
@given(
    st.integers(1, 4096), st.integers(0, 2**31 - 1), st.dictionaries(NAMES, JSON, max_size=3),
    st.sampled_from([None, "stop", "off"]), st.text(min_size=1, max_size=20).filter(lambda t: "\0" not in t),
)  # fmt: skip
def test_the_shown_command_line_gives_the_same_options(
    num_envs: int, seed: int, kwargs: dict[str, Any], rules: Any, name: str
) -> None:
    options = TaskOptions(num_envs, seed=seed, env_kwargs=kwargs, rules=rules)
    assert typed(command_line(f"/tmp/{name}.py", options)) == (f"/tmp/{name}.py", options)


def test_changed_options_are_listed_by_name() -> None:
    before = TaskOptions(4, env_kwargs={"size": 1, "same": 2})
    after = TaskOptions(8, seed=5, env_kwargs={"same": 2, "none": None})
    assert changed_options(before, before) == []
    assert changed_options(before, after) == ["num_envs", "size", "none"]
