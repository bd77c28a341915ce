"""Which functions are offered as policies, by reading files that nobody has agreed to run."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.drive.waiting import TIMEOUT_SECONDS
from workbench.actions.policy import PolicyFile, find_policy, list_policies

POLICIES = """
raise RuntimeError("reading runs nothing")

def helper(value): ...
def act(obs, gain=2.0, *, noise=0.1): ...
def positional(observation, /): ...
def two(obs, info): ...
def none(): ...
def keyword(obs, *, gain): ...
def any_number(*obs): ...
def _hidden(obs): ...
async def later(obs): ...
class Policy:
    def method(self): ...
"""


def test_functions_of_one_required_parameter_are_listed_those_of_an_observation_first(tmp_path: Path) -> None:
    (tmp_path / "lab.py").write_text(POLICIES)
    assert list_policies(tmp_path, None) == ("lab.py:act", "lab.py:positional", "lab.py:helper")


def test_what_is_beside_the_task_is_listed_as_it_is_found(tmp_path: Path, monkeypatch) -> None:
    here, task = tmp_path / "here", tmp_path / "task"
    for folder in (here, task):
        folder.mkdir()
        (folder / "same.py").write_text("def act(obs): ...\n")
    (task / "other.py").write_text("def act(obs): ...\n")
    monkeypatch.chdir(here)
    listed = list_policies(here, task)
    assert listed == ("same.py:act", "other.py:act", f"{task}/same.py:act")
    assert [find_policy(one, task)[0] for one in listed] == [
        here / "same.py",
        task / "other.py",
        task / "same.py",
    ]
    assert list_policies(here, here) == ("same.py:act",)


@pytest.mark.parametrize("saved", ["here", "task"])
def test_a_save_of_the_policy_is_noticed_here_and_beside_the_task(
    saved: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for folder in ("here", "task"):
        (tmp_path / folder).mkdir()
    monkeypatch.chdir(tmp_path / "here")
    (tmp_path / saved / "act.py").write_text("def act(obs): ...\n")
    noticed = threading.Event()
    file = PolicyFile(noticed.set)
    try:
        file.follow("act.py:act", tmp_path / "task")
        (tmp_path / saved / "act.py").write_text("def act(obs): return 0\n")
        assert noticed.wait(TIMEOUT_SECONDS)
    finally:
        file.close()


@given(st.text(max_size=80))
@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_any_text_is_read_without_a_failure(tmp_path: Path, text: str) -> None:
    (tmp_path / "any.py").write_text(text, encoding="utf-8", errors="replace")
    assert all(one.startswith("any.py:") for one in list_policies(tmp_path, None))
