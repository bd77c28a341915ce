"""Writing to a handle only what it does not say already.

viser sends whatever is assigned, also if it is what stands there. A page is drawn many times a second, so that would
be most of what is sent; and content that is sent again is made anew in the browser, under the pointer of whoever is
about to press it.
"""

from __future__ import annotations

from typing import Protocol


class _Shown(Protocol):
    visible: bool


class _Filled(Protocol):
    content: str


def show(handle: _Shown, shown: bool) -> None:
    """Show or hide an input, a folder, a panel."""
    if handle.visible != shown:
        handle.visible = shown


def fill(handle: _Filled, content: str) -> None:
    """Let an HTML handle have this content."""
    if handle.content != content:
        handle.content = content
