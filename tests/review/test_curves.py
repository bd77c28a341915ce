"""The curves of recordings, and the numbers beside them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import viser

from tests.drive.episodes import made
from workbench.live.panels.reward_panel import NumberRow
from workbench.review.curves_panel import ReviewCurves, compared
from workbench.review.view import Opened, ReviewView, find_events


def test_values_that_only_another_recording_has_are_in_the_table() -> None:
    old = [NumberRow("reward", "0.50", ""), NumberRow("success", "true", "", "good")]
    new = [*old[:1], NumberRow("slope", "0.10", ""), NumberRow("success", "false", "")]
    assert compared(old, [(old, 3), (new, 3)]) == [
        {"name": "reward", "mood": "", "whole": False, "hint": "", "values": ["0.50", "0.50"]},
        {"name": "success", "mood": "good", "whole": False, "hint": "", "values": ["true", "false"]},
        {"name": "slope", "mood": "", "whole": False, "hint": "", "values": ["—", "0.10"]},
    ]


def aligned(*recordings: tuple[int, int], selected: int = 0, position: int = 0) -> ReviewView:
    """A view of recordings, each (number of steps, state at position 0)."""
    episodes = [made(steps) for steps, _ in recordings]
    anchors = tuple(anchor for _, anchor in recordings)
    return ReviewView(
        opened=tuple(Opened(str(i), f"{i}.rrd", e, find_events(e)) for i, e in enumerate(episodes)),
        opened_serial=1,
        selected=selected,
        anchors=anchors,
        position=position,
        first=-max(anchors),
        last=max(steps - anchor for steps, anchor in recordings),
    )


def drawn(server: viser.ViserServer, view: ReviewView, chart: str = "reward") -> list[list[Any]]:
    """Data sent to a chart: the positions, a line per recording, and the dot; None marks gaps."""
    curves = ReviewCurves(server)
    curves.draw(view)
    handle = curves._charts[chart].handle
    assert handle is not None and handle.visible
    return [[None if y is None or np.isnan(y) else float(y) for y in data] for data in handle.data]


@pytest.mark.parametrize("selected", [0, 1])
@pytest.mark.parametrize("position", [-5, -2, 0, 3, 5])
def test_the_dot_lies_on_the_selected_line_at_the_position(
    server: viser.ViserServer, selected: int, position: int
) -> None:
    view = aligned((10, 5), (6, 2), selected=selected, position=position)
    positions, *lines, dot = drawn(server, view)
    assert positions == list(range(-5, 6))
    # The reward equals the number of its step; the first state has none.
    assert lines[0] == [None, *range(1, 11)]
    assert lines[1] == [None] * 4 + [1, 2, 3, 4, 5, 6] + [None]
    at = positions.index(position)
    assert dot == [lines[selected][at] if i == at else None for i in range(11)]


def test_in_a_long_recording_the_dot_is_on_the_point_nearest_to_the_position(
    server: viser.ViserServer,
) -> None:
    steps, anchor = 1000, 400
    for position in (-400, -399, 0, 1, 599, 600):
        positions, line, dot = drawn(server, aligned((steps, anchor), position=position))
        assert (positions[0], positions[-1]) == (-400 + 1, 600) and 400 < len(positions) <= 600
        (at,) = [i for i, value in enumerate(dot) if value is not None] or [0]
        assert abs(positions[at] - position) <= 3
        value = position + anchor  # the value at the position, not at the point
        assert dot[at] == (None if value == 0 else value)
        assert line[at] in (None, positions[at] + anchor)


def test_a_peak_of_one_step_in_a_long_recording_is_drawn(server: viser.ViserServer) -> None:
    episode = made(3000)
    reward = np.zeros(3000, np.float32)
    reward[1234] = 7.0
    episode = replace(episode, reward=reward)
    view = aligned((3000, 0))
    view = replace(view, opened=(Opened("0", "0.rrd", episode, find_events(episode)),))
    positions, line, _ = drawn(server, view)
    assert [at for at, value in zip(positions, line, strict=True) if value == 7.0] == [1235]
