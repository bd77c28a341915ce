"""Checks whether this machine can run the workbench, and advises on what is missing."""

from __future__ import annotations

import getpass
import json
import os
import platform
import re
import shutil
import socket
import subprocess
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from workbench.machine import DISTRIBUTION, versions
from workbench.machine.apt import has_apt, os_release
from workbench.machine.maniskill_installed import lacks_maniskill, lines_if_lacking, lines_if_mixed
from workbench.machine.processes.child_environment import child_environment, python_command
from workbench.machine.processes.confinement import landlock_version
from workbench.machine.render_probe import driver_files
from workbench.machine.software_vulkan import ensure_render_device

DEFAULT_PORT = 8080
MIN_MEMORY_GIB = 6.0
"""Minimum available memory, for one worker with 16 envs and cameras on a software driver, its warm spare, the
server and a browser."""
CHILD_TIMEOUT_SECONDS = 120

GPU_SCRIPT = """
import json, torch
from workbench.envs.backends import gpu_library_path, why_no_gpu_simulation
cuda = [torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count())] if torch.cuda.is_available() else []
print(json.dumps({"built": torch.version.cuda, "cuda": cuda,
                  "why_not": why_no_gpu_simulation(), "library": str(gpu_library_path())}))
"""

VERSION_SCRIPT = """
import json
from workbench.envs import maniskill_private
from workbench.machine.versions import moved_text
from workbench.page.door import viser_private
print(json.dumps({"moved": moved_text(maniskill_private.moved_names()), "viser": viser_private.missing_names()}))
"""


@dataclass(frozen=True)
class DoctorFinding:
    """One line of the report."""

    topic: str
    ok: bool | None
    """True: works. None: the workbench runs with limitations. False: the workbench cannot run."""
    what: str
    advice: str | None = None
    """Advice on what to do; None if all is well."""


class _TookTooLong(Exception):
    """A child process did not answer in time."""


def diagnose() -> list[DoctorFinding]:
    """Run all checks. Never raises: a check that fails becomes a finding with its error.

    A broken driver crashes or hangs its process, so SAPIEN's renderer and torch's CUDA are probed in child
    processes with a timeout. PhysX's GPU library is only looked up on the disk, since SAPIEN would download a
    missing one.
    """
    questions: list[tuple[str, Callable[[], list[DoctorFinding]]]] = [
        ("Python", _python),
        ("packages", _packages),
        ("ManiSkill", _maniskill),
        ("render device", _render_device),
        ("CUDA", _gpu),
        ("cores, memory", _cores_and_memory),
        ("reading", _reading),
        ("page", _page_address),
        ("browser (tests)", _chromium),
    ]
    with ThreadPoolExecutor(len(questions)) as pool:
        answers = [(topic, pool.submit(question)) for topic, question in questions]
    findings: list[DoctorFinding] = []
    for topic, answer in answers:
        failure = answer.exception()
        if failure is None:
            findings += answer.result()
        elif isinstance(failure, _TookTooLong):
            advice = "The machine is busy, or a driver hangs: run workbench doctor again."
            findings.append(DoctorFinding(topic, None, f"not known: {failure}", advice))
        else:
            advice = "This check should not fail: please report it."
            findings.append(
                DoctorFinding(topic, None, f"not known: {type(failure).__name__}: {failure}", advice)
            )
    return findings


def exit_code(findings: Sequence[DoctorFinding]) -> int:
    """Exit code of the command: 0 if the workbench can run here, perhaps with limitations; 1 if not."""
    return int(any(finding.ok is False for finding in findings))


def print_report(findings: Sequence[DoctorFinding], console: Console | None = None) -> None:
    """Print the findings as a table, with advice."""
    console = console or Console(highlight=False)
    marks = {True: "[green]ok[/]", None: "[yellow]less[/]", False: "[red]no[/]"}
    table = Table(box=None, show_header=False, pad_edge=False, padding=(0, 2, 0, 0))
    table.add_column(no_wrap=True)
    table.add_column(no_wrap=True)
    table.add_column(overflow="fold")
    for finding in findings:
        text = escape(finding.what) + (f"\n[bold]{escape(finding.advice)}[/]" if finding.advice else "")
        table.add_row(marks[finding.ok], finding.topic, text)
    console.print(table)
    failed = {finding.topic for finding in findings if finding.ok is False}
    if failed == {"ManiSkill"} and lacks_maniskill():
        console.print("No task can be opened here yet; review, view, share and export work.", style="red")
    elif failed:
        console.print("The workbench cannot run here yet.", style="red")
    elif any(finding.ok is None for finding in findings):
        console.print("The workbench runs here, with the limitations listed above.")
    else:
        console.print("The workbench runs here.", style="green")


def _python() -> list[DoctorFinding]:
    what = f"{platform.python_version()} on {platform.system()} {platform.machine()}, {sys.executable}"
    if not (3, 11) <= sys.version_info[:2] <= (3, 12):
        return [
            DoctorFinding(
                "Python", False, what, "Use Python 3.11 or 3.12: make PYTHON=/path/to/python3.12 open"
            )
        ]
    if platform.system() != "Linux":
        return [DoctorFinding("Python", None, what, "Only Linux is tested.")]
    return [DoctorFinding("Python", True, what)]


def _packages() -> list[DoctorFinding]:
    """Compare installed versions with the distribution's requirements."""
    if versions.installed(DISTRIBUTION) is None:
        return [DoctorFinding("packages", False, f"{DISTRIBUTION} is not installed", "Type: make open")]
    shown = [name for name in (*versions.TESTED, "torch", "numpy") if versions.installed(name) is not None]
    what = ", ".join(f"{name} {versions.installed(name)}" for name in (DISTRIBUTION, *shown))
    if (unmet := versions.unmet_lines()) is not None:
        wrong, advice = unmet
        return [DoctorFinding("packages", False, f"{what}. {wrong}", f"{advice}\nIn a clone: make open")]
    return [DoctorFinding("packages", True, what)]


def _maniskill() -> list[DoctorFinding]:
    """Check which ManiSkill is installed: the release, a nightly build, or both (they overwrite each other's
    files). Check that ManiSkill and the related packages have the private names that the workbench uses."""
    topic = "ManiSkill"
    if (lacking := lines_if_lacking("A task")) is not None:
        return [DoctorFinding(topic, False, *lacking)]
    if (mixed := lines_if_mixed()) is not None:
        return [DoctorFinding(topic, None, mixed[0], "\n".join(mixed[1:]))]
    answer = _ask_child(VERSION_SCRIPT)
    if isinstance(answer, str):
        return [
            DoctorFinding(
                topic, False, f"ManiSkill or rerun does not load: {answer}", versions.untested_text()
            )
        ]
    moved = " ".join(
        [answer["moved"]] * bool(answer["moved"])
        + [f"viser lacks {', '.join(answer['viser'])}: no page can be served."] * bool(answer["viser"])
    )
    if moved:
        return [DoctorFinding(topic, False if answer["viser"] else None, moved, versions.untested_text())]
    if untested := versions.untested():
        names = ", ".join(f"{name} {version}" for name, version in untested.items())
        what = f"not tested: {names}; all private names that the workbench uses are there"
        advice = f"If something fails: {versions.command_for_tested_versions()}"
        return [DoctorFinding("versions", None, what, advice)]
    found = versions.maniskill()
    if found is None:
        return [DoctorFinding(topic, True, "on Python's path, but not installed as a distribution")]
    what = f"{found[1]}, its release: tested with the workbench"
    if found[0] == "mani_skill-nightly":
        what = (
            f"{found[1]}, a nightly build: tested with the workbench. For another build, every private name that the "
            "workbench uses is looked up at start, and missing ones are reported."
        )
    return [DoctorFinding(topic, True, what)]


def _render_device() -> list[DoctorFinding]:
    probe = ensure_render_device(install=False)
    topic = "render device"
    if not probe.ok:
        files = ", ".join(path.name for path in driver_files()) or "none"
        what = f"SAPIEN cannot render (Vulkan drivers on this machine: {files})"
        return [DoctorFinding(topic, False if probe.missing_libraries else None, what, probe.error)]
    what = f"{probe.name}, driver {probe.driver or 'unknown'}"
    if probe.env:
        what += f", from {probe.env.get('VK_DRIVER_FILES')}"
    if "llvmpipe" in (probe.name or ""):
        what += "; in software: a camera picture of 128 x 128 takes some 50 ms"
    if probe.why_no_ray_tracing is not None:
        what += "; no ray tracing: cameras with shader_pack rt are drawn with default"
    return [DoctorFinding(topic, True, what)]


def _gpu() -> list[DoctorFinding]:
    """Check CUDA with torch, then PhysX's GPU library, without letting SAPIEN download it."""
    answer = _ask_child(GPU_SCRIPT)
    if isinstance(answer, str):
        return [
            DoctorFinding("CUDA", False, f"torch or SAPIEN does not load: {answer}", "See the lines above.")
        ]
    cuda: list[str] = answer["cuda"]
    if cuda:
        found = f"{', '.join(cuda)} (torch for CUDA {answer['built']})"
        what = "envs run on the CPU, unless you pass --backend gpu"
        advice = f"For --backend gpu: {answer['why_not']}"
        if answer["why_not"] is None:
            what += f" (PhysX GPU library {answer['library']})"
            advice = (
                "GPU simulation has passed its tests on no machine so far, so --backend auto does not use it. In a clone, "
                "make test-gpu runs them on this one."
            )
        return [DoctorFinding("CUDA", True, found), DoctorFinding("GPU physics", None, what, advice)]
    nvidia = Path("/proc/driver/nvidia/version").is_file()
    if nvidia and answer["built"] is None:
        advice = "There is an NVIDIA driver: install torch's CUDA build of the same version to use it."
    elif nvidia:
        advice = (
            f"torch (for CUDA {answer['built']}) sees no device: look at nvidia-smi and CUDA_VISIBLE_DEVICES."
        )
    else:
        advice = None
    found = (
        f"no device (torch {'without CUDA' if answer['built'] is None else 'for CUDA ' + answer['built']})"
    )
    return [
        DoctorFinding("CUDA", None if advice else True, found, advice),
        DoctorFinding(
            "GPU physics", True, f"not on this machine, since {answer['why_not']}: the CPU core runs the envs"
        ),
    ]


def _ask_child(code: str) -> Any:
    """Run `code` in a child process. Returns the last line of stdout, decoded from JSON; if the process
    fails, the last line of stderr as text.

    Raises:
        _TookTooLong: the process takes longer than `CHILD_TIMEOUT_SECONDS`.
    """
    try:
        child = subprocess.run(
            python_command("-c", code),
            env=child_environment(),
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=CHILD_TIMEOUT_SECONDS,
        )
    except subprocess.TimeoutExpired:
        # The text of TimeoutExpired would contain the whole script.
        raise _TookTooLong(f"it took more than {CHILD_TIMEOUT_SECONDS} s") from None
    if child.returncode != 0:
        return (child.stderr.strip().splitlines() or [f"ended with {child.returncode}"])[-1]
    return json.loads(child.stdout.strip().splitlines()[-1])


def _cores_and_memory() -> list[DoctorFinding]:
    cores = len(os.sched_getaffinity(0))
    memory = psutil.virtual_memory()
    total, free = memory.total / 2**30, memory.available / 2**30
    what = f"{cores} cores, {total:.1f} GiB of memory, {free:.1f} GiB of it available"
    if free < MIN_MEMORY_GIB:
        advice = f"Less than {MIN_MEMORY_GIB:.0f} GiB available: close other programs, or use a smaller --num-envs."
        return [DoctorFinding("cores, memory", None, what, advice)]
    return [DoctorFinding("cores, memory", True, what)]


def _reading() -> list[DoctorFinding]:
    """Check the confinement of the processes that read recordings."""
    version = landlock_version()
    if version:
        what = (
            "recordings are read in processes that can read the recordings' folder and write nothing "
            f"(Landlock {version})"
        )
        return [DoctorFinding("reading", True, what)]
    return [
        DoctorFinding(
            "reading",
            None,
            "recordings are read in separate processes, with limits on memory and time only: this kernel has no Landlock",
            "Linux 5.13 and newer have Landlock, unless it is turned off. Without it, open only recordings "
            "of people you trust.",
        )
    ]


def _page_address() -> list[DoctorFinding]:
    tunnel = f"ssh -L {DEFAULT_PORT}:127.0.0.1:{DEFAULT_PORT} {getpass.getuser()}@{socket.gethostname()}"
    what = (
        f"http://127.0.0.1:{DEFAULT_PORT}/ and a token that `workbench open` prints; from elsewhere: {tunnel}"
    )
    with socket.socket() as trial:
        # Servers set this option too: with it, a port whose closed connections linger counts as free.
        trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            trial.bind(("127.0.0.1", DEFAULT_PORT))
        except OSError as refusal:
            advice = (
                f"Port {DEFAULT_PORT} is taken ({refusal.strerror}): use --port, with 0 for any free one."
            )
            return [DoctorFinding("page", None, what, advice)]
    return [DoctorFinding("page", True, what)]


def _chromium() -> list[DoctorFinding]:
    path = find_chromium()
    if path is None:
        advice = f"Only `make test` needs it. {how_to_get_chromium()}"
        return [DoctorFinding("browser (tests)", None, "no Chromium", advice)]
    return [DoctorFinding("browser (tests)", True, f"{path}: {chromium_version(path)}")]


# --- the machine's own Chromium, which the tests drive ----------------------------------------------


CHROMIUM_VARIABLE = "PLAYWRIGHT_CHROMIUM"
CHROMIUM_NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")


def find_chromium() -> str | None:
    """Path of a working Chromium: the one named by PLAYWRIGHT_CHROMIUM, else the first on PATH."""
    named = os.environ.get(CHROMIUM_VARIABLE)
    candidates = [named] if named else [path for name in CHROMIUM_NAMES if (path := shutil.which(name))]
    return next((path for path in candidates if chromium_version(path) is not None), None)


def chromium_version(path: str) -> str | None:
    """Output of ``PATH --version``; None if it does not run or is not a Chromium.

    A name on PATH proves nothing: Ubuntu's ``chromium-browser`` may be a script that only prints "install the snap".
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
    named = os.environ.get(CHROMIUM_VARIABLE)
    if named:
        return (
            f"{CHROMIUM_VARIABLE}={named} is not a working Chromium: correct the path or unset the variable."
        )
    if has_apt() and os_release().get("ID") == "debian":
        return "Type: sudo apt-get install --no-install-recommends chromium fonts-liberation"
    return (
        "Install Chromium or Google Chrome so that `chromium` or `google-chrome` is on PATH, or name one in "
        f"{CHROMIUM_VARIABLE}. (Ubuntu's chromium package is a snap, which works on a desktop and not in a container.)"
    )


# --- the command -----------------------------------------------------------------------------------


def main() -> int:
    findings = diagnose()
    print_report(findings)
    return exit_code(findings)


if __name__ == "__main__":
    sys.exit(main())
