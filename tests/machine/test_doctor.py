from __future__ import annotations

import io
import socket
import sys
from pathlib import Path

import pytest
from rich.console import Console

from workbench.machine import doctor, versions
from workbench.machine.doctor import DoctorFinding, diagnose, exit_code, print_report


@pytest.fixture(scope="module")
def findings(child_process: None) -> dict[str, DoctorFinding]:
    return {finding.topic: finding for finding in diagnose()}


@pytest.mark.slow
def test_every_topic_is_answered_and_this_machine_runs_the_workbench(
    findings: dict[str, DoctorFinding],
) -> None:
    topics = {
        "Python",
        "packages",
        "ManiSkill",
        "render device",
        "CUDA",
        "GPU physics",
        "cores, memory",
        "page",
        "browser (tests)",
        "reading",
    }
    assert set(findings) == topics
    assert exit_code(list(findings.values())) == 0, findings
    assert all(finding.advice for finding in findings.values() if finding.ok is not True)


@pytest.mark.slow
def test_versions_are_shown_and_what_they_mean(findings: dict[str, DoctorFinding]) -> None:
    installed = {name: versions.installed(name) for name in (*versions.TESTED, "torch", "numpy")}
    shown = findings["packages"].what
    assert all(f"{name} {version}" in shown for name, version in installed.items() if version is not None)
    assert not [name for name, version in installed.items() if version is None and f"{name} " in shown]
    maniskill = versions.maniskill()
    assert maniskill is not None and maniskill[1] in findings["ManiSkill"].what
    assert ("nightly" in findings["ManiSkill"].what) == (maniskill[0] == "mani_skill-nightly")


@pytest.mark.slow
def test_a_version_that_was_not_tested_is_named_with_the_way_back(
    child_process: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    tested = versions.installed("viser")
    monkeypatch.setitem(versions.TESTED, "viser", ("0.1",))
    (finding,) = doctor._maniskill()
    assert finding.ok is None and f"not tested: viser {tested}" in finding.what
    assert finding.advice and "pip install" in finding.advice and "viser==0.1" in finding.advice


def test_what_a_requirement_excludes_is_named_with_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        versions.importlib.metadata, "requires", lambda name: ["viser<1", "no-such-package>=2"]
    )
    (finding,) = doctor._packages()
    assert finding.ok is False and "viser<1 is wanted" in finding.what
    assert "no-such-package>=2 is missing" in finding.what
    # By uv or by pip, as the environment was made.
    assert finding.advice and "pip install" in finding.advice and sys.executable in finding.advice
    assert "'viser<1' 'no-such-package>=2'" in finding.advice


def test_a_question_that_takes_too_long_is_told_without_its_program(
    child_process: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(doctor, "CHILD_TIMEOUT_S", 0.1)
    monkeypatch.setattr(doctor, "GPU_QUESTIONS", "import time; time.sleep(60)")
    monkeypatch.setattr(doctor, "VERSION_QUESTIONS", "import time; time.sleep(60)")
    found = {finding.topic: finding for finding in doctor.diagnose()}
    for topic in ("CUDA", "ManiSkill"):
        assert found[topic].what == "not known: it took more than 0.1 s", topic
        assert "again" in (found[topic].advice or "")


@pytest.mark.slow
def test_gpu_physics_is_looked_for_without_fetching_it(
    child_process: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    assert doctor._gpu()
    assert not list(tmp_path.rglob("*PhysX*"))


def test_a_gpu_that_works_is_not_taken_unasked(child_process: None, monkeypatch: pytest.MonkeyPatch) -> None:
    answer = '{"built": "12.8", "cuda": ["A card"], "why_not": null, "library": "/lib/PhysXGpu.so"}'
    monkeypatch.setattr(doctor, "GPU_QUESTIONS", f"print('{answer}')")
    cuda, physics = doctor._gpu()
    assert cuda.ok and "A card" in cuda.what
    assert "on the CPU core, unless you say --backend gpu" in physics.what
    assert physics.advice and "--backend auto does not take it" in physics.advice


def test_a_taken_port_is_said_with_the_option_to_change_it(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        monkeypatch.setattr(doctor, "DEFAULT_PORT", taken.getsockname()[1])
        (finding,) = doctor._page_address()
    assert finding.ok is None
    assert finding.advice and "--port" in finding.advice


@pytest.mark.slow
def test_a_question_that_fails_is_told_and_the_others_are_answered(
    child_process: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail() -> list[DoctorFinding]:
        raise OSError("no such thing")

    monkeypatch.setattr(doctor, "_cores_and_memory", fail)
    by_topic = {finding.topic: finding for finding in diagnose()}
    assert by_topic["cores, memory"].what == "not known: OSError: no such thing"
    assert by_topic["Python"].ok


def test_the_report_shows_what_to_do_and_reads_brackets_as_text() -> None:
    said = io.StringIO()
    lack = DoctorFinding("render device", False, "found [none]", "Type: apt install [this]")
    print_report([DoctorFinding("Python", True, "3.11"), lack], Console(file=said, width=60))
    assert "found [none]" in said.getvalue()
    assert "Type: apt install [this]" in said.getvalue()
    assert exit_code([lack]) == 1
