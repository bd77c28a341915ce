"""The apt sources that a machine has, read so that one more can be written beside them.

Debian 12's own Mesa is too old for SAPIEN and its backports suite has a good one, but the line that
adds backports must name a mirror, and the right mirror is the one that this machine already uses: a
company's or a container's may be the only one that it reaches. So the sources are parsed, in both of
apt's formats (sources.list(5)): one line a source, ``deb [options] uri suite component...``, and
deb822 paragraphs with ``Types:``, ``URIs:``, ``Suites:``, ``Components:``. What says how a mirror is
trusted (``Signed-By``, ``Trusted``) is taken over with it, otherwise apt would refuse the new source.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from email.parser import HeaderParser
from pathlib import Path

CARRIED_OPTIONS = ("Signed-By", "Trusted", "Architectures")
ONE_LINE_NAMES = {"signed-by": "Signed-By", "trusted": "Trusted", "arch": "Architectures"}


@dataclass(frozen=True)
class AptSource:
    """One binary ("deb") source, in either format."""

    uris: tuple[str, ...]
    suites: tuple[str, ...]
    components: tuple[str, ...]
    options: dict[str, str] = field(default_factory=dict)
    """Those of `CARRIED_OPTIONS` that it sets, under their deb822 names, values as deb822 spells them."""


def parse_one_line_format(text: str) -> list[AptSource]:
    """The sources of a ``*.list`` file. Lines that are not a ``deb`` source are passed over."""
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
    """The enabled ``deb`` sources of a ``*.sources`` file: paragraphs of ``Name: value``, as a mail's header has them."""
    sources: list[AptSource] = []
    without_comments = "\n".join(line for line in text.splitlines() if not line.startswith("#"))
    for paragraph in re.split(r"\n\s*\n", without_comments):
        fields = HeaderParser().parsestr(paragraph.strip("\n"))
        types, uris, suites, components = (
            tuple(fields.get(name, "").split()) for name in ("Types", "URIs", "Suites", "Components")
        )
        if "deb" in types and uris and suites and fields.get("Enabled", "yes").strip().lower() != "no":
            # A value that goes on over lines, as an inline key does, keeps them.
            options = {name: fields[name].strip(" ") for name in CARRIED_OPTIONS if name in fields}
            sources.append(AptSource(uris, suites, components, options))
    return sources


def read_apt_sources(folder: Path = Path("/etc/apt")) -> list[AptSource]:
    """All sources of this machine, in the order in which apt reads the files."""
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
    """A deb822 source for ``CODENAME-backports`` on the mirror that ``CODENAME`` itself comes from.

    None if no source gives that release's ``main``, so that there is no mirror to take over. apt holds
    backports back by itself (its Release file says ``NotAutomatic``): adding it upgrades nothing.
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
