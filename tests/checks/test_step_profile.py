"""The profile of a control step, by hook and line."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from tests.checks.checked import EXAMPLE
from workbench.checks.evidence.collect import Checkup
from workbench.checks.evidence.time_step import StepProfile, profile_step
from workbench.task.load import load_task, undo_load

pytestmark = pytest.mark.thorough

SLOW = "        height = self.cube.pose.p[:, 2] - CUBE_HALF_SIZE\n"


def profile(file: Path, text: str, steps: int = 20) -> StepProfile:
    file.write_text(text)
    loaded = load_task(str(file))
    checkup = Checkup(loaded, num_envs=2, seeds=2)
    try:
        return profile_step(checkup, num_envs=4, steps=steps)
    finally:
        checkup.close()
        undo_load(loaded)


def test_times_of_hooks_and_lines_add_up_to_the_step(tmp_path: Path) -> None:
    found = profile(tmp_path / "task.py", EXAMPLE.read_text())
    assert (found.num_envs, found.steps) == (4, 20) and found.milliseconds > 0
    names = {hook.name: hook for hook in found.hooks}
    assert {"evaluate", "compute_dense_reward", "_get_obs_extra", "physics", "controller"} <= set(names)
    assert sum(hook.share for hook in found.hooks) == pytest.approx(1)
    assert sum(hook.milliseconds for hook in found.hooks) == pytest.approx(found.milliseconds)
    of_evaluate = [line for line in found.lines if line.hook == "evaluate"]
    assert sum(line.milliseconds for line in of_evaluate) == pytest.approx(names["evaluate"].milliseconds)
    assert names["evaluate"].place is not None and names["physics"].place is None


def test_a_debuggers_trace_function_is_there_again_afterwards(tmp_path: Path) -> None:
    trace, before = (lambda frame, event, arg: None), sys.gettrace()
    sys.settrace(trace)
    try:
        profile(tmp_path / "task.py", EXAMPLE.read_text(), steps=1)
        assert sys.gettrace() is trace
    finally:
        sys.settrace(before)


def test_the_slowest_line_comes_first(tmp_path: Path) -> None:
    text = EXAMPLE.read_text()
    assert SLOW in text
    slow = "        self.wait()\n"
    method = "    def wait(self):\n        import time\n        time.sleep(0.05)\n\n    def evaluate("
    text = text.replace(SLOW, SLOW + slow).replace("    def evaluate(", method)
    found = profile(tmp_path / "task.py", text)
    line, hook = found.lines[0], found.hooks[0]
    assert line.code == "time.sleep(0.05)" and line.hook == hook.name == "evaluate"
    assert 45 < line.milliseconds <= hook.milliseconds <= found.milliseconds and line.share > 0.5
    assert next(each for each in found.lines if each.code == "self.wait()").milliseconds < 5
