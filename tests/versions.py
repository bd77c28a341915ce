"""Runs the tests with other versions of the dependencies, and writes the table in web_assets/docs/reference/versions.md.

    python -m tests.versions tested nightly                 # ManiSkill's release and nightly build, by constraints.txt
    python -m tests.versions oldest newest --tests fast     # the ends of pyproject.toml's ranges; needs uv on PATH
    python -m tests.versions newest --python 3.12 --write   # also into the table

Sets: ``tested`` is constraints.txt with ManiSkill's release, ``nightly`` the same with its nightly build, ``oldest`` and
``newest`` the ends of the ranges, ``nightly-newest`` the nightly build with the newest of everything else. ``fast`` takes 3
minutes on two cores, ``all`` (the default) 17. Each set gets its own environment (3 to 8 GB) under ``--folder``, which is
kept for the next run. torch stays at the version of constraints.txt unless ``--torch`` gives another: releases are CUDA
builds of gigabytes.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import re
import shutil
import subprocess
import sys
import xml.etree.ElementTree
from dataclasses import dataclass
from pathlib import Path

import tomllib
from packaging.requirements import Requirement

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "web_assets" / "docs" / "reference" / "versions.md"
SHOWN = ("viser", "rerun-sdk", "sapien", "torch", "numpy", "gymnasium")
TESTS = {
    "fast": ["--fast"],
    "core": [
        "-m",
        "not slow",
        "tests/envs",
        "tests/pictures",
        "tests/task/test_make.py",
        "tests/record/test_gym_wrapper.py",
    ],
    "all": ["-m", "not slow"],
}
"""``fast`` is ``make test-fast``, ``all`` is ``make test``; both without the linters."""


@dataclass(frozen=True)
class VersionSet:
    extra: str
    """``maniskill`` or ``nightly``."""
    resolution: str
    """``tested``: constraints.txt; ``oldest`` or ``newest`` of pyproject.toml's ranges."""


SETS = {
    "tested": VersionSet("maniskill", "tested"),
    "oldest": VersionSet("maniskill", "oldest"),
    "newest": VersionSet("maniskill", "newest"),
    "nightly": VersionSet("nightly", "tested"),
    "nightly-newest": VersionSet("nightly", "newest"),
}


@dataclass(frozen=True)
class Result:
    """One row of the table."""

    name: str
    python: str
    tests: str
    date: str
    maniskill: str
    versions: tuple[str, ...]
    """Versions of the packages in `SHOWN`."""
    passed: int
    failed: int
    skipped: int

    def row(self) -> str:
        counts = f"{self.passed} passed, {self.failed} failed, {self.skipped} skipped"
        cells = (self.name, self.python, self.maniskill, *self.versions, self.tests, counts, self.date)
        return f"| {' | '.join(cells)} |"


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("sets", nargs="+", choices=SETS, metavar="SET", help=", ".join(SETS))
    parser.add_argument("--python", default=f"{sys.version_info.major}.{sys.version_info.minor}")
    parser.add_argument("--tests", choices=TESTS, default="all")
    parser.add_argument("--torch", default=pins()["torch"], help="the version of torch")
    parser.add_argument("--folder", type=Path, default=Path.home() / ".cache" / "workbench" / "versions")
    parser.add_argument("--write", action="store_true", help="put the results into the table")
    options = parser.parse_args()
    failed = False
    for name in options.sets:
        python = install(name, options.python, options.torch, options.folder)
        result = run_tests(name, options.tests, python, options.folder)
        print(result.row(), flush=True)
        failed |= bool(result.failed)
        if options.write:
            PAGE.write_text(with_row(PAGE.read_text(), result))
    return int(failed)


# --- environments ------------------------------------------------------------------------------------


def pins() -> dict[str, str]:
    """The tested versions: distribution to version."""
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    return {name: version for name, _, version in (line.partition("==") for line in lines) if version}


def requirements(chosen: VersionSet, torch: str) -> list[str]:
    """Requirements to install: ranges of pyproject.toml, test tools, and torch at one version."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    wanted = [
        line for line in project["dependencies"] + extras[chosen.extra] if Requirement(line).name != "torch"
    ]
    exact = pins()
    tools = [Requirement(line) for line in extras["test"]]
    return [*wanted, f"torch=={torch}", *(f"{tool.name}=={exact[tool.name]}" for tool in tools)]


def install(name: str, version: str, torch: str, folder: Path) -> Path:
    """Create or update the environment of this set; return its interpreter."""
    uv, chosen = shutil.which("uv"), SETS[name]
    venv = folder / f"{name}-{version}"
    python = venv / "bin" / "python"
    if not python.exists():
        maker = (
            [uv, "venv", "-q", "--seed", "--python", version] if uv else [f"python{version}", "-m", "venv"]
        )
        subprocess.run([*maker, str(venv)], check=True)
    installer = (
        [uv, "pip", "install", "--python", str(python)] if uv else [str(python), "-m", "pip", "install"]
    )
    how = {
        "tested": ["-c", str(ROOT / "constraints.txt")],
        "oldest": ["--resolution", "lowest-direct"],
        "newest": ["--upgrade"],
    }[chosen.resolution]
    if chosen.resolution == "oldest" and uv is None:
        sys.exit("The oldest versions are found by uv: pip install uv")
    if uv and (links := os.environ.get("PIP_FIND_LINKS")):
        how += ["--find-links", links]
    subprocess.run([*installer, "-q", *how, *requirements(chosen, torch)], check=True)
    subprocess.run([*installer, "-q", "--no-deps", "-e", str(ROOT)], check=True)
    return python


# --- tests -------------------------------------------------------------------------------------------


def run_tests(name: str, tests: str, python: Path, folder: Path) -> Result:
    report = folder / f"{python.parents[1].name}-{tests}.xml"
    report.unlink(missing_ok=True)
    command = [str(python), "-m", "pytest", *TESTS[tests], "-n", "2", "--dist", "loadfile"]
    subprocess.run(
        [*command, "--no-loadscope-reorder", f"--junitxml={report}"], cwd=ROOT, env=environment(python)
    )
    (suite,) = xml.etree.ElementTree.parse(report).getroot().iter("testsuite")
    total, skipped = int(suite.attrib["tests"]), int(suite.attrib["skipped"])
    failed = int(suite.attrib["failures"]) + int(suite.attrib["errors"])
    installed = json.loads(
        subprocess.run(
            [str(python), "-c", _WHAT_IS_INSTALLED], check=True, capture_output=True, text=True
        ).stdout
    )
    return Result(
        name,
        ".".join(installed["python"].split(".")[:2]),
        tests,
        datetime.date.today().isoformat(),
        next(installed[each] for each in ("mani_skill", "mani_skill-nightly") if installed[each]),
        tuple(installed[each] for each in SHOWN),
        total - failed - skipped,
        failed,
        skipped,
    )


_WHAT_IS_INSTALLED = f"""
import importlib.metadata, json, platform
def version(name):
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return ""
names = {(*SHOWN, "mani_skill", "mani_skill-nightly")!r}
print(json.dumps({{"python": platform.python_version(), **{{name: version(name) for name in names}}}}))
"""


def environment(python: Path) -> dict[str, str]:
    """The current environment variables, with the software Vulkan driver that `make test` also uses."""
    lines = subprocess.run(
        [str(python), "-m", "workbench.machine.software_vulkan", "--export"],
        check=True,
        capture_output=True,
        text=True,
        cwd=ROOT,
    ).stdout
    exported = dict(re.findall(r"^export (\w+)='?([^'\n]*)'?", lines, re.M))
    return {**os.environ, **exported}


# --- the table ---------------------------------------------------------------------------------------


def rows(text: str) -> list[list[str]]:
    """Cells of the table's rows."""
    lines = [line for line in text.splitlines() if line.startswith("| ")]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    return [row for row in cells if row[0] in SETS]


def with_row(text: str, result: Result) -> str:
    """The page with this row, which replaces one of the same set, Python and tests."""
    key = (result.name, result.python, result.tests)
    lines: list[str] = []
    place = None
    for line in text.splitlines():
        (cells,) = rows(line) or [None]
        if cells is not None and (cells[0], cells[1], cells[-3]) == key:
            continue
        lines.append(line)
        # After the last row: other tables follow.
        if line.startswith("| set |") or (place == len(lines) - 1 and line.startswith("|")):
            place = len(lines)
    if place is None:
        raise ValueError(f"{PAGE.name} has no table of results")
    lines.insert(place, result.row())
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    sys.exit(main())
