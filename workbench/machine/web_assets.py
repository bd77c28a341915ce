"""Finds the folder with the browser's files."""

from __future__ import annotations

from importlib import resources
from pathlib import Path


def web_assets_folder() -> Path:
    """Folder with the files for the browser: ``web_assets/`` of a checkout, ``workbench/_web_assets`` of a wheel.

    The wheel's copy is asked first: an installed package must not pick up a folder beside it in site-packages.

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
