"""Rollout paths in the 3-D view."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
import viser

from tests.drive.panels import Panels
from workbench.solve.rollout_traces import BEST, RolloutTraces, segments

HERE = np.zeros(3, np.float32)


def paths_along_x(count: int = 5, steps: int = 4) -> np.ndarray:
    """Return paths along x, next to each other in y."""
    paths = np.zeros((count, steps + 1, 3), np.float32)
    paths[..., 0] = np.arange(steps + 1)
    paths[..., 1] = np.arange(count)[:, None]
    return paths


@pytest.fixture
def panels(server: viser.ViserServer) -> Iterator[Panels]:
    yield Panels(server)


def test_the_best_path_is_drawn_last_and_bright() -> None:
    points, colours = segments(paths_along_x())
    assert points.shape == colours.shape == (20, 2, 3)
    best = points[-4:]
    assert best[:, :, 1].max() == 0 and sorted(best[:, 0, 0]) == [0, 1, 2, 3]
    assert (colours[-4:] == BEST).all() and not (colours[:-4] == BEST).all(-1).any()


def test_one_node_draws_all_paths_at_the_envs_offset(server: viser.ViserServer, panels: Panels) -> None:
    traces, offset = RolloutTraces(server), np.array([0, 5, 0], np.float32)
    traces.draw(paths_along_x(), offset)
    (node,) = panels.nodes("/rollouts")
    assert node.points[..., 1].min() == 5 and node.points.nbytes + node.colors.nbytes < 1000
    traces.draw(paths_along_x(count=3), HERE)
    (node,) = panels.nodes("/rollouts")
    assert len(node.points) == 12
    traces.draw(None, HERE)
    assert panels.nodes("/rollouts") == []
    traces.draw(np.zeros((0, 0, 3), np.float32), HERE)
    assert panels.nodes("/rollouts") == []
