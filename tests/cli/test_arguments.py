"""Parsing of command line arguments."""

from __future__ import annotations

import importlib.metadata
import sys
from pathlib import Path

import pytest

from tests.drive.commands import exit_code
from workbench.cli import main
from workbench.cli.arguments import EnvArguments, history_bytes


@pytest.mark.parametrize(
    ("text", "size"), [("256MB", 2**28), ("2gb", 2**31), (" 1.5 G ", 3 * 2**29), ("1048576", 2**20)]
)
def test_a_size_is_read_as_people_write_it(text: str, size: int) -> None:
    assert history_bytes(text) == size


@pytest.mark.parametrize("text", ["", "0", "many", "-3MB", "12XB", "1e9MB", "10", "nan GB", "9" * 400 + "GB"])
def test_an_invalid_size_is_refused_with_an_example(text: str) -> None:
    with pytest.raises(ValueError, match="such as 256MB or 2GB"):
        history_bytes(text)


@pytest.mark.parametrize(
    ("num_envs", "seed", "named"),
    [(1, 0, None), (4096, 2**31 - 1, None), (1, -1, "--seed"), (1, 2**31, "--seed")]
    + [(0, 0, "--num-envs"), (4097, 0, "--num-envs")],
)
def test_values_at_the_limits_are_accepted_and_beyond_them_refused(
    num_envs: int, seed: int, named: str | None
) -> None:
    if named is None:
        options = EnvArguments(num_envs, seed=seed).options()
        assert (options.num_envs, options.seed) == (num_envs, seed)
    else:
        with pytest.raises(ValueError, match=named):
            EnvArguments(num_envs, seed=seed).options()


def test_an_env_argument_is_parsed_as_json_or_else_a_string() -> None:
    given = ("robot_uids=fetch", "flag=true", "size=0.5", "pair=[1, 2]", "text=a=b")
    options = EnvArguments(env=given).options()
    assert options.env_kwargs == {
        "robot_uids": "fetch", "flag": True, "size": 0.5, "pair": [1, 2], "text": "a=b",
    }  # fmt: skip
    for wrong in ("robot_uids", "=1", "a-b=1", "1a=1"):
        with pytest.raises(ValueError, match="--env takes name=value"):
            EnvArguments(env=(wrong,)).options()


def test_a_package_older_than_the_range_is_named_with_the_pip_command(
    child_process: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    # Simulates an import of a name that an older viser lacks.
    monkeypatch.setitem(sys.modules, "workbench.cli.page", None)
    with pytest.raises(ImportError):
        main.main(["review", str(tmp_path)])
    monkeypatch.setattr(importlib.metadata, "requires", lambda name: ["viser>=99"])
    assert exit_code("review", tmp_path) == 2
    first, second = capsys.readouterr().err.splitlines()
    assert first.startswith("viser>=99 is required, ") and second.endswith(" 'viser>=99'")


@pytest.mark.parametrize("given", [["--envs-per-worker", "0"], ["--envs_per_worker=0"]])
def test_the_old_name_of_an_option_works_and_warns_once(
    given: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    example = str(Path(__file__).parents[2] / "tasks" / "push_cube.py")
    assert exit_code("check", example, *given) == 2
    stderr = capsys.readouterr().err
    assert "--num-envs must be from 1 to 4096, not 0" in stderr
    assert stderr.count("is called --num-envs now") == 1
