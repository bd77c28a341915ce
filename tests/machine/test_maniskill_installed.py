"""Messages and commands if ManiSkill is not installed, or if both of its distributions are."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import workbench
from tests.drive.commands import exit_code
from workbench.machine import maniskill_installed
from workbench.machine.maniskill_installed import (
    installed_maniskills,
    lacks_maniskill,
    lines_if_lacking,
    lines_if_mixed,
)


@pytest.fixture
def lacking(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(maniskill_installed, "find_spec", lambda name: None)
    monkeypatch.setattr(maniskill_installed, "installed_maniskills", dict)


@pytest.fixture
def mixed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Put metadata of two distributions first on the path, as pip writes it."""
    for name, version in (("mani_skill", "3.0.1"), ("mani_skill_nightly", "2026.8.2.400")):
        folder = tmp_path / f"{name}-{version}.dist-info"
        folder.mkdir()
        (folder / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
    monkeypatch.syspath_prepend(tmp_path)


@pytest.fixture
def environment(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Replace this process's environment with an empty folder whose name needs shell quoting."""
    folder = tmp_path / "archive-v0" / "an env"
    folder.mkdir(parents=True)
    (folder / "pyvenv.cfg").write_text("home = /usr/bin\nversion = 3.11.2\n")
    monkeypatch.setattr(sys, "prefix", str(folder))
    monkeypatch.setattr(sys, "executable", str(folder / "bin" / "python"))
    return folder


def made_by_uv(environment: Path) -> None:
    (environment / "pyvenv.cfg").write_text("home = /usr/bin\nuv = 0.13.9\n")


def test_with_one_distribution_there_is_no_message_and_no_import(child_process: None) -> None:
    assert not lacks_maniskill() and len(installed_maniskills()) == 1
    code = (
        "import sys; from workbench.machine.maniskill_installed import lines_if_lacking, lines_if_mixed;"
        "print(lines_if_lacking('It'), lines_if_mixed(), [name for name in sys.modules if name.startswith('mani')])"
    )
    done = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True, timeout=60)
    assert done.stdout == "None None []\n", done.stderr


def test_a_folder_with_assets_only_is_not_maniskill(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "mani_skill" / "assets").mkdir(parents=True)
    monkeypatch.delitem(sys.modules, "mani_skill", raising=False)
    monkeypatch.setattr(sys, "path", [str(tmp_path)])
    assert lacks_maniskill()


@pytest.mark.parametrize("how", ["pip", "uv", "uvx", "uv tool"])
def test_the_command_is_that_of_the_environments_tool(
    lacking: None, environment: Path, monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    python = f"'{environment}/bin/python'"
    expected = f"{python} -m pip install 'mani_skill"
    if how != "pip":
        made_by_uv(environment)
        expected = "uvx --from 'maniskill-workbench[maniskill]"
    if how == "uv":
        outside = environment.rename(environment.parents[1] / "venv")
        monkeypatch.setattr(sys, "prefix", str(outside))
        expected = f"uv pip install --python {python} 'mani_skill"
    if how == "uv tool":
        (environment / "uv-receipt.toml").touch()
        expected = "uv tool install --force 'maniskill-workbench[maniskill]"
    lines = lines_if_lacking("It", ["open", "my task.py"])
    assert lines is not None and expected in lines[1]
    assert ("workbench open 'my task.py'" in lines[1]) == (how == "uvx")


@pytest.mark.parametrize("call", ["open PickCube-v1", "record PickCube-v1", "rescore gone"])
def test_a_command_that_needs_maniskill_exits_with_the_install_command(
    call: str, lacking: None, capsys: pytest.CaptureFixture[str]
) -> None:
    assert exit_code(*call.split()) == 2
    printed = capsys.readouterr()
    assert "ManiSkill" in printed.err and "install" in printed.err
    assert printed.out == ""


@pytest.mark.parametrize("module", ["mani_skill", "sapien"])
def test_an_import_names_the_install_command_only_if_maniskill_is_missing(
    lacking: None, monkeypatch: pytest.MonkeyPatch, module: str
) -> None:
    def import_module(name: str) -> object:
        raise ModuleNotFoundError(f"No module named '{module}'", name=module)

    monkeypatch.setattr(workbench, "import_module", import_module)
    with pytest.raises(ModuleNotFoundError) as raised:
        getattr(workbench, "make")  # noqa: B009  (a checker sees no use in the plain form)
    assert raised.value.name == module and ("install" in str(raised.value)) == (module == "mani_skill")


def test_mixed_distributions_are_reported_with_commands_to_keep_one(mixed: None, environment: Path) -> None:
    for uninstall in (f"'{environment}/bin/python' -m pip uninstall", "uv pip uninstall"):
        lines = lines_if_mixed()
        assert lines is not None
        text = "\n".join(lines)
        assert text.count(uninstall) == 2
        assert "mani_skill==3.0.1" in text and "mani_skill-nightly==2026.8.2.400" in text
        made_by_uv(environment)


def test_open_warns_about_mixed_distributions_and_continues(
    mixed: None, capsys: pytest.CaptureFixture[str]
) -> None:
    assert exit_code("open", "gone.py") == 2
    err = capsys.readouterr().err
    assert "pip uninstall" in err and "gone.py" in err
