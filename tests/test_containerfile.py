"""The Containerfile is built by hand, since few machines have a builder; what it names is held against what is there."""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path

import pytest
import tomllib
from packaging.specifiers import SpecifierSet

from workbench.cli import main
from workbench.ui.server.listening import DEFAULT_PORT

ROOT = Path(__file__).parents[1]
TEXT = re.sub(r"\\\n", "", (ROOT / "Containerfile").read_text())
STEPS = [line.split(maxsplit=1) for line in TEXT.splitlines() if line and not line.startswith("#")]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
PYTHON_OF_DEBIAN = {"bookworm": "3.11"}


def arguments_of(step: str) -> list[str]:
    return [argument for name, argument in STEPS if name == step]


def test_what_it_copies_is_there_and_is_all_that_the_wheel_is_made_of() -> None:
    copied = {source for argument in arguments_of("COPY") for source in shlex.split(argument)[:-1]}
    assert all((ROOT / name).exists() for name in copied)
    build = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["hatch"]["build"]["targets"]["wheel"]
    assert {*build["packages"], *build["force-include"], PROJECT["readme"], "pyproject.toml"} <= copied
    assert "-c constraints.txt" in TEXT and "constraints.txt" in copied


def test_its_debian_has_a_python_and_a_mesa_that_we_run_with() -> None:
    (base,) = (argument for argument in arguments_of("ARG") if argument.startswith("BASE="))
    (release,) = (name for name in PYTHON_OF_DEBIAN if f":{name}-slim" in base)
    assert PYTHON_OF_DEBIAN[release] in SpecifierSet(PROJECT["requires-python"])
    # bookworm's own Mesa is too old; this module brings that of its backports.
    assert "python -m workbench.machine.software_vulkan" in TEXT


def test_the_extra_that_it_asks_for_is_one_of_ours() -> None:
    (named,) = (argument for argument in arguments_of("ARG") if argument.startswith("MANISKILL="))
    assert named.partition("=")[2] in PROJECT["optional-dependencies"]
    assert '".[${MANISKILL}]"' in TEXT


def test_it_runs_as_nobody_of_importance_on_the_port_of_the_page() -> None:
    assert arguments_of("USER") == ["workbench"] and arguments_of("EXPOSE") == [str(DEFAULT_PORT)]
    assert [name for name, _ in STEPS].index("USER") > max(
        k for k, step in enumerate(STEPS) if step[0] == "RUN"
    )


def test_its_command_is_one_of_ours(capsys: pytest.CaptureFixture[str]) -> None:
    (entry,) = map(json.loads, arguments_of("ENTRYPOINT"))
    (command,) = map(json.loads, arguments_of("CMD"))
    assert entry == ["workbench"]
    assert command[command.index("--host") + 1] == "0.0.0.0"
    # It gets as far as the file, which is none of this machine.
    with pytest.raises(SystemExit) as ended:
        main.main([argument.replace("/tasks/", "/no/such/folder/") for argument in command])
    assert ended.value.code == 2
    assert capsys.readouterr().err.strip() == "there is no file /no/such/folder/my_task.py"


def test_it_names_no_host_but_that_of_its_base() -> None:
    without_base = "\n".join(" ".join(step) for step in STEPS if not step[1].startswith("BASE="))
    assert "://" not in without_base
