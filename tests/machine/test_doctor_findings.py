"""What `workbench doctor` says on other machines than this one: each check alone, its sources replaced."""

from __future__ import annotations

import io
import json
import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from rich.console import Console

from workbench.machine import doctor, maniskill_installed, versions
from workbench.machine.doctor import (
    DoctorFinding,
    chromium_version,
    diagnose,
    exit_code,
    find_chromium,
    how_to_get_chromium,
    print_report,
)
from workbench.machine.render_probe import RenderProbe

GIB = 2**30


@pytest.fixture
def found(monkeypatch: pytest.MonkeyPatch) -> Callable[..., dict[str, DoctorFinding]]:
    """Runs all checks with a machine on which all is well but for what is given."""

    def found(**other: Any) -> dict[str, DoctorFinding]:
        machine: dict[str, Any] = {
            "gpu": {"built": None, "cuda": [], "why_not": "there is none", "library": "None"},
            "names": {"moved": "", "viser": []},
            "probe": RenderProbe(ok=True, name="a card", driver="driver 1.0"),
            "memory": (16, 12),
            "cores": 4,
            "landlock": 3,
            "python": (3, 11, 2),
            "system": "Linux",
            "chromium": "/bin/chromium",
            "mixed": None,
            "untested": {},
            "maniskill": ("mani_skill", "3.0.1"),
            **other,
        }

        def child(command: list[str], **_: Any) -> Any:
            answer = machine["gpu"] if "torch" in command[-1] else machine["names"]
            if isinstance(answer, str):
                return SimpleNamespace(returncode=1, stdout="", stderr=f"Traceback\n{answer}\n")
            return SimpleNamespace(returncode=0, stdout=f"noise\n{json.dumps(answer)}\n", stderr="")

        total, free = machine["memory"]
        fake = SimpleNamespace(
            run=child, DEVNULL=subprocess.DEVNULL, TimeoutExpired=subprocess.TimeoutExpired
        )
        memory = SimpleNamespace(
            virtual_memory=lambda: SimpleNamespace(total=total * GIB, available=free * GIB)
        )
        patches = {
            "subprocess": fake,
            "psutil": memory,
            "ensure_render_device": lambda install: machine["probe"],
            "landlock_version": lambda: machine["landlock"],
            "find_chromium": lambda: machine["chromium"],
            "chromium_version": lambda path: "Chromium 1.2.3.4",
            "lines_if_mixed": lambda: machine["mixed"],
            "lines_if_lacking": lambda what: machine.get("lacking"),
            "driver_files": lambda: [Path("/x/nvidia_icd.json")],
        }
        with monkeypatch.context() as patch:
            for name, value in patches.items():
                patch.setattr(doctor, name, value)
            patch.setattr(doctor.sys, "version_info", machine["python"])
            patch.setattr(doctor.platform, "system", lambda: machine["system"])
            patch.setattr(os, "sched_getaffinity", lambda pid: set(range(machine["cores"])))
            patch.setattr(doctor.versions, "untested", lambda: machine["untested"])
            patch.setattr(doctor.versions, "maniskill", lambda: machine["maniskill"])
            return {finding.topic: finding for finding in diagnose()}

    return found


CARD = {"built": "12.8", "cuda": ["A card"], "why_not": None, "library": "/lib/PhysXGpu.so"}


@pytest.mark.parametrize(
    ("machine", "topic", "ok", "said"),
    [
        ({}, "cores, memory", True, ["4 cores", "16.0 GiB", "12.0 GiB"]),
        ({"memory": (16, 5.9)}, "cores, memory", None, ["5.9 GiB", "--num-envs"]),
        ({"memory": (16, 6)}, "cores, memory", True, ["6.0 GiB"]),
        ({"landlock": 0}, "reading", None, ["Landlock"]),
        ({}, "reading", True, ["Landlock 3"]),
        ({}, "packages", True, ["viser ", "torch ", "numpy "]),
        ({"python": (3, 10, 9)}, "Python", False, ["3.12"]),
        ({"python": (3, 13, 0)}, "Python", False, ["3.12"]),
        ({"python": (3, 12, 1)}, "Python", True, []),
        ({"system": "Darwin"}, "Python", None, ["Linux"]),
        ({"chromium": None}, "browser (tests)", None, ["hromium"]),
        ({}, "browser (tests)", True, ["/bin/chromium", "1.2.3.4"]),
        ({}, "render device", True, ["a card", "driver 1.0"]),
        (
            {"probe": RenderProbe(True, "llvmpipe (x)", None, env={"VK_DRIVER_FILES": "/mine.json"},
                                  why_no_ray_tracing="it has none")},
            "render device", True, ["/mine.json", "software", "ray tracing", "unknown"],
        ),
        ({"probe": RenderProbe(False, error="Type: this")}, "render device", None, ["nvidia_icd.json", "Type: this"]),
        ({"probe": RenderProbe(False, error="x", missing_libraries=("libX11.so.6",))}, "render device", False, ["x"]),
        ({}, "CUDA", True, ["without CUDA"]),
        ({}, "GPU physics", True, ["there is none"]),
        ({"gpu": CARD}, "CUDA", True, ["A card", "12.8"]),
        ({"gpu": CARD}, "GPU physics", None, ["/lib/PhysXGpu.so", "--backend gpu"]),
        ({"gpu": {**CARD, "why_not": "it is old"}}, "GPU physics", None, ["it is old"]),
        ({"gpu": "ImportError: libcudart"}, "CUDA", False, ["ImportError: libcudart"]),
        ({}, "ManiSkill", True, ["3.0.1"]),
        ({"maniskill": ("mani_skill-nightly", "2026.1")}, "ManiSkill", True, ["2026.1", "nightly"]),
        ({"maniskill": None}, "ManiSkill", True, ["path"]),
        ({"names": "ImportError: sapien"}, "ManiSkill", False, ["ImportError: sapien"]),
        ({"names": {"moved": "placing cameras", "viser": []}}, "ManiSkill", None, ["placing cameras"]),
        ({"names": {"moved": "", "viser": ["_gui"]}}, "ManiSkill", False, ["_gui"]),
        ({"untested": {"sapien": "9.9"}}, "versions", None, ["sapien 9.9", "pip install"]),
        ({"mixed": ("both", "keep one", "keep the other")}, "ManiSkill", None, ["both", "keep one\nkeep the other"]),
        ({"lacking": ("it is missing", "Type: pip")}, "ManiSkill", False, ["it is missing", "Type: pip"]),
    ],
)  # fmt: skip
def test_each_machine_gets_its_own_findings(
    found: Callable[..., dict[str, DoctorFinding]], machine: dict[str, Any], topic: str, ok: bool | None,
    said: list[str],
) -> None:  # fmt: skip
    findings = found(**machine)
    finding = findings[topic]
    assert finding.ok is ok and all(one in f"{finding.what} {finding.advice}" for one in said), finding
    assert finding.advice is not None or ok is True
    if machine and ok is not True:
        others = {
            name: one.ok
            for name, one in findings.items()
            if name not in (topic, "page", "CUDA", "GPU physics")
        }
        assert set(others.values()) <= {True}, others


def test_the_report_ends_with_what_can_be_done(monkeypatch: pytest.MonkeyPatch) -> None:
    def last(*findings: DoctorFinding) -> str:
        out = io.StringIO()
        print_report(findings, Console(file=out, width=100))
        return out.getvalue().splitlines()[-1]

    good, less, bad = (DoctorFinding("page", ok, "x") for ok in (True, None, False))
    no_maniskill = DoctorFinding("ManiSkill", False, "x")
    monkeypatch.setattr(doctor, "lacks_maniskill", lambda: True)
    ends = [last(good), last(good, less), last(less, bad), last(less, no_maniskill)]
    assert len(set(ends)) == 4 and last(bad, no_maniskill) == ends[2] and last(bad) == ends[2]
    monkeypatch.setattr(doctor, "lacks_maniskill", lambda: False)
    assert last(no_maniskill) == ends[2], "it is there, but does not load"


def test_a_browser_is_one_that_says_its_version(
    child_process: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, script in (
        ("chromium", "echo install the snap"),
        ("chromium-browser", "echo Chromium 1.2.3; exit 0"),
        ("google-chrome", "echo Chrome 1.2.3.4; exit 1"),
        ("google-chrome-stable", "echo Chrome 1.2.3.4 built on Debian"),
    ):
        (tmp_path / name).write_text(f"#!/bin/sh\n{script}\n")
        (tmp_path / name).chmod(0o755)
    monkeypatch.delenv("PLAYWRIGHT_CHROMIUM", raising=False)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert find_chromium() == str(tmp_path / "google-chrome-stable")
    assert chromium_version(str(tmp_path / "gone")) is None
    monkeypatch.setenv("PLAYWRIGHT_CHROMIUM", str(tmp_path / "chromium"))
    assert find_chromium() is None, "the named one counts, or none"
    assert str(tmp_path / "chromium") in how_to_get_chromium()


def test_the_command_to_install_names_where_the_workbench_came_from(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    texts = {"direct_url.json": '{"url": "file:///my lab/wheel.whl"}'}
    metadata = SimpleNamespace(read_text=texts.get)
    monkeypatch.setattr(maniskill_installed.importlib.metadata, "distribution", lambda name: metadata)
    monkeypatch.setattr(
        maniskill_installed.importlib.metadata, "requires", lambda name: ["Mani.Skill>=3,<4 ; extra == 'x'"]
    )
    command = maniskill_installed.command_to_install("mani_skill")
    assert command.endswith(" install 'mani_skill<4,>=3'"), command
    (tmp_path / "pyvenv.cfg").write_text("uv = 0.13.9\n")
    (tmp_path / "uv-receipt.toml").touch()
    monkeypatch.setattr(sys, "prefix", str(tmp_path))
    assert (
        "'maniskill-workbench[maniskill] @ file:///my lab/wheel.whl'"
        in maniskill_installed.command_to_install("mani_skill")
    )
    texts.clear()
    assert maniskill_installed.command_to_install("mani_skill-nightly").endswith(
        "'maniskill-workbench[nightly]'"
    )


# --- this machine ---------------------------------------------------------------------------------------

TOPICS = {
    *("Python", "packages", "ManiSkill", "render device", "CUDA", "GPU physics", "cores, memory", "page"),
    *("browser (tests)", "reading"),
}


@pytest.mark.slow
def test_every_topic_has_a_finding_with_versions_and_this_machine_passes(child_process: None) -> None:
    findings = {finding.topic: finding for finding in diagnose()}
    assert findings.keys() == TOPICS
    assert exit_code(list(findings.values())) == 0, findings
    assert all(finding.advice for finding in findings.values() if finding.ok is not True)
    for name in ("viser", "torch", "numpy"):
        assert f"{name} {versions.installed(name)}" in findings["packages"].what
    maniskill = versions.maniskill()
    assert maniskill is not None and maniskill[1] in findings["ManiSkill"].what


def test_failed_and_timed_out_checks_are_reported_and_the_others_run(
    child_process: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail() -> None:
        raise OSError("no such thing")

    monkeypatch.setattr(doctor.psutil, "virtual_memory", fail)
    monkeypatch.setattr(doctor, "CHILD_TIMEOUT_SECONDS", 0.1)
    for questions in ("GPU_SCRIPT", "VERSION_SCRIPT"):
        monkeypatch.setattr(doctor, questions, "import time; time.sleep(60)")
    monkeypatch.setattr(
        versions.importlib.metadata, "requires", lambda name: ["viser<1", "no-such-package>=2"]
    )
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        listener.listen()
        monkeypatch.setattr(doctor, "DEFAULT_PORT", listener.getsockname()[1])
        began = time.monotonic()
        findings = {finding.topic: finding for finding in diagnose()}
    assert time.monotonic() - began < 50 and findings.keys() >= {"CUDA", "ManiSkill"}
    for topic, fact in (("CUDA", "0.1 s"), ("ManiSkill", "0.1 s"), ("cores, memory", "no such thing")):
        assert findings[topic].ok is not True and fact in findings[topic].what
    packages, page = findings["packages"], findings["page"]
    assert packages.ok is False and "viser<1" in packages.what and "no-such-package>=2" in packages.what
    assert "pip install" in (packages.advice or "") and "'viser<1' 'no-such-package>=2'" in (
        packages.advice or ""
    )
    assert page.ok is None and "--port" in (page.advice or "")
    assert findings["Python"].ok and exit_code(list(findings.values())) == 1


def test_the_report_shows_advice_and_prints_brackets_literally() -> None:
    printed = io.StringIO()
    lack = DoctorFinding("render device", False, "found [none]", "Type: apt install [this]")
    print_report([DoctorFinding("Python", True, "3.11"), lack], Console(file=printed, width=60))
    assert "found [none]" in printed.getvalue() and "Type: apt install [this]" in printed.getvalue()
    assert exit_code([lack]) == 1
