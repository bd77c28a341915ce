"""Installing Debian packages, where that is allowed, and the command to type where it is not.

Set-up must not stop to ask, must not fail because an unattended upgrade holds dpkg's lock for a
moment, and must never pretend: without root it installs nothing and hands back the command.
"""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass

LOCK_WAIT_S = 180


class AptFailed(RuntimeError):
    """apt-get did not do it; the message carries the end of what it said."""


@dataclass(frozen=True)
class PackageVersion:
    version: str
    suite: str
    """As apt names it in ``-t``: ``bookworm-backports``."""


def has_apt() -> bool:
    """True on Debian, Ubuntu and what descends from them."""
    return shutil.which("apt-get") is not None


def can_install_packages() -> bool:
    """True for root on a machine with apt."""
    return has_apt() and os.geteuid() == 0


def os_release() -> dict[str, str]:
    """The fields of os-release(5): ``ID`` ("debian"), ``VERSION_CODENAME`` ("bookworm") and so on; empty without it."""
    try:
        return platform.freedesktop_os_release()
    except OSError:
        return {}


def apt_get(arguments: Sequence[str], options: Sequence[str] = (), timeout_s: float = 900) -> None:
    """Run apt-get without questions; its output goes to stderr so that stdout stays for shell lines.

    Raises:
        AptFailed: it is missing, ended with an error or took longer than `timeout_s`.
    """
    command = ["apt-get", "-q", "-y", "-o", f"DPkg::Lock::Timeout={LOCK_WAIT_S}", *options, *arguments]
    environment = {**os.environ, "DEBIAN_FRONTEND": "noninteractive", "LC_ALL": "C.UTF-8"}
    print("+ " + " ".join(["apt-get", *arguments]), file=sys.stderr, flush=True)
    try:
        done = subprocess.run(
            command,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            env=environment,
            timeout=timeout_s,
        )
    except (OSError, subprocess.TimeoutExpired) as problem:
        raise AptFailed(f"{' '.join(command)}: {problem}") from problem
    if done.returncode != 0:
        said = "\n".join((done.stdout + done.stderr).strip().splitlines()[-12:])
        raise AptFailed(f"{' '.join(command)} ended with {done.returncode}:\n{said}")


def apt_install(*packages: str) -> None:
    """Install what apt's lists have now, without what is only recommended. Raises AptFailed."""
    apt_get(["update"])
    apt_get(["install", "--no-install-recommends", *packages])


def available_versions(package: str, options: Sequence[str] = ()) -> list[PackageVersion]:
    """What apt could install, newest first; empty without apt or before the first ``apt-get update``."""
    if shutil.which("apt-cache") is None:
        return []
    done = subprocess.run(
        ["apt-cache", *options, "madison", package], capture_output=True, text=True, timeout=60
    )
    return parse_madison(done.stdout)


def parse_madison(text: str) -> list[PackageVersion]:
    """``apt-cache madison``: ``package | version | uri suite/component arch Packages``, newest first."""
    versions: list[PackageVersion] = []
    for line in text.splitlines():
        columns = [column.strip() for column in line.split("|")]
        if len(columns) == 3 and columns[2].endswith("Packages") and len(columns[2].split()) >= 3:
            versions.append(PackageVersion(columns[1], columns[2].split()[1].rsplit("/", 1)[0]))
    return versions
