"""What is said where ManiSkill is not installed, or both of its distributions are, and which command is named."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

import workbench
from workbench.cli import main
from workbench.machine import doctor, maniskill_installed
from workbench.machine.maniskill_installed import (
    installed_maniskills,
    lacks_maniskill,
    lines_if_lacking,
    lines_if_mixed,
)

WHEEL = "file:///somewhere/workbench.whl"


@pytest.fixture
def lacking(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(maniskill_installed, "find_spec", lambda name: None)
    monkeypatch.setattr(maniskill_installed, "installed_maniskills", dict)


@pytest.fixture
def mixed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Two distributions as pip describes them, ahead of the one that is installed here."""
    for name, version in (("mani_skill", "3.0.1"), ("mani_skill_nightly", "2026.8.2.400")):
        folder = tmp_path / f"{name}-{version}.dist-info"
        folder.mkdir()
        (folder / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
    monkeypatch.syspath_prepend(tmp_path)


@pytest.fixture
def environment(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """An empty folder in the place of this process's environment, made by pip's ``venv``; with a name that a shell takes apart."""
    folder = tmp_path / "archive-v0" / "an env"
    folder.mkdir(parents=True)
    (folder / "pyvenv.cfg").write_text("home = /usr/bin\nversion = 3.11.2\n")
    monkeypatch.setattr(sys, "prefix", str(folder))
    monkeypatch.setattr(sys, "executable", str(folder / "bin" / "python"))
    monkeypatch.setattr(maniskill_installed, "_came_from", lambda: f" @ {WHEEL}")
    return folder


def made_by_uv(environment: Path) -> None:
    (environment / "pyvenv.cfg").write_text("home = /usr/bin\nuv = 0.13.9\n")


def test_where_one_is_installed_nothing_is_said() -> None:
    assert not lacks_maniskill()
    assert len(installed_maniskills()) == 1
    assert lines_if_lacking("It") is None and lines_if_mixed() is None


def test_it_is_looked_for_and_not_imported(child_process: None) -> None:
    import subprocess

    code = (
        "import sys; from workbench.machine.maniskill_installed import lines_if_lacking, lines_if_mixed;"
        "print(lines_if_lacking('It'), lines_if_mixed(), [name for name in sys.modules if name.startswith('mani')])"
    )
    done = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True, timeout=60)
    assert done.stdout == "None None []\n", done.stderr


def test_a_folder_of_its_assets_is_no_maniskill(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "mani_skill" / "assets").mkdir(parents=True)
    monkeypatch.delitem(sys.modules, "mani_skill", raising=False)
    monkeypatch.setattr(sys, "path", [str(tmp_path)])
    assert lacks_maniskill()


def test_pip_is_named_with_the_python_of_the_environment_and_the_range_that_we_ask_for(
    lacking: None, environment: Path
) -> None:
    lines = lines_if_lacking("workbench open")
    assert lines is not None
    assert lines[0] == f"workbench open needs ManiSkill, which is not installed in {environment}."
    assert lines[1].startswith(f"Type: '{environment}/bin/python' -m pip install 'mani_skill")
    assert "3.0.1" in lines[1]


def test_uv_is_named_where_it_has_made_the_environment(
    lacking: None, environment: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made_by_uv(environment)
    outside = environment.rename(environment.parents[1] / "venv")
    monkeypatch.setattr(sys, "prefix", str(outside))
    lines = lines_if_lacking("It")
    assert lines is not None
    assert lines[1].startswith(f"Type: uv pip install --python '{environment}/bin/python' 'mani_skill")


def test_uvx_is_named_with_our_wheel_and_what_was_typed(lacking: None, environment: Path) -> None:
    made_by_uv(environment)
    lines = lines_if_lacking("It", ["open", "my task.py"])
    assert lines is not None
    assert (
        lines[1] == f"Type: uvx --from 'maniskill-workbench[maniskill] @ {WHEEL}' workbench open 'my task.py'"
        "  # with the -c and --find-links that you gave uvx"
    )


def test_a_tool_of_uv_is_made_anew(lacking: None, environment: Path) -> None:
    made_by_uv(environment)
    (environment / "uv-receipt.toml").touch()
    lines = lines_if_lacking("It")
    assert lines is not None
    assert lines[1] == f"Type: uv tool install --force 'maniskill-workbench[maniskill] @ {WHEEL}'"


@pytest.mark.parametrize("call", ["open PickCube-v1", "record PickCube-v1", "rescore gone"])
def test_a_command_that_needs_it_says_so_and_does_nothing(
    call: str, lacking: None, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main.main(call.split())
    assert ended.value.code == 2
    said = capsys.readouterr()
    first, second = said.err.splitlines()
    assert first.startswith(f"workbench {call.split()[0]} needs ManiSkill") and second.startswith("Type: ")
    assert said.out == ""


def test_what_users_import_says_it_too(lacking: None, monkeypatch: pytest.MonkeyPatch) -> None:
    def import_module(name: str) -> object:
        raise ModuleNotFoundError("No module named 'mani_skill'", name="mani_skill")

    monkeypatch.setattr(workbench, "import_module", import_module)
    with pytest.raises(ModuleNotFoundError, match=r"^workbench\.make needs ManiSkill.*\nType: ") as raised:
        getattr(workbench, "make")  # noqa: B009  (a checker sees no use in the plain form)
    assert raised.value.name == "mani_skill"


def test_another_module_that_is_missing_keeps_its_name(
    lacking: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    def import_module(name: str) -> object:
        raise ModuleNotFoundError("No module named 'sapien'", name="sapien")

    monkeypatch.setattr(workbench, "import_module", import_module)
    with pytest.raises(ModuleNotFoundError, match="sapien"):
        getattr(workbench, "make")  # noqa: B009


def test_two_that_are_mixed_are_told_with_how_to_keep_one(mixed: None, environment: Path) -> None:
    lines = lines_if_mixed()
    assert lines is not None
    assert lines[0].startswith("mani_skill==3.0.1 and mani_skill-nightly==2026.8.2.400 are both installed")
    pip = f"'{environment}/bin/python' -m pip"
    away = f"{pip} uninstall -y mani_skill mani_skill-nightly"
    assert lines[1:] == (
        f"To keep the release, type: {away} && {pip} install mani_skill==3.0.1",
        f"To keep the nightly build, type: {away} && {pip} install mani_skill-nightly==2026.8.2.400",
    )
    made_by_uv(environment)
    lines = lines_if_mixed()
    assert (
        lines is not None and f"uv pip uninstall --python '{environment}/bin/python' mani_skill" in lines[1]
    )


def test_of_two_that_were_mixed_the_one_that_is_left_without_files_is_put_back(
    environment: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(maniskill_installed, "find_spec", lambda name: None)
    left = {"mani_skill-nightly": "2026.8.2.400"}
    monkeypatch.setattr(maniskill_installed, "installed_maniskills", lambda: left)
    lines = lines_if_lacking("It")
    assert lines is not None and "mani_skill-nightly 2026.8.2.400 is installed" in lines[0]
    pip = f"'{environment}/bin/python' -m pip"
    both = f"{pip} uninstall -y mani_skill-nightly && {pip} install mani_skill-nightly==2026.8.2.400"
    assert lines[1] == f"Type: {both}"


def test_open_warns_of_the_mix_and_goes_on(mixed: None, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main.main(["open", "gone.py"])
    said = capsys.readouterr().err
    assert ended.value.code == 2
    assert "are both installed" in said and "pip uninstall" in said and "gone.py" in said


@pytest.mark.slow
def test_doctor_says_both(
    child_process: None, mixed: None, lacking: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    (finding,) = doctor._maniskill()
    assert finding.ok is False and (finding.advice or "").startswith("Type: ")
    monkeypatch.undo()
    (finding,) = doctor._maniskill()
    assert finding.ok and installed_maniskills().popitem()[1] in finding.what


def test_doctor_warns_of_the_mix(mixed: None) -> None:
    (finding,) = doctor._maniskill()
    assert finding.ok is None and "both" in finding.what
    assert [line.partition(", type: ")[0] for line in (finding.advice or "").splitlines()] == [
        "To keep the release",
        "To keep the nightly build",
    ]
