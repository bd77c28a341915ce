"""``evaluate``'s entries are split into per-env columns and others, and match what stock ManiSkill returns."""

from __future__ import annotations

from collections import OrderedDict
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from mani_skill.utils.structs.pose import Pose

import workbench
from tests.drive.entries import ENTRIES, Mute
from tests.drive.envs import CPU, batched
from tests.live.odd_entries import write_task
from workbench.envs.evaluate_entries import (
    MAX_ENTRIES,
    MAX_TEXT_CHARACTERS,
    no_reward,
    split_entries,
    without_rows,
    wrong_evaluate,
    wrong_flags,
    wrong_observation,
    wrong_reward,
)
from workbench.envs.maniskill_private import open_env
from workbench.envs.task_env import TaskEnv
from workbench.task.load import load_task

N = 4
EACH = torch.arange(float(N))


class Chatty:
    def __repr__(self) -> str:
        return "x" * 10**6


@pytest.mark.parametrize(
    ("value", "dtype", "shape"),
    [
        (EACH, "float32", (N,)),
        (EACH.half(), "float16", (N,)),
        (EACH.bfloat16(), "float32", (N,)),
        (EACH.clone().requires_grad_(), "float32", (N,)),
        (torch.zeros(N, 0), "float32", (N, 0)),
        (torch.eye(N).to_sparse(), "float32", (N, N)),
        ((True, False, True, True), "bool", (N,)),
        ([torch.tensor(1.0)] * N, "float32", (N,)),
        ([[1.0, 2.0]] * N, "float64", (N, 2)),
        (Pose.create_from_pq(p=torch.zeros(N, 3)), "float32", (N, 7)),
    ],
)
def test_a_value_with_a_row_per_env_is_a_column(value: Any, dtype: str, shape: tuple[int, ...]) -> None:
    columns, others = split_entries({"entry": value, "elapsed_steps": EACH}, N)
    assert (columns["entry"].dtype, columns["entry"].shape) == (np.dtype(dtype), shape)
    assert others == {} and list(columns) == ["entry"]


@pytest.mark.parametrize(
    ("value", "what", "text"),
    [
        (None, "None", "None"),
        ({}, "dict", "{}"),
        (1 + 2j, "complex", "(1+2j)"),
        (2**70, "int", str(2**70)),
        (10**5000, "int", "<int, whose repr raises ValueError>"),
        (Mute(), "Mute", "<Mute, whose repr raises KeyError>"),
        ([[1], [1, 2]], "list", "[[1], [1, 2]]"),
        (torch.zeros(0), "float32 tensor of shape (0,)", "[]"),
        (torch.zeros(300, 300), "float32 tensor of shape (300, 300)", "90,000 numbers"),
        ("\ud800 \x00 \x1b[31m\nred", "str", "\ufffd \ufffd \ufffd[31m\nred"),
    ],
    ids=lambda value: type(value).__name__,
)
def test_other_values_are_one_text_for_the_whole_batch(value: Any, what: str, text: str) -> None:
    columns, others = split_entries({"entry": value}, N)
    entry = others["entry"]
    assert columns == {} and (entry.what, entry.texts, entry.numbers) == (what, (text,), None)
    assert not entry.per_env


def test_nested_dicts_are_flattened_under_unique_names() -> None:
    twice: dict[Any, Any] = {"a": {"b": EACH, 1: None}, "a/b": "also", "": 1, 2: 2, "2": 3}
    twice["self"] = OrderedDict(again=twice)
    columns, others = split_entries(twice, N)
    assert {"a/b", "self/again/a/b"} == set(columns)
    assert {"a/1", "a/b (2)", "''", "2", "2 (2)"} <= set(others)
    assert not set(columns) & set(others)


def test_huge_entries_are_truncated() -> None:
    entries: dict[Any, Any] = {"x" * 10_000: Chatty(), "list": list(range(10**5)), "text": "y" * 10**6}
    _, others = split_entries(entries, N)
    assert max(map(len, others)) <= 200
    for entry in others.values():
        assert len(entry.texts[0]) <= MAX_TEXT_CHARACTERS and not entry.whole
    _, named = split_entries({"n" * 200: None, "m" * 201: None}, N)
    assert list(named) == ["n" * 200, "m" * 199 + "…"]
    many, rest = split_entries({str(i): EACH for i in range(MAX_ENTRIES + 7)}, N)
    assert len(many) == MAX_ENTRIES and rest["…"].texts == ("7 more",)


def test_columns_are_copies() -> None:
    value, number = EACH.clone(), torch.tensor(1.0)
    columns, others = split_entries({"each": value, "mean": number}, N)
    value += 1
    number += 1
    assert columns["each"].tolist() == [0, 1, 2, 3] and others["mean"].numbers == 1


@settings(max_examples=30)
@given(ENTRIES, st.integers(1, 5))
def test_any_dict_is_split(entries: dict[Any, Any], num_envs: int) -> None:
    columns, others = split_entries(entries, num_envs)
    assert not set(columns) & set(others)
    for values in columns.values():
        assert len(values) == num_envs and values.dtype.kind in "biuf"
    for name, entry in others.items():
        name.encode()
        assert len(entry.texts) == (0 if entry.numbers is not None else num_envs if entry.per_env else 1)
        "".join(entry.texts).encode()


class Plain:
    """Has Python's own repr, with its address."""


def test_a_text_is_the_same_in_every_run_and_has_the_tasks_digits() -> None:
    kept = [Plain(), Plain()]
    texts = [split_entries({"object": each}, N)[1]["object"].texts for each in kept]
    assert texts[0] == texts[1] and "Plain" in texts[0][0]
    assert split_entries({"number": np.complex64(1 + 2j)}, N)[1]["number"].texts == ("(1+2j)",)
    each = split_entries({"each": [f"env {i}" for i in range(N)]}, N)[1]["each"]
    assert each.per_env and [each.of_env(i).texts for i in range(N)] == [(f"env {i}",) for i in range(N)]


@pytest.mark.parametrize(
    ("value", "flags"),
    [
        (torch.tensor([0.0, 2.0, 0.0, -1.0]), [False, True, False, True]),
        (np.array([0, 1, 1, 0]), [False, True, True, False]),
        (torch.tensor([[True], [False], [True], [False]]), [True, False, True, False]),
        (True, [True] * N),
        (torch.tensor(0), [False] * N),
    ],
)
def test_success_is_a_bool_for_each_env(value: Any, flags: list[bool]) -> None:
    columns, _ = split_entries({"success": value}, N)
    assert columns["success"].dtype == bool and columns["success"].tolist() == flags


@pytest.mark.parametrize(
    ("obs", "named"),
    [
        ({}, None),
        ({"a": {"b": torch.zeros(N, 2), "c": np.zeros(N)}}, None),
        ({"a": {"b": torch.zeros(N, 2), "c": torch.zeros(2)}}, "a/c"),
        ({"a": torch.tensor(1.0)}, "a"),
        ({"a": 1.0}, "a"),
        ({"a": [0.0] * N}, "a"),
        (None, ""),
        (torch.zeros(N, 3), ""),
    ],
)
def test_an_observation_without_rows_is_named(obs: Any, named: str | None) -> None:
    problem = wrong_observation(obs, N)
    assert (problem is None) == (named is None)
    assert problem is None or repr(named) in problem or named == ""


@pytest.mark.parametrize(
    ("num_envs", "named"), [(N, ["few", "inner/few", "scalar"]), (1, ["rows", "few", "inner/few", "column"])]
)
def test_values_without_rows_are_found_in_nested_dicts(num_envs: int, named: list[str]) -> None:
    value = {"rows": torch.zeros(N, 2), "few": torch.zeros(2), "inner": {"few": np.zeros((3, N))}}
    value |= {"scalar": torch.tensor(1.0), "text": "a", "column": torch.zeros(N)}
    assert [name for name, _ in without_rows(value, num_envs)] == named


@pytest.mark.parametrize(
    ("reward", "num_envs", "wrong", "none"),
    [
        (torch.zeros(N), N, False, False),
        (torch.full((N,), torch.nan), N, False, False),
        (torch.zeros(N, 1), N, True, True),
        (torch.zeros(N - 1), N, True, True),
        (torch.zeros(N, dtype=torch.int64), N, True, False),
        (torch.zeros(N, dtype=torch.complex64), N, True, True),
        (np.zeros(N), N, True, True),
        (0.0, 1, True, True),
        (torch.tensor(0.0), 1, False, False),
        (torch.zeros(1), 1, False, False),
        (torch.zeros(1, 1), 1, True, False),
        (EACH > 1, N, False, False),  # ManiSkill's own sparse reward is `success` itself
        (EACH > 2, N, True, False),
    ],
)
def test_a_reward_is_floats_with_a_row_for_each_env(
    reward: Any, num_envs: int, wrong: bool, none: bool
) -> None:
    assert (wrong_reward(reward, num_envs, {"success": EACH > 1}) is not None) == wrong
    assert (no_reward(reward, num_envs) is not None) == none


@pytest.mark.parametrize(
    ("evaluate", "num_envs", "wrong", "flags"),
    [
        ({"success": EACH > 1, "other": None}, N, False, False),
        ({"success": EACH}, N, False, True),
        ({"fail": EACH > 1, "success": (EACH > 1).int()}, N, False, True),
        ({"success": torch.zeros(N, 1, dtype=torch.bool)}, N, True, False),
        ({"fail": True}, N, True, False),
        ({"fail": EACH.to(torch.complex64)}, N, True, True),
        ({"fail": None}, N, True, False),
        ({"success": torch.tensor(True)}, 1, False, False),
        ({"success": torch.tensor([[True]])}, 1, False, True),
        ({"success": torch.tensor(True)}, N, True, False),
        (None, N, True, False),
        ([], N, True, False),
    ],
)
def test_success_and_fail_are_bools_with_a_row_for_each_env(
    evaluate: Any, num_envs: int, wrong: bool, flags: bool
) -> None:
    assert (wrong_evaluate(evaluate, num_envs) is not None) == wrong
    assert (wrong_flags(evaluate) is not None) == flags


# --- the same in stock ManiSkill ---------------------------------------------------------------------


@pytest.fixture(scope="module")
def odd_task(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_task(tmp_path_factory.mktemp("odd"))


def same(ours: Any, stock: Any) -> bool:
    if isinstance(stock, dict):
        return ours.keys() == stock.keys() and all(same(ours[key], stock[key]) for key in stock)
    if isinstance(stock, torch.Tensor):
        return ours.dtype == stock.dtype and torch.equal(ours, stock)
    if isinstance(stock, np.ndarray):
        return np.array_equal(ours, stock)
    return ours == stock or type(ours) is type(stock)


def test_info_equals_stock_maniskills(odd_task: Path) -> None:
    ours: Any = workbench.make(odd_task, 1, **CPU, rules="stop")
    stock: Any = gym.make("OddEntries-v1", num_envs=1, sim_backend="physx_cpu", render_backend="none")
    for env in (ours, stock):
        env.reset(seed=3)
    rng = np.random.default_rng(0)
    for _ in range(7):
        action = rng.uniform(-1, 1, (1, 8)).astype(np.float32)
        given, expected = ours.step(action), stock.step(action)
        assert same(given[4], expected[4])
        assert torch.equal(given[1], expected[1]) and torch.equal(given[2], expected[2])
    ours.close()
    stock.close()


class OneTruth:
    """Mixin whose ``evaluate`` returns a single bool, as a task written for one env does."""

    def evaluate(self) -> dict[str, Any]:
        return {"success": torch.tensor(False), "fail": torch.tensor(True)}


@pytest.mark.parametrize("rules", ["off", "stop"])
def test_a_single_bool_of_one_env_is_accepted_as_in_stock(odd_task: Path, rules: Any) -> None:
    task = type("One", (OneTruth, load_task(str(odd_task)).cls), {})
    env = TaskEnv(batched(task, 1, rules=rules, reward_mode="sparse"))
    assert env.reset(seed=0).terminated.tolist() == [True]
    step = env.step(None)
    assert step.terminated.tolist() == [True] and step.reward.tolist() == [-1.0]
    assert step.evaluate["success"].tolist() == [False] and step.evaluate["fail"].tolist() == [True]
    env.close()


def test_steps_and_rescoring_return_columns_and_others(odd_task: Path) -> None:
    env = workbench.make(odd_task, 3, **CPU, reward_mode="dense")
    task = TaskEnv(open_env(env))
    task.reset(seed=0)
    step = task.step(np.zeros((3, 8), np.float32))
    for result in (step, task.rescore(np.zeros((3, 8), np.float32))):
        assert result.others["phase"].texts == ("reach",) and result.others["stage"].numbers == 2
        assert result.others["best"].what == "None" and result.others["words"].texts[2] == "cube 2"
        progress: Any = result.others["progress"].numbers
        np.testing.assert_allclose(progress, result.evaluate["away"].mean(), rtol=1e-6)
        assert result.evaluate["turns"].shape == (3,) and "sometimes" in result.others
        assert result.others["reward_terms/mean"].numbers is not None
        assert "reward_terms/all" in result.evaluate and "elapsed_steps" not in result.evaluate
    assert "turns" in task.step(np.zeros((3, 8), np.float32)).others
    env.close()
