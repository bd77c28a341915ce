"""The parts of the docs that are made from the code are what the code says today."""

from __future__ import annotations

from importlib.metadata import version
from pathlib import Path

import pytest
from packaging.version import Version

from tests.docs import generate


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
