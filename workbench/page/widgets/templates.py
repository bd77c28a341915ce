"""Renders the HTML of the panels from the templates in ``web_assets/panels``, with every value escaped."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Any, Protocol

import jinja2

from workbench.machine.folders import web_assets_folder
from workbench.machine.text import plain_text, rate_text
from workbench.page.command import Command


def render(template: str, **values: Any) -> str:
    """Render ``web_assets/panels/<template>.html`` with these values, all escaped.

    viser inserts the text of ``add_html`` into the page unchanged: a ``<script>`` in an exception message
    would run there. So all text for ``add_html`` is rendered here. Invisible characters are replaced by
    visible ones: a character that changes the writing direction makes one name look like another. A lone
    surrogate, as in a file name that is not UTF-8, cannot be sent to a page at all.
    """
    return _environment().get_template(f"{template}.html").render(**values)


class _HasFileLine(Protocol):
    @property
    def file(self) -> str | None: ...
    @property
    def line(self) -> int | None: ...


def place(thing: _HasFileLine | None) -> str:
    """``push.py:88`` for a problem, a finding or a busy worker; empty if no file is known."""
    if thing is None or not thing.file:
        return ""
    return Path(thing.file).name + (f":{thing.line}" if thing.line else "")


def size(count: float) -> str:
    """Bytes with three digits: ``640 B``, ``2.5 MB``, ``1.2 GB`` (1 kB is 1000 B)."""
    for unit in ("B", "kB", "MB"):
        if count < 999.5:
            return f"{count:.3g} {unit}"
        count /= 1000
    return f"{count:.3g} GB"


def percent(done: float, total: float) -> int:
    """Completed share in percent; 0 while the total is unknown."""
    return round(100 * done / total) if total else 0


COLOURS = ("#228be6", "#f08c00", "#2f9e44", "#be4bdb")


def letter(index: int) -> str:
    """Label of a recording on the page: A to Z, then AA, AB."""
    return ("" if index < 26 else letter(index // 26 - 1)) + chr(ord("A") + index % 26)


def colour(index: int) -> str:
    """Colour of a compared recording, in legends, curves and the view."""
    return COLOURS[index % len(COLOURS)]


def short_text(text: str, longest: int = 120) -> str:
    return text if len(text) <= longest else text[: longest - 1] + "…"


def sentence(why: str) -> str:
    """The text with a capital letter and a full stop."""
    end = "" if why.endswith((".", "?", "!", "…")) else "."
    return f"{why[:1].upper()}{why[1:]}{end}" if why else ""


def counted(count: int, what: str) -> str:
    """A number and its noun: ``1 step``, ``7 steps``."""
    return f"{count} {what}" if count == 1 else f"{count} {what}s"


def asks(command: Command) -> str:
    """The value of ``data-do``: a press sends this command (``web_assets/input.js``)."""
    return json.dumps(command.encode())


def _shown(value: Any) -> Any:
    # Not Markup: that is a template's own text, whose values are already escaped.
    return plain_text(value, "\n\t") if type(value) is str else value


@cache
def _environment() -> jinja2.Environment:
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(web_assets_folder() / "panels"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        finalize=_shown,
        trim_blocks=True,
        lstrip_blocks=True,
        auto_reload=False,  # with True, every drawing would stat the template's file
    )
    filters = (place, size, percent, counted, rate_text, short_text, letter, colour, asks)
    environment.filters.update({filter.__name__: filter for filter in filters})
    macros = environment.get_template("can_be_pressed.html").module
    environment.globals.update(
        {name: getattr(macros, name) for name in ("press", "to_copy", "at_line", "badge", "with_code")}
    )
    return environment
