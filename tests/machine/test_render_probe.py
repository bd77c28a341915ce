from __future__ import annotations

import json
import stat
from pathlib import Path

import pytest

from workbench.machine.render_probe import probe_render_device

pytestmark = pytest.mark.usefixtures("child_process")


def test_this_machine_renders_and_its_driver_is_named() -> None:
    probe = probe_render_device()
    assert probe.ok, probe.error
    assert probe.name
    assert probe.device in ("cuda", "cpu")
    assert probe.driver and any(character.isdigit() for character in probe.driver)


def test_a_driver_file_with_a_missing_library_is_no_render_device(tmp_path: Path) -> None:
    manifest = tmp_path / "broken_icd.json"
    icd = {"library_path": str(tmp_path / "libnothing.so"), "api_version": "1.3.0"}
    manifest.write_text(json.dumps({"file_format_version": "1.0.0", "ICD": icd}))
    probe = probe_render_device({"VK_DRIVER_FILES": str(manifest)})
    assert not probe.ok
    assert probe.error and str(manifest) in probe.error


def test_a_driver_that_crashes_the_process_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _replace_python(tmp_path, monkeypatch, "kill -SEGV $$")
    probe = probe_render_device()
    assert not probe.ok
    assert probe.error == "SAPIEN was killed by SIGSEGV"


def test_a_driver_that_hangs_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _replace_python(tmp_path, monkeypatch, "exec sleep 60")
    probe = probe_render_device(timeout_s=0.5)
    assert not probe.ok
    assert probe.error and "no answer" in probe.error


def _replace_python(folder: Path, monkeypatch: pytest.MonkeyPatch, script: str) -> None:
    """Replace the interpreter by a script, to simulate a driver that crashes or hangs."""
    python = folder / "python"
    python.write_text(f"#!/bin/sh\n{script}\n")
    python.chmod(python.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setattr("sys.executable", str(python))
