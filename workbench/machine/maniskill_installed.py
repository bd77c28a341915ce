"""Finds the installed distributions of ManiSkill without importing it; advises if none or both are there."""

from __future__ import annotations

import importlib.metadata
import json
import shlex
import sys
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from workbench.machine import DISTRIBUTION

EXTRAS: Mapping[str, str] = {"mani_skill": "maniskill", "mani_skill-nightly": "nightly"}
"""ManiSkill's distributions, which write the same files, each with the extra of the workbench that requires it."""


def lacks_maniskill() -> bool:
    """Whether ``import mani_skill`` would find no code. A folder of that name that contains only assets does
    not count."""
    spec = find_spec("mani_skill")
    return spec is None or spec.origin is None


def installed_maniskills() -> dict[str, str]:
    """Installed versions of ManiSkill, by distribution. A clone that is only on the path does not count."""
    found = {}
    for name in EXTRAS:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found


def lines_if_lacking(what: str, arguments: Sequence[str] | None = None) -> tuple[str, str] | None:
    """Two lines if ManiSkill is not installed: that `what` needs it, and the command to type. None if it is installed.

    Args:
        arguments: arguments of the ``workbench`` command, as typed; None if this process was not started by
            that command.
    """
    if not lacks_maniskill():
        return None
    if found := installed_maniskills():
        name, version = next(iter(found.items()))
        return (
            f"{what} needs ManiSkill: {name} {version} is installed in {sys.prefix} without its files, which were "
            "deleted when another distribution of ManiSkill was removed.",
            f"Type: {pip_command('uninstall', name)} && {pip_command('install', f'{name}=={version}')}",
        )
    command = command_to_install("mani_skill", arguments)
    return f"{what} needs ManiSkill, which is not installed in {sys.prefix}.", f"Type: {command}"


def lines_if_mixed() -> tuple[str, str, str] | None:
    """Three lines if both distributions are installed: the problem, and the commands that keep one of them.
    Else None."""
    found = installed_maniskills()
    if len(found) < 2:
        return None
    release, nightly = (f"{name}=={version}" for name, version in found.items())
    uninstall = pip_command("uninstall", *found)
    return (
        f"{release} and {nightly} are both installed, and one has overwritten files of the other: keep one "
        "of them.",
        f"To keep the release, type: {uninstall} && {pip_command('install', release)}",
        f"To keep the nightly build, type: {uninstall} && {pip_command('install', nightly)}",
    )


def command_to_install(name: str, arguments: Sequence[str] | None = None) -> str:
    """The command that installs this distribution of ManiSkill into the environment of this process: with uv
    if uv made the environment, else with pip. The environment of a uv tool is rebuilt, not extended.
    """
    kind = _uv_environment()
    ours = shlex.quote(f"{DISTRIBUTION}[{EXTRAS[name]}]{_came_from()}")
    if kind == "tool":
        return f"uv tool install --force {ours}"
    if kind == "uvx":
        # The options that uvx got before --from are not known here.
        rest = "..." if arguments is None else shlex.join(arguments)
        return f"uvx --from {ours} workbench {rest}  # with the -c and --find-links that you gave uvx"
    return pip_command("install", _requirement(name))


def pip_command(verb: str, *requirements: str) -> str:
    """The command that installs or uninstalls these requirements in the environment of this process: with uv
    if uv made the environment, else with pip."""
    python = shlex.quote(sys.executable)
    if _uv_environment() is not None:
        command = f"uv pip {verb} --python {python}"
    else:
        command = f"{python} -m pip {verb}{' -y' if verb == 'uninstall' else ''}"
    return f"{command} {' '.join(map(shlex.quote, requirements))}"


def _requirement(name: str) -> str:
    """Name and versions of this distribution as the workbench's metadata require them; only the name if the
    workbench is not installed."""
    try:
        lines = importlib.metadata.requires(DISTRIBUTION) or []
    except importlib.metadata.PackageNotFoundError:
        return name
    for requirement in map(Requirement, lines):
        if canonicalize_name(requirement.name) == canonicalize_name(name):
            return f"{name}{requirement.specifier}"
    return name


def _uv_environment() -> str | None:
    """``uvx`` (in uv's cache), ``tool`` (of ``uv tool install``) or ``venv`` if uv made this environment; else None."""
    prefix = Path(sys.prefix)
    try:
        keys = {line.partition("=")[0].strip() for line in (prefix / "pyvenv.cfg").read_text().splitlines()}
    except OSError:
        return None
    if (prefix / "uv-receipt.toml").is_file():
        return "tool"
    if "uv" not in keys:
        return None
    return "uvx" if _is_in_uv_cache(prefix) else "venv"


def _is_in_uv_cache(prefix: Path) -> bool:
    # Wherever the cache is, uv keeps environments in folders with these names.
    return any(parent.name.startswith(("archive-v", "builds-v")) for parent in prefix.resolve().parents)


def _came_from() -> str:
    """`` @ URL`` of the wheel or folder that the workbench was installed from; empty if it came from an index."""
    try:
        text = importlib.metadata.distribution(DISTRIBUTION).read_text("direct_url.json")
    except importlib.metadata.PackageNotFoundError:
        return ""
    url = json.loads(text).get("url") if text else None
    return f" @ {url}" if url else ""
