"""Each check runs on the batched CPU, where every machine can say that the check itself works, and on the GPU where there is one."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import pytest

from workbench.envs.backends import find_renderer, why_no_gpu_simulation

Simulation = Literal["cpu", "gpu"]


@pytest.fixture(params=["cpu", pytest.param("gpu", marks=pytest.mark.gpu)], scope="session")
def simulation(request: pytest.FixtureRequest) -> Simulation:
    """The backend that is looked at; what it gives is held against the batched CPU."""
    if request.param == "gpu" and (reason := why_no_gpu_simulation()) is not None:
        pytest.skip(f"no GPU simulation: {reason}")
    return request.param


@pytest.fixture(scope="session")
def renderer() -> str:
    """What ManiSkill takes as ``render_backend`` here."""
    found = find_renderer()
    if found is None:
        pytest.skip("no renderer: SAPIEN finds no Vulkan device")
    return found.render_backend


Told = Callable[[str], None]
_TOLD: list[str] = []


@pytest.fixture
def told() -> Told:
    """Takes a line for the end of the run: a rate that is worth knowing and nothing to fail by."""
    return _TOLD.append


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    if _TOLD:
        terminalreporter.section("rates")
        for line in _TOLD:
            terminalreporter.line(line)
