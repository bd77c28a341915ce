"""The machine's own Chromium, which the tests drive."""

from __future__ import annotations

import os
import re
import shutil
import subprocess

from workbench.machine.apt import has_apt, os_release

VARIABLE = "PLAYWRIGHT_CHROMIUM"
NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")


def find_chromium() -> str | None:
    """Path of a working Chromium: the one named by PLAYWRIGHT_CHROMIUM, else the first on PATH."""
    named = os.environ.get(VARIABLE)
    candidates = [named] if named else [path for name in NAMES if (path := shutil.which(name))]
    return next((path for path in candidates if chromium_version(path) is not None), None)


def chromium_version(path: str) -> str | None:
    """What ``PATH --version`` prints, None if it does not run or is not a Chromium.

    Ubuntu's ``chromium-browser`` may be a script that only says "install the snap": a name on PATH proves nothing.
    """
    try:
        done = subprocess.run(
            [path, "--version"], stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=20
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    # Another program of that name may succeed too; a browser's version has four numbers.
    version = re.search(r"\d+(\.\d+){3}", done.stdout)
    return done.stdout.strip() if done.returncode == 0 and version else None


def how_to_get_chromium() -> str:
    """Advice for this machine, in one sentence."""
    named = os.environ.get(VARIABLE)
    if named:
        return f"{VARIABLE}={named} is no Chromium that runs: correct the path or unset the variable."
    if has_apt() and os_release().get("ID") == "debian":
        return "Type: sudo apt-get install --no-install-recommends chromium fonts-liberation"
    return (
        "Install Chromium or Google Chrome so that `chromium` or `google-chrome` is on PATH, or name one in "
        f"{VARIABLE}. (Ubuntu's chromium package is a snap, which works on a desktop and not in a container.)"
    )
