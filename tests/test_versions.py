"""The tested versions, the version ranges and the table of versions agree."""

from __future__ import annotations

from pathlib import Path

import pytest
import tomllib
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from tests.versions import PAGE, SETS, SHOWN, TESTS, Result, pins, rows, with_row
from workbench.machine.versions import TESTED

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
EXTRAS = PROJECT["optional-dependencies"]
PINNED = {canonicalize_name(name): version for name, version in pins().items()}


@pytest.mark.parametrize(
    "line", [*PROJECT["dependencies"], *(line for extra in EXTRAS.values() for line in extra)]
)
def test_each_range_includes_the_tested_version(line: str) -> None:
    requirement = Requirement(line)
    assert requirement.specifier.contains(PINNED[canonicalize_name(requirement.name)], prereleases=True)


@pytest.mark.parametrize("name", TESTED)
def test_versions_that_the_program_calls_tested_are_pinned_or_in_the_table(name: str) -> None:
    """The first is the pinned version, which messages tell the user to install."""
    assert TESTED[name][0] == PINNED[canonicalize_name(name)]
    header = [line for line in PAGE.read_text().splitlines() if line.startswith("| set |")][0]
    columns = [cell.strip() for cell in header.strip("|").split("|")]
    column = columns.index("ManiSkill" if name.startswith("mani_skill") else name)
    shown = {row[column] for row in rows(PAGE.read_text())}
    assert set(TESTED[name][1:]) <= shown


def test_each_row_of_the_table_is_of_a_known_set() -> None:
    for row in rows(PAGE.read_text()):
        assert len(row) == 6 + len(SHOWN) and row[0] in SETS and row[-3] in TESTS
        assert ", 0 failed, " in row[-2]


def test_a_row_replaces_the_one_of_the_same_set_python_and_tests() -> None:
    first = Result("tested", "3.11", "fast", "2026-01-01", "3.0.1", ("1",) * len(SHOWN), 3, 1, 0)
    other = Result("tested", "3.12", "fast", "2026-01-01", "3.0.1", ("1",) * len(SHOWN), 4, 0, 0)
    again = Result("tested", "3.11", "fast", "2026-01-02", "3.0.1", ("2",) * len(SHOWN), 5, 0, 0)
    page = "# Page\n\n| set | ... |\n| --- | --- |\n\nBelow.\n\n| package | bound |\n| --- | --- |\n"
    for result in (first, other, again):
        page = with_row(page, result)
    assert [row[-1] for row in rows(page)] == ["2026-01-01", "2026-01-02"]
    assert "5 passed, 0 failed, 0 skipped" in page and page.endswith("| package | bound |\n| --- | --- |\n")
