"""Which functions are offered as policies, by reading files that nobody has agreed to run."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.drive.waiting import TIMEOUT_SECONDS
from workbench.actions.policy import (
    MAX_LISTED,
    NoPolicy,
    PolicyFile,
    find_policy,
    list_policies,
    load_policy,
)

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


@pytest.fixture
def task_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of a task, with a policy of the same name as one in the current folder, and another one."""
    here, task = tmp_path / "here", tmp_path / "task"
    for folder in (here, task):
        folder.mkdir()
        (folder / "a.py").write_text("def act(obs): ...\n")
    (task / "b.py").write_text("def act(obs): ...\n")
    monkeypatch.chdir(here)
    return task


def test_what_is_beside_the_task_is_listed_as_it_is_found(task_folder: Path) -> None:
    here = task_folder.with_name("here")
    listed = list_policies(here, task_folder)
    assert listed == ("a.py:act", f"{task_folder}/a.py:act", "b.py:act")
    files = here / "a.py", task_folder / "a.py", task_folder / "b.py"
    assert [find_policy(one, task_folder) for one in listed] == [(file, "act") for file in files]
    assert list_policies(here, here) == ("a.py:act",)


def test_a_module_is_named_and_a_missing_policy_is_refused(task_folder: Path) -> None:
    assert find_policy("lab.act:act", task_folder) == ("lab.act", "act")
    here = task_folder.with_name("here")
    for missing in ("c.py:act", f"{here}/b.py:act", "a.py", ":act", "a.py:", " "):
        with pytest.raises(NoPolicy):
            find_policy(missing, task_folder)
    with pytest.raises(NoPolicy):
        find_policy("b.py:act")


def test_tests_are_not_listed_and_a_long_list_is_cut(tmp_path: Path) -> None:
    for name in ("test_a", "conftest", "own"):
        (tmp_path / f"{name}.py").write_text("def act(obs): ...\n")
    assert list_policies(tmp_path, None) == ("own.py:act",)
    (tmp_path / "own.py").write_text("".join(f"def act_{k}(obs): ...\n" for k in range(99)))
    assert len(list_policies(tmp_path, None)) == MAX_LISTED
    assert list_policies(tmp_path / "gone", None) == ()


def test_a_policy_sees_the_modules_of_its_own_folder_and_its_last_save(
    tmp_path: Path, clean_process: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    here, lab = tmp_path / "here", tmp_path / "lab"
    for folder in (here, lab):
        folder.mkdir()
        (folder / "beside.py").write_text(f"WHERE = {folder.name!r}\n")
    monkeypatch.chdir(here)
    file = lab / "own_policy.py"
    for number in (1, 2):  # the same size, within the same second
        file.write_text(f"import beside\ndef act(obs): return beside.WHERE, {number}\n")
        assert load_policy("own_policy.py:act", lab)(None) == ("lab", number)
    for missing in ("own_policy.py:atc", "no_such_package.module:act", "beside:act"):
        with pytest.raises(NoPolicy):
            load_policy(missing, lab)


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
