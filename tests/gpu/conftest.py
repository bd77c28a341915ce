"""Each check runs on the batched CPU, which validates the check itself on every machine, and on a GPU if present."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import pytest

from workbench.envs.backends import find_renderer, why_no_gpu_simulation

Simulation = Literal["cpu", "gpu"]


@pytest.fixture(params=["cpu", pytest.param("gpu", marks=pytest.mark.gpu)], scope="session")
def simulation(request: pytest.FixtureRequest) -> Simulation:
    """The backend under test; its results are compared with the batched CPU."""
    if request.param == "gpu" and (reason := why_no_gpu_simulation()) is not None:
        pytest.skip(f"no GPU simulation: {reason}")
    return request.param


@pytest.fixture(scope="session")
def renderer() -> str:
    """ManiSkill's ``render_backend`` for this machine."""
    found = find_renderer()
    if found is None:
        pytest.skip("no renderer: SAPIEN finds no Vulkan device")
    return found.render_backend


SummaryLine = Callable[[str], None]
_SUMMARY_LINES: list[str] = []


@pytest.fixture
def summary_line() -> SummaryLine:
    """Return a function that adds a line with a rate to the summary at the end of the run."""
    return _SUMMARY_LINES.append


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    if _SUMMARY_LINES:
        terminalreporter.section("rates")
        for line in _SUMMARY_LINES:
            terminalreporter.line(line)
