from __future__ import annotations

import stat
from pathlib import Path

import pytest

from workbench.machine.doctor import chromium_version, find_chromium, how_to_get_chromium


def test_this_machines_chromium_has_a_version(chromium_path: str) -> None:
    version = chromium_version(chromium_path)
    assert version and any(character.isdigit() for character in version)


@pytest.mark.parametrize(
    "says",
    [
        "echo 'requires the chromium snap to be installed.' >&2; exit 10",
        "echo 'Chromium comes as a snap'",
        "echo 'Chromium 120.0.6099.129'; exit 1",
    ],
)
def test_ubuntus_snap_stub_is_not_taken_for_a_browser(
    says: str, child_process: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stub = tmp_path / "chromium-browser"
    stub.write_text(f"#!/bin/sh\n{says}\n")
    stub.chmod(stub.stat().st_mode | stat.S_IXUSR)
    monkeypatch.delenv("PLAYWRIGHT_CHROMIUM", raising=False)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert find_chromium() is None


def test_a_given_browser_that_does_not_run_is_not_replaced(
    child_process: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PLAYWRIGHT_CHROMIUM", "/nonexistent/chromium")
    assert find_chromium() is None
    assert "/nonexistent/chromium" in how_to_get_chromium()
