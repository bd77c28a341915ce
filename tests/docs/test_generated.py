"""The generated files match the code."""

from __future__ import annotations

from importlib.metadata import version
from pathlib import Path

import pytest
from packaging.version import Version

from tests.benchmarks import table
from tests.docs import generate
from workbench.checks.rule_pages import sections

AGAIN = "generate it again: python -m tests.docs.generate"


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
                reason="earlier versions of tyro format help differently",
            ),
        ),
        generate.GPU_RULES_PAGE,
        generate.ALL_RULES,
        generate.RULES_FILE,
    ],
    ids=lambda page: page.name,
)
def test_a_generated_page_matches_the_code(page: Path, made: dict[Path, str]) -> None:
    assert page.read_text() == made[page], AGAIN


def test_each_rule_has_the_page_of_its_declaration_and_there_is_no_other_page(made: dict[Path, str]) -> None:
    there = {page: page.read_text() for page in generate.RULE_PAGES.iterdir()}
    assert there == {path: text for path, text in made.items() if path.parent == generate.RULE_PAGES}, AGAIN


def test_each_rule_explains_why_how_to_fix_it_and_how_it_is_checked() -> None:
    for rule in generate.declared_rules():
        assert list(sections(rule.page)) == ["Why", "Fix", "How it is checked"], rule.id
        assert rule.asks[-1] == rule.otherwise[-1] == ".", rule.id


def test_the_benchmark_page_is_generated_from_the_results() -> None:
    assert table.PAGE.read_text() == table.page(table.read()), (
        "generate it again: python -m tests.benchmarks.table"
    )


def test_the_table_of_benchmarks_is_short_and_names_existing_scripts() -> None:
    rows = table.read()
    assert len(rows) <= table.MAX_ROWS and len({row.what for row in rows}) == len(rows)
    assert all((table.RESULTS.parent / row.script).is_file() for row in rows)


@pytest.mark.parametrize(
    ("ours", "other", "unit", "better", "ratio"),
    [
        (5335, 905, "env-steps/s", "more", "5.9 times as many"),
        (0.67, 7.9, "s", "less", "12 times as fast"),
        (405, 357, "ms of CPU time", "less", "0.88 times as fast"),
        (0.19, 0.668, "MB/s", "less", "0.28 times as much"),
        (1.36, None, "MB", "less", ""),
    ],
)
def test_a_ratio_names_the_better_side(ours, other, unit, better, ratio) -> None:
    assert table.Row("x", ours, other, unit, better, "core.py").ratio == ratio


def test_a_script_replaces_its_rows_and_adds_none_beyond_the_limit(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(table, "RESULTS", tmp_path / "results.json")
    monkeypatch.setattr(table, "PAGE", tmp_path / "benchmarks.md")
    table.RESULTS.write_text("[]")
    rows = [table.Row(f"row {number}", 1, 2, "s", "less", "core.py") for number in range(table.MAX_ROWS)]
    table.keep(rows)
    table.keep([table.Row("row 7", 3.14159, None, "s", "less", "core.py")])
    (seventh,) = (row for row in table.read() if row.what == "row 7")
    assert seventh.ours == 3.142 and seventh.measured and len(table.read()) == table.MAX_ROWS
    assert table.PAGE.read_text() == table.page(table.read())
    with pytest.raises(ValueError, match="26 rows"):
        table.keep([table.Row("another", 1, 2, "s", "less", "core.py")])
