"""Where the files that the browser gets lie on this machine.

A source checkout keeps them in the top-level folder ``web_assets/``, where people look for them; a
wheel cannot install a folder beside the package, so it carries a copy as package data,
``workbench/_web_assets``. The wheel's copy is asked first, because an installed package must never
pick up a folder that merely happens to lie beside it in site-packages.
"""

from __future__ import annotations

from importlib import resources
from pathlib import Path


def web_assets_folder() -> Path:
    """Folder with the files for the browser.

    Raises:
        FileNotFoundError: neither the wheel's copy nor the checkout's folder is there.
    """
    package = Path(str(resources.files("workbench")))
    for folder in (package / "_web_assets", package.parent / "web_assets"):
        if (folder / "refused.html").is_file():
            return folder
    raise FileNotFoundError(
        f"The page's files are missing: neither {package / '_web_assets'} nor {package.parent / 'web_assets'} "
        "holds refused.html. Install workbench again (pip install --force-reinstall), or check out web_assets/."
    )
