"""Installed versions of packages whose private names the workbench uses, and which of these names have moved."""

from __future__ import annotations

import dis
import importlib
import importlib.metadata
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from types import CodeType
from typing import Any

from packaging.requirements import Requirement

from workbench.machine import DISTRIBUTION
from workbench.machine.maniskill_installed import EXTRAS, installed_maniskills, pip_command

MANISKILL = tuple(EXTRAS)
"""Two distributions with the same files: the release, and the nightly build."""
_EPISODE_PACKAGES = (DISTRIBUTION, *MANISKILL, "sapien", "torch", "rerun-sdk")
TESTED = {
    "mani_skill": ("3.0.1",),
    "mani_skill-nightly": ("2026.8.2.400",),
    "sapien": ("3.0.3",),
    "viser": ("1.1.1",),
    "rerun-sdk": ("0.41.0",),
}
"""Versions with which all tests pass: those in ``constraints.txt``, and further ones that the page on
versions lists."""


@dataclass(frozen=True)
class PrivateName:
    """A private name of another package that the workbench uses."""

    owner: str
    """Owner of the name: a module, or a module and class as ``package.module:Class``."""
    name: str
    """Attribute of the owner; for a class, also a field that is annotated or that its methods assign."""
    disables: str = ""
    """The feature that does not work without the name; empty if no task can be opened without it."""

    @property
    def dotted(self) -> str:
        return f"{self.owner.rpartition(':')[2].rpartition('.')[2]}.{self.name}"

    def exists(self) -> bool:
        """Whether the name exists. Imports its module."""
        module, _, path = self.owner.partition(":")
        try:
            owner: Any = importlib.import_module(module)
            for part in path.split(".") if path else ():
                owner = getattr(owner, part)
        except (ImportError, AttributeError):
            return False
        if hasattr(owner, self.name):
            return True
        return isinstance(owner, type) and any(self.name in _names_of(cls) for cls in owner.__mro__)


@cache
def _names_of(cls: type) -> frozenset[str]:
    """Annotated fields of a class, and attributes that its methods assign on any object."""
    found = set(cls.__dict__.get("__annotations__", ()))
    for member in vars(cls).values():
        accessors = (member.fget, member.fset) if isinstance(member, property) else (member,)
        for function in accessors:
            code = getattr(getattr(function, "__func__", function), "__code__", None)
            found |= stored_names(code) if code is not None else set()
    return frozenset(found)


_STORE, _LOADS = dis.opmap["STORE_ATTR"], (dis.opmap["LOAD_FAST"], dis.opmap["LOAD_DEREF"])


def stored_names(code: CodeType, of: str | None = None) -> set[str]:
    """Attributes that a function and its inner functions assign: on any object or, if `of` is given, only on
    the variable with this name.

    Reads the raw bytecode, because `dis` or the source text would take a third of a second for ManiSkill's
    BaseEnv, at each start.
    """
    found: set[str] = set()
    for each in _codes(code):
        variables = each.co_varnames + each.co_cellvars + each.co_freevars
        owner, argument = "", 0
        for operation, low in zip(each.co_code[::2], each.co_code[1::2], strict=True):
            argument = argument << 8 | low
            if operation == dis.EXTENDED_ARG:
                continue
            if operation == _STORE and of in (None, owner):
                found.add(each.co_names[argument])
            if operation != _CACHE:
                owner = variables[argument] if operation in _LOADS and argument < len(variables) else ""
            argument = 0
    return found


_CACHE = dis.opmap.get("CACHE", 0)
"""Opcode of the cache entries that follow an instruction."""


def _codes(code: CodeType) -> Iterator[CodeType]:
    yield code
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _codes(constant)


def installed(distribution: str) -> str | None:
    """Installed version of a distribution; None if it is not installed."""
    try:
        return importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return None


@cache
def package_versions() -> Mapping[str, str]:
    """Installed versions of the packages that an episode depends on, by name."""
    versions = {name: installed(name) for name in _EPISODE_PACKAGES}
    return {name: version for name, version in versions.items() if version is not None}


def maniskill() -> tuple[str, str] | None:
    """Distribution and version of the installed ManiSkill; None if it is not installed."""
    return next(iter(installed_maniskills().items()), None)


def untested(distributions: Iterable[str] = TESTED) -> dict[str, str]:
    """Installed versions of these distributions that are not tested."""
    found = {name: installed(name) for name in distributions}
    return {name: v for name, v in found.items() if v is not None and v not in TESTED[name]}


def command_for_tested_versions() -> str:
    """The command that installs the tested versions of the installed packages."""
    wanted = [f"{name}=={TESTED[name][0]}" for name in TESTED if installed(name) is not None]
    return pip_command("install", *wanted)


def unmet_requirements() -> list[tuple[Requirement, str | None]]:
    """Requirements of the workbench that the installed packages do not meet, each with the installed version
    of the package; None if it is missing.

    Raises:
        importlib.metadata.PackageNotFoundError: The distribution itself is not installed.
    """
    found = []
    for requirement in map(Requirement, importlib.metadata.requires(DISTRIBUTION) or []):
        if requirement.marker is not None and not requirement.marker.evaluate({"extra": ""}):
            continue
        version = installed(requirement.name)
        if version is None or not requirement.specifier.contains(version, prereleases=True):
            found.append((requirement, version))
    return found


def unmet_lines() -> tuple[str, str] | None:
    """Two lines if requirements are unmet: which, and the command to type. None if all are met, or the workbench is
    not installed."""
    try:
        unmet = unmet_requirements()
    except importlib.metadata.PackageNotFoundError:
        return None
    if not unmet:
        return None
    wrong = (f"{r} is {'missing' if v is None else f'required, {v} is installed'}" for r, v in unmet)
    return f"{'; '.join(wrong)}.", f"Type: {pip_command('install', *(str(r) for r, _ in unmet))}"


def untested_text() -> str:
    """The installed versions that are not tested, and the command for the tested ones; empty if all are tested."""
    names = ", ".join(f"{name} {version}" for name, version in untested().items())
    return (
        f"Not tested with the workbench: {names}. The tested versions: {command_for_tested_versions()}"
        if names
        else ""
    )


def moved_text(moved: Iterable[PrivateName]) -> str:
    """Features that do not work, each with the names that have moved; empty if no name has moved."""
    lacking: dict[str, list[str]] = {}
    for each in moved:
        lacking.setdefault(each.disables or "opening a task", []).append(each.dotted)
    features = "; ".join(f"{feature} (needs {', '.join(names)})" for feature, names in lacking.items())
    return f"Not possible with the installed versions: {features}." if features else ""


def rerun_notice() -> str:
    """Notice that the installed version of rerun is untested and cannot record; else empty."""
    if not untested(["rerun-sdk"]):
        return ""  # rerun is not imported to open a task: it takes 0.3 s
    try:
        import rerun.blueprint  # noqa: F401
        from rerun.chunk import Chunk, LazyStore, RrdReader  # noqa: F401
        from rerun.error_utils import RerunWarning, catch_and_log_exceptions  # noqa: F401
    except ImportError as error:
        return f"Recordings are not possible: {error}. {untested_text()}"
    return ""
