from __future__ import annotations

import pytest

from workbench.live.process.memory_limit import parse_memory, total_memory


@pytest.mark.parametrize(
    ("text", "size"),
    [("8GB", 8 * 2**30), ("1.5 GiB", 3 * 2**29), ("2048m", 2**31), ("none", None), (" 8g ", 8 * 2**30)],
)
def test_common_size_notations_are_parsed(text: str, size: int | None) -> None:
    assert parse_memory(text) == size


@pytest.mark.parametrize("text", ["", "8 XB", "-1GB", "many", "100MB", "1e9", "8GB8"])
def test_an_invalid_or_too_small_size_is_refused_with_a_reason(text: str) -> None:
    with pytest.raises(ValueError, match="--memory-limit"):
        parse_memory(text)


def test_auto_leaves_memory_to_other_processes() -> None:
    limit = parse_memory("auto")
    assert limit is not None and 0.5 * total_memory() < limit < 0.9 * total_memory()
