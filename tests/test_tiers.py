"""``pytest --fast`` deselects tests that need a process, a renderer or a browser, and fails those without the fixture."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
TESTS = """
import os, subprocess, sys, threading
import sapien
import pytest
from tests.drive.waiting import until

def test_plain(): pass

def test_says_so(child_process): subprocess.run(["true"], check=True)
def test_says_nothing(): subprocess.run(["true"], check=True)
def test_forks():
    if os.fork() == 0: os._exit(0)
def test_in_a_thread():
    thread = threading.Thread(target=os.system, args=("true",))
    thread.start()
    thread.join()
def test_waits_for_it():
    threading.Thread(target=os.system, args=("true",)).start()
    until(lambda: False, "what cannot come")
def test_swallowed():
    try: subprocess.run(["true"])
    except BaseException: pass

def test_renders(renderer): sapien.render.RenderSystem(sapien.Device("cpu"))
def test_renders_unsaid(): sapien.render.RenderSystem(sapien.Device("cpu"))

@pytest.fixture(scope="module")
def worker(child_process): subprocess.run(["true"], check=True)
def test_by_a_fixture(worker): pass
def test_in_a_browser(chromium_path): pass
@pytest.mark.slow
def test_that_takes_long(): pass
"""


@pytest.mark.slow
def test_a_test_without_the_fixture_for_what_it_uses_fails_and_names_it(
    child_process: None, tmp_path: Path
) -> None:
    (tmp_path / "conftest.py").write_text('pytest_plugins = ["tests.drive.tiers"]\n')
    (tmp_path / "test_all.py").write_text(TESTS)
    for name, marks in (("one", "pytest.mark.slow"), ("more", "[\n    pytest.mark.browser,\n]")):
        (tmp_path / f"test_{name}.py").write_text(f"import pytest\npytestmark = {marks}\nraise ImportError")
    markers = "browser process render slow".split()
    (tmp_path / "pytest.ini").write_text("[pytest]\nmarkers =\n  " + "\n  ".join(markers))
    output = subprocess.run(
        [sys.executable, "-m", "pytest", "--fast", "-rA", "-p", "no:cacheprovider", str(tmp_path)],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=120,
    ).stdout
    outcomes = {
        name: outcome for outcome, name in re.findall(r"^(PASSED|FAILED) \S+::(\w+)", output, re.MULTILINE)
    }
    without_fixture = "says_nothing forks in_a_thread waits_for_it swallowed renders_unsaid".split()
    assert outcomes == {"test_plain": "PASSED", **{f"test_{name}": "FAILED" for name in without_fixture}}, (
        output
    )
    assert " 5 deselected" in output and "fixture `renderer`" in output, output
    assert output.count("ask for the fixture `child_process`") >= 5, output
    assert "did not come within" not in output, output
