"""`workbench doctor` reports what this machine can do, even if a check fails or times out."""

from __future__ import annotations

import io
import socket
import time

import pytest
from rich.console import Console

from workbench.machine import doctor, versions
from workbench.machine.doctor import DoctorFinding, diagnose, exit_code, print_report

pytestmark = pytest.mark.usefixtures("child_process")
TOPICS = {
    *("Python", "packages", "ManiSkill", "render device", "CUDA", "GPU physics", "cores, memory", "page"),
    *("browser (tests)", "reading"),
}


def found() -> dict[str, DoctorFinding]:
    return {finding.topic: finding for finding in diagnose()}


@pytest.mark.slow
def test_every_topic_has_a_finding_with_versions_and_this_machine_passes() -> None:
    findings = found()
    assert findings.keys() == TOPICS
    assert exit_code(list(findings.values())) == 0, findings
    assert all(finding.advice for finding in findings.values() if finding.ok is not True)
    for name in ("viser", "torch", "numpy"):
        assert f"{name} {versions.installed(name)}" in findings["packages"].what
    maniskill = versions.maniskill()
    assert maniskill is not None and maniskill[1] in findings["ManiSkill"].what


def test_failed_and_timed_out_checks_are_reported_and_the_others_run(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def fail() -> list[DoctorFinding]:
        raise OSError("no such thing")

    monkeypatch.setattr(doctor, "_cores_and_memory", fail)
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
        findings = found()
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


def test_a_working_gpu_is_used_only_on_request(monkeypatch: pytest.MonkeyPatch) -> None:
    answer = '{"built": "12.8", "cuda": ["A card"], "why_not": null, "library": "/lib/PhysXGpu.so"}'
    monkeypatch.setattr(doctor, "GPU_SCRIPT", f"print('{answer}')")
    monkeypatch.setattr(doctor, "VERSION_SCRIPT", "print('{}')")
    findings = found()
    assert findings["CUDA"].ok and "A card" in findings["CUDA"].what
    assert "--backend gpu" in findings["GPU physics"].what


def test_the_report_shows_advice_and_prints_brackets_literally() -> None:
    printed = io.StringIO()
    lack = DoctorFinding("render device", False, "found [none]", "Type: apt install [this]")
    print_report([DoctorFinding("Python", True, "3.11"), lack], Console(file=printed, width=60))
    assert "found [none]" in printed.getvalue() and "Type: apt install [this]" in printed.getvalue()
    assert exit_code([lack]) == 1
