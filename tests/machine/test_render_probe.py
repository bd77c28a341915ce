from __future__ import annotations

import json
import os
import stat
from pathlib import Path

import pytest

from workbench.machine.render_probe import probe_render_device
from workbench.machine.software_vulkan import ensure_render_device

pytestmark = pytest.mark.usefixtures("child_process")


def test_this_machine_renders_and_the_driver_is_named() -> None:
    probe = probe_render_device()
    assert probe.ok, probe.error
    assert probe.name
    assert probe.device in ("cuda", "cpu")
    assert probe.driver and any(character.isdigit() for character in probe.driver)


def test_a_driver_file_that_leads_nowhere_is_no_render_device(tmp_path: Path) -> None:
    manifest = tmp_path / "broken_icd.json"
    icd = {"library_path": str(tmp_path / "libnothing.so"), "api_version": "1.3.0"}
    manifest.write_text(json.dumps({"file_format_version": "1.0.0", "ICD": icd}))
    probe = probe_render_device({"VK_DRIVER_FILES": str(manifest)})
    assert not probe.ok
    assert probe.error and str(manifest) in probe.error


def test_a_driver_that_kills_the_process_is_an_answer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _let_python_be(tmp_path, monkeypatch, "kill -SEGV $$")
    probe = probe_render_device()
    assert not probe.ok
    assert probe.error == "SAPIEN was killed by SIGSEGV"


def test_a_driver_that_hangs_is_an_answer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _let_python_be(tmp_path, monkeypatch, "exec sleep 60")
    probe = probe_render_device(timeout_s=0.5)
    assert not probe.ok
    assert probe.error and "no answer" in probe.error


def test_a_driver_that_the_person_chose_is_not_replaced(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("VK_DRIVER_FILES", "/nonexistent.json")
    monkeypatch.setenv("PATH", str(tmp_path))  # apt-get would not be found, and its absence not forgiven
    probe = ensure_render_device(install=True)
    assert not probe.ok
    assert probe.error and "unset it" in probe.error


def test_where_something_renders_nothing_is_installed(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    called = tmp_path / "called"
    apt = tmp_path / "apt-get"
    apt.write_text(f"#!/bin/sh\ntouch {called}\n")
    apt.chmod(apt.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    assert ensure_render_device(install=True).ok
    assert not called.exists()


def _let_python_be(folder: Path, monkeypatch: pytest.MonkeyPatch, script: str) -> None:
    """Stand in for an interpreter whose native code misbehaves: no driver at hand crashes on demand."""
    python = folder / "python"
    python.write_text(f"#!/bin/sh\n{script}\n")
    python.chmod(python.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setattr("sys.executable", str(python))
