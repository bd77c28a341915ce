"""The browser that the tests drive: the machine's own Chromium, brought by apt where that is possible.

Playwright's own browsers come from a download that many machines cannot reach, and a system Chromium
is what users have. Ubuntu's ``chromium-browser`` is a snap behind a shell script that may only say
"install the snap", so a name on PATH proves nothing: it must tell its version.
"""

from __future__ import annotations

import ctypes
import importlib.util
import os
import shutil
import subprocess
import sys
from pathlib import Path

from workbench.machine.apt import AptFailed, apt_get, can_install_packages, has_apt, os_release

VARIABLE = "PLAYWRIGHT_CHROMIUM"
NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")


def find_chromium() -> str | None:
    """Path of a Chromium that runs: the one that PLAYWRIGHT_CHROMIUM names, else the first on PATH."""
    named = os.environ.get(VARIABLE)
    candidates = [named] if named else [path for name in NAMES if (path := shutil.which(name))]
    return next((path for path in candidates if chromium_version(path) is not None), None)


def chromium_version(path: str) -> str | None:
    """What ``PATH --version`` says, None if it does not run or is not a Chromium."""
    try:
        done = subprocess.run(
            [path, "--version"], stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=20
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    said = done.stdout.strip()
    # A browser tells what it is by this line alone; another program of that name may end with 0 too.
    return said if done.returncode == 0 and ("Chrom" in said) else None


def how_to_get_chromium() -> str:
    """One sentence for a person on this machine."""
    named = os.environ.get(VARIABLE)
    if named:
        return f"{VARIABLE}={named} is no Chromium that runs: correct the path or unset the variable."
    if has_apt() and os_release().get("ID") == "debian":
        return "Type: sudo apt-get install --no-install-recommends chromium fonts-liberation"
    return (
        "Install Chromium or Google Chrome so that `chromium` or `google-chrome` is on PATH, or name one in "
        f"{VARIABLE}. (Ubuntu's chromium package is a snap, which works on a desktop and not in a container.)"
    )


def ensure_chromium() -> str | None:
    """Find a Chromium; on Debian as root install one. None, after a sentence on stderr, if there is none."""
    found = find_chromium()
    if (
        found is None
        and not os.environ.get(VARIABLE)
        and can_install_packages()
        and os_release().get("ID") == "debian"
    ):
        try:
            apt_get(["update"])
            # Without its recommended packages: they bring a Mesa that is too old for SAPIEN.
            apt_get(["install", "--no-install-recommends", "chromium", "fonts-liberation"])
        except AptFailed as failure:
            print(failure, file=sys.stderr)
        found = find_chromium()
    if found is None:
        print(f"The browser tests will fail, there is no Chromium. {how_to_get_chromium()}", file=sys.stderr)
    return found


def driver_complaint() -> str | None:
    """Why Playwright's own Node does not start here; None if it does, or if Playwright is not installed."""
    package = importlib.util.find_spec("playwright")
    if package is None or package.origin is None:
        return None
    node = Path(package.origin).parent / "driver" / "node"
    try:
        done = subprocess.run(
            [node, "--version"], stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=20
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        return str(error)
    return None if done.returncode == 0 else done.stderr.strip()


def _lacks_libatomic() -> bool:
    try:
        ctypes.CDLL("libatomic.so.1")
    except OSError:
        return True
    return False


def ensure_driver() -> None:
    """Bring the one library that Playwright's Node loads and a bare Debian lacks."""
    complaint = driver_complaint()
    if complaint is not None and _lacks_libatomic() and can_install_packages():
        try:
            apt_get(["update"])
            apt_get(["install", "--no-install-recommends", "libatomic1"])
        except AptFailed as failure:
            print(failure, file=sys.stderr)
        complaint = driver_complaint()
    if complaint is not None:
        print(f"The browser tests will fail, Playwright does not start: {complaint}", file=sys.stderr)
        if _lacks_libatomic():
            print("Type: sudo apt-get install libatomic1", file=sys.stderr)


if __name__ == "__main__":
    ensure_chromium()
    ensure_driver()
