"""Nothing that users may import is left out of the page that lists it."""

from __future__ import annotations

import re

import pytest

import workbench
from tests.docs.pages import DOCS


def test_what_is_importable_by_promise_is_on_its_page(child_process: None) -> None:
    told = re.findall(r"^\| `workbench\.(\w+)\(", (DOCS / "reference" / "api.md").read_text(), re.M)
    assert sorted(told) == sorted(workbench.__all__)
    for name in workbench.__all__:
        assert getattr(workbench, name).__doc__, name
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        workbench.nothing  # noqa: B018
