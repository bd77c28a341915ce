"""The docs pages that people copy from: what they tell people to type runs, and nothing public is left out."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import workbench

DOCS = Path(__file__).parents[2] / "web_assets" / "docs"


@pytest.mark.parametrize(
    ("page", "count", "printed"),
    [
        ("batched_env.md", 5, ("actor cube", "{}", "table-workspace")),  # the restore report, and a contact
        ("api.md", 1, ("table-workspace",)),
    ],
)
def test_every_block_of_a_page_runs(
    page: str, count: int, printed: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    blocks = re.findall(r"```python\n(.*?)```", (DOCS / page).read_text(), flags=re.DOTALL)
    assert len(blocks) == count
    names: dict[str, object] = {}
    for block in blocks:
        exec(compile(block, page, "exec"), names)
    out = capsys.readouterr().out
    assert [words for words in printed if words not in out] == []


def test_what_is_importable_by_promise_is_on_its_page() -> None:
    told = re.findall(r"^\| `workbench\.(\w+)\(", (DOCS / "api.md").read_text(), re.M)
    assert sorted(told) == sorted(workbench.__all__)
    for name in workbench.__all__:
        assert getattr(workbench, name).__doc__, name
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        workbench.nothing  # noqa: B018
