"""Installs, with apt where possible, the browser that the tests drive and the library that Playwright needs."""

from __future__ import annotations

import ctypes
import importlib.util
import os
import subprocess
import sys
from pathlib import Path

from workbench.machine.apt import AptFailed, apt_install, can_install_packages, os_release
from workbench.machine.doctor import CHROMIUM_VARIABLE, find_chromium, how_to_get_chromium


def ensure_chromium() -> str | None:
    """Find a Chromium; on Debian as root install one. Without one, print how to get it and return None."""
    found = find_chromium()
    if (
        found is None
        and not os.environ.get(CHROMIUM_VARIABLE)
        and can_install_packages()
        and os_release().get("ID") == "debian"
    ):
        try:
            # No recommended packages: they install a Mesa that is too old for SAPIEN.
            apt_install("chromium", "fonts-liberation")
        except AptFailed as failure:
            print(failure, file=sys.stderr)
        found = find_chromium()
    if found is None:
        print(f"The browser tests will fail, there is no Chromium. {how_to_get_chromium()}", file=sys.stderr)
    return found


def driver_complaint() -> str | None:
    """Return why Playwright's own Node does not start; None if it does, or if Playwright is not installed."""
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
    """Install libatomic1: Playwright's Node loads it, and a bare Debian lacks it."""
    complaint = driver_complaint()
    if complaint is not None and _lacks_libatomic() and can_install_packages():
        try:
            apt_install("libatomic1")
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
