"""HTML of the panels, made from the templates in ``web_assets/panels``.

viser puts the text of ``add_html`` into the page as it is, so one message of an author's exception
with a ``<script>`` in it would run there. Everything that is shown as HTML therefore goes through
`render`, which escapes every value it is given; no other module writes a tag.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import jinja2

import workbench


@cache
def asset_folder() -> Path:
    """The folder of files for the browser: inside the package once installed, beside it in the repo."""
    package = Path(workbench.__file__).parent
    for folder in (package / "web_assets", package.parent / "web_assets"):
        if (folder / "panels").is_dir():
            return folder
    raise FileNotFoundError(
        f"web_assets/panels is neither in {package} nor beside it: the installation is incomplete, "
        "install the package again"
    )


def render(template: str, **values: Any) -> str:
    """``web_assets/panels/<template>.html`` with these values, all of them escaped."""
    return _environment().get_template(f"{template}.html").render(**values)


def style_sheet() -> str:
    """The page's own CSS as one ``<style>`` element."""
    css = (asset_folder() / "panels" / "page.css").read_text(encoding="utf-8")
    return f"<style>{css}</style>"


@cache
def _environment() -> jinja2.Environment:
    return jinja2.Environment(
        loader=jinja2.FileSystemLoader(asset_folder() / "panels"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
