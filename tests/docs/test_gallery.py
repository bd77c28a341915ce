"""The gallery: it has every example, and names the templates as they are."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.browser.gallery_pictures import VIEWS
from tests.docs.pages import DOCS, ROOT
from workbench.authoring.templates.new_task import TEMPLATES
from workbench.machine.folders import example_tasks

PAGE = DOCS / "reference" / "gallery.md"
MOST_BYTES = 2_000_000
"""Of all its pictures, dark and light."""
EXAMPLES = {file.stem for file in example_tasks()}


def sections() -> dict[str, str]:
    """Text of a section by the example that it shows."""
    found = {}
    for text in PAGE.read_text().split("\n## ")[1:]:
        (name,) = re.findall(r"^`workbench open tasks/(\w+)\.py`", text, re.MULTILINE)
        found[name] = text
    return found


def test_every_example_has_a_section_a_picture_and_the_line_that_opens_it() -> None:
    assert sections().keys() == VIEWS.keys() == EXAMPLES
    for name, text in sections().items():
        assert re.findall(r"!\[[^]]+\]\((.+?)\)", text) == [f"../../screenshots/dark/gallery_{name}.webp"]


def test_its_pictures_are_small() -> None:
    files = [
        ROOT / f"web_assets/screenshots/{theme}/gallery_{name}.webp"
        for name in EXAMPLES
        for theme in ("dark", "light")
    ]
    assert sum(file.stat().st_size for file in files) < MOST_BYTES


@pytest.mark.parametrize("page", [PAGE, DOCS / "tasks.md"], ids=lambda page: page.stem)
def test_the_pages_name_every_template_and_the_file_that_it_copies(page: Path) -> None:
    text = page.read_text()
    if page != PAGE:
        named = re.findall(r"^\| `([\w-]+)` \| `tasks/(\w+\.py)`", text, re.MULTILINE)
        assert named == [(one.name, one.example) for one in TEMPLATES]
    else:
        assert re.findall(r"\| `([a-z-]+)` \|$", text, re.MULTILINE) == [one.name for one in TEMPLATES]
        shown = {name: re.findall(r"Template: `([\w-]+)`", section) for name, section in sections().items()}
        assert {f"{name}.py": of[0] for name, of in shown.items() if of} == {
            one.example: one.name for one in TEMPLATES
        }
