"""Installs Debian packages where that is allowed, and reads apt's sources."""

from __future__ import annotations

import os
import platform
import re
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from email.parser import HeaderParser
from pathlib import Path

LOCK_TIMEOUT_SECONDS = 180


class AptFailed(RuntimeError):
    """apt-get failed; the message has the end of its output."""


@dataclass(frozen=True)
class PackageVersion:
    version: str
    suite: str
    """Name of the release, as apt's option ``-t`` takes it: ``bookworm-backports``."""


def has_apt() -> bool:
    """Whether this is Debian, Ubuntu or a derivative."""
    return shutil.which("apt-get") is not None


def can_install_packages() -> bool:
    """Whether this process runs as root on a machine with apt."""
    return has_apt() and os.geteuid() == 0


def os_release() -> dict[str, str]:
    """The fields of os-release(5): ``ID`` ("debian"), ``VERSION_CODENAME`` ("bookworm") and so on; empty if
    there is no such file."""
    try:
        return platform.freedesktop_os_release()
    except OSError:
        return {}


def apt_get(arguments: Sequence[str], options: Sequence[str] = (), timeout_s: float = 900) -> None:
    """Run apt-get without questions, waiting for dpkg's lock, which an unattended upgrade may hold.

    Raises:
        AptFailed: apt-get is missing, failed, or took longer than `timeout_s`.
    """
    command = [
        "apt-get",
        "-q",
        "-y",
        "-o",
        f"DPkg::Lock::Timeout={LOCK_TIMEOUT_SECONDS}",
        *options,
        *arguments,
    ]
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
        output = "\n".join((done.stdout + done.stderr).strip().splitlines()[-12:])
        raise AptFailed(f"{' '.join(command)} ended with {done.returncode}:\n{output}")


def apt_install(*packages: str) -> None:
    """Update apt's lists and install these packages without recommended ones. Raises AptFailed."""
    apt_get(["update"])
    apt_get(["install", "--no-install-recommends", *packages])


def available_versions(package: str, options: Sequence[str] = ()) -> list[PackageVersion]:
    """Versions that apt offers, newest first; empty without apt or before the first ``apt-get update``."""
    if shutil.which("apt-cache") is None:
        return []
    done = subprocess.run(
        ["apt-cache", *options, "madison", package], capture_output=True, text=True, timeout=60
    )
    return parse_madison(done.stdout)


def parse_madison(text: str) -> list[PackageVersion]:
    """Parse ``apt-cache madison``: ``package | version | uri suite/component arch Packages``, newest first."""
    versions: list[PackageVersion] = []
    for line in text.splitlines():
        columns = [column.strip() for column in line.split("|")]
        if len(columns) == 3 and columns[2].endswith("Packages") and len(columns[2].split()) >= 3:
            versions.append(PackageVersion(columns[1], columns[2].split()[1].rsplit("/", 1)[0]))
    return versions


# --- sources ---------------------------------------------------------------------------------------

CARRIED_OPTIONS = ("Signed-By", "Trusted", "Architectures")
ONE_LINE_NAMES = {"signed-by": "Signed-By", "trusted": "Trusted", "arch": "Architectures"}


@dataclass(frozen=True)
class AptSource:
    """One binary ("deb") source, in either format of sources.list(5).

    One format has a line for each source, ``deb [options] uri suite component...``. The other, deb822, has
    paragraphs with ``Types:``, ``URIs:``, ``Suites:``, ``Components:``.
    """

    uris: tuple[str, ...]
    suites: tuple[str, ...]
    components: tuple[str, ...]
    options: dict[str, str] = field(default_factory=dict)
    """Options of the source among `CARRIED_OPTIONS`, with names and values as in deb822."""


def parse_one_line_format(text: str) -> list[AptSource]:
    """The ``deb`` sources of a ``*.list`` file."""
    return [
        source for line in text.splitlines() if (source := _parse_line(line.split("#", 1)[0])) is not None
    ]


def _parse_line(line: str) -> AptSource | None:
    match = re.match(r"\s*deb\s+(?:\[([^\]]*)\]\s*)?(\S+)\s+(\S+)((?:\s+\S+)*)\s*$", line)
    if match is None:
        return None
    options: dict[str, str] = {}
    for option in (match[1] or "").split():
        name, _, value = option.partition("=")
        if name.lower() in ONE_LINE_NAMES:
            options[ONE_LINE_NAMES[name.lower()]] = value.replace(",", " ")
    return AptSource((match[2],), (match[3],), tuple(match[4].split()), options)


def parse_deb822_format(text: str) -> list[AptSource]:
    """The enabled ``deb`` sources of a ``*.sources`` file: paragraphs of ``Name: value``, as in a mail header."""
    sources: list[AptSource] = []
    without_comments = "\n".join(line for line in text.splitlines() if not line.startswith("#"))
    for paragraph in re.split(r"\n\s*\n", without_comments):
        fields = HeaderParser().parsestr(paragraph.strip("\n"))
        types, uris, suites, components = (
            tuple(fields.get(name, "").split()) for name in ("Types", "URIs", "Suites", "Components")
        )
        if "deb" in types and uris and suites and fields.get("Enabled", "yes").strip().lower() != "no":
            # A value of several lines (an inline key) keeps its line ends.
            options = {name: fields[name].strip(" ") for name in CARRIED_OPTIONS if name in fields}
            sources.append(AptSource(uris, suites, components, options))
    return sources


def read_apt_sources(folder: Path = Path("/etc/apt")) -> list[AptSource]:
    """All sources of this machine, in apt's order of files."""
    sources: list[AptSource] = []
    for path in [folder / "sources.list", *sorted((folder / "sources.list.d").glob("*"))]:
        if not path.is_file():
            continue
        if path.suffix == ".list":
            sources += parse_one_line_format(path.read_text(errors="replace"))
        elif path.suffix == ".sources":
            sources += parse_deb822_format(path.read_text(errors="replace"))
    return sources


def backports_source(sources: list[AptSource], codename: str) -> str | None:
    """A deb822 source for ``CODENAME-backports`` on the mirror of ``CODENAME`` itself; None if no source has
    ``CODENAME``'s ``main``.

    The same mirror is used, since the machine may reach no other. The trust options of its source
    (``Signed-By``, ``Trusted``) are copied, since apt would refuse the new source without them. The new
    source upgrades no package: the Release file of backports has ``NotAutomatic``.
    """
    for source in sources:
        if codename in source.suites and "main" in source.components:
            lines = [
                "# Written by Workbench: SAPIEN's software Vulkan driver needs Mesa 24.3 or newer.",
                "Types: deb",
                f"URIs: {' '.join(source.uris)}",
                f"Suites: {codename}-backports",
                "Components: main",
                *(f"{name}: {value}" for name, value in source.options.items()),
            ]
            return "\n".join(lines) + "\n"
    return None
