"""Links that open a line of the author's file in an editor."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

EDITORS = {
    "vscode": "vscode://file{file}:{line}",
    "cursor": "cursor://file{file}:{line}",
    "pycharm": "pycharm://open?file={file}&line={line}",
    "none": "",
}
"""Address template by name of the editor; ``{file}`` is an absolute path, which begins with a slash."""
_SCHEME = re.compile(r"([a-z][a-z0-9+.-]*):[^\s\x00-\x1f]+", re.IGNORECASE)
_RUNS_CODE = ("javascript", "vbscript", "data", "blob", "about", "view-source", "filesystem", "file")
"""Schemes that would run a script, replace this page by another, or be refused by the browser."""


@dataclass(frozen=True)
class EditorLink:
    """Link to a line of a file."""

    address: str
    """Address; empty if the file is not linked."""
    copied: str
    """Text to copy: ``/home/me/push.py:88``."""
    new_tab: bool = False
    """Whether the address is a web page: opened in the same tab, it would replace the workbench's page."""


LinkTo = Callable[[str | None, int | None], EditorLink]
"""Returns the link to a line of a file."""


def parse_editor(text: str) -> str:
    """The address template for a value of ``--editor``, which is a name in `EDITORS` or itself a template.

    Raises:
        ValueError: `text` is neither such a name nor a template that opens an editor.
    """
    if text in EDITORS:
        return EDITORS[text]
    wanted = f"--editor takes {', '.join(EDITORS)} or an address with {{file}} and {{line}}"
    matched = _SCHEME.fullmatch(text)
    if matched is None or "{file}" not in text:
        raise ValueError(f"{wanted}, as in {EDITORS['vscode']}; got {text!r}")
    if matched[1].lower() in _RUNS_CODE:
        raise ValueError(f"{wanted}; a {matched[1].lower()}: address opens no editor")
    return text


def editor_link(
    template: str, file: str | None, line: int | None, known: Callable[[str], bool]
) -> EditorLink:
    """The link to a line of a file.

    Args:
        template: result of `parse_editor`; empty for no editor.
        known: whether a file is the author's. Other files are not linked: their names come from the process that runs the
            task.
    """
    if not file:
        return EditorLink("", "")
    path = str(Path(file).absolute())
    copied = f"{path}:{line}" if line else path
    if not template or not known(path):
        return EditorLink("", copied)
    # Not str.format: a template may contain other braces, and a file name may contain "{line}".
    parts = re.split(r"(\{file\}|\{line\})", template)
    filled = {"{file}": quote(path, safe="/"), "{line}": str(line or 1)}
    address = "".join(filled.get(part, part) for part in parts)
    return EditorLink(address, copied, address.lower().startswith(("http:", "https:")))


def no_links(file: str | None, line: int | None) -> EditorLink:
    """A `LinkTo` without links."""
    return editor_link("", file, line, lambda path: False)
