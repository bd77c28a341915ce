"""Rollout paths in the 3-D view."""

from __future__ import annotations

import numpy as np
import viser

from tests.drive.panels import Panels
from workbench.solve.rollout_traces import BEST, CHOSEN, MAX_SEGMENTS, RolloutTraces, segments

HERE = np.zeros(3, np.float32)


def paths_along_x(count: int = 5, steps: int = 4) -> np.ndarray:
    """Return paths along x, next to each other in y."""
    paths = np.zeros((count, steps + 1, 3), np.float32)
    paths[..., 0] = np.arange(steps + 1)
    paths[..., 1] = np.arange(count)[:, None]
    return paths


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


def test_the_chosen_path_is_marked_and_what_is_not_finite_is_left_out(
    server: viser.ViserServer, panels: Panels
) -> None:
    paths = paths_along_x()
    points, colours = segments(paths)
    assert points.shape == colours.shape == (20, 2, 3)
    assert points[-4:, :, 1].max() == 0 and (colours[-4:] == BEST).all(), "the best path is drawn last"
    points, colours = segments(paths, 3)
    tones = {int(y): tuple(colours[points[:, 0, 1] == y][0, 0]) for y in range(5)}
    assert tones[0] == BEST and tones[3] == CHOSEN and len(set(tones.values())) == 5
    assert {int(y) for y in points[-8:, 0, 1]} == {0, 3}, "drawn last, over the others"
    paths[1, 2] = np.nan
    points, _ = segments(paths, 9)
    assert len(points) == 18 and np.isfinite(points).all()
    traces, long = RolloutTraces(server), paths_along_x(2, 60)
    for offset, chosen in ((0, 0), (4, 0), (4, 1)):
        traces.draw(long, np.array([0, offset, 0], np.float32), chosen)
        (node,) = panels.nodes("/rollouts")
        assert node.points[..., 1].min() == offset and node.points[..., 0].max() == 60
        assert (np.asarray(node.colors) == CHOSEN).all(-1).any() == bool(chosen)
        assert len(node.points) == 2 * MAX_SEGMENTS
