"""The parts of the docs that are made from the code are what the code says today."""

from __future__ import annotations

from importlib.metadata import version
from pathlib import Path

import pytest
from packaging.version import Version

from tests.docs import generate
from workbench.cli import main


@pytest.fixture(scope="module")
def made(child_process: None) -> dict[Path, str]:
    return generate.pages()


@pytest.mark.parametrize(
    "page",
    [
        generate.KEYS,
        pytest.param(
            generate.CLI,
            marks=pytest.mark.skipif(
                Version(version("tyro")) < Version("1.0.16"),
                reason="earlier versions of tyro draw help another way",
            ),
        ),
        generate.RULES_PAGE,
        generate.ALL_RULES,
    ],
    ids=lambda page: page.stem,
)
def test_a_page_says_what_the_code_says(page: Path, made: dict[Path, str]) -> None:
    assert page.read_text() == made[page], "write it again: python -m tests.docs.generate"


def test_every_command_is_on_its_page(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "100")
    with pytest.raises(SystemExit):
        main.main(["--help"])
    listed = capsys.readouterr().out.partition("{")[2].partition("}")[0]
    assert sorted("".join(listed.split()).split(",")) == sorted(generate.COMMANDS)


def test_a_key_is_written_as_people_write_it() -> None:
    command = generate.Command("Turn it", lambda: None, "pageup", "alt+shift")
    assert command.key_name == "Alt+Shift+Page Up"
    assert generate.Command("Undo", lambda: None, "Z", "cmd/ctrl").key_name == "Ctrl+Z"


def test_names_in_a_rule_are_set_as_code() -> None:
    assert generate.code("apply (scene._gpu_apply_all()) in evaluate() only.") == (
        "apply (`scene._gpu_apply_all()`) in `evaluate()` only."
    )
