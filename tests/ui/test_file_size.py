from __future__ import annotations

import pytest

from workbench.ui.file_size import size_in_words


@pytest.mark.parametrize(
    ("size", "words"),
    [(0, "0 B"), (999, "999 B"), (2_500_000, "2.5 MB"), (999_700, "1 MB"), (1.234e9, "1.23 GB")],
)
def test_a_size_has_three_digits_and_the_unit_that_fits(size: float, words: str) -> None:
    assert size_in_words(size) == words
