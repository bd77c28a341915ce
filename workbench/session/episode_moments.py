"""The moments of an episode to judge a camera at: all that are kept of it, or as many as somebody will wait for.

A camera that sees the cube at the start may lose it behind the hand at step 30. What one env lived through is in the
history, with the poses of its bodies, so it is drawn again from there and nothing is run. A picture takes tens of
milliseconds: of a long episode so many moments are taken, evenly spread, the first and the last among them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from workbench.session.history import History


@dataclass(frozen=True)
class EpisodeMoment:
    """One env at one moment of its episode."""

    serial: int
    """Of the moment in the history."""
    env: int
    """The number that it had then: another than now where it was given another env's moment."""
    step: int
    """Control steps since its reset."""
    poses: NDArray[np.float32]
    """(N, B, 7) of the whole batch then."""


def moments_of_episode(history: History, env: int, serial: int, most: int) -> tuple[EpisodeMoment, ...]:
    """The episode that this env is in at a moment, from its beginning to as far as it went, oldest first.

    Args:
        serial: of the moment.
        most: how many are wanted at most.
    """
    _, end = history.stretch_at(env, serial)
    lived = list(history.lived(env, end))[::-1]
    chosen = np.unique(np.linspace(0, len(lived) - 1, min(most, len(lived))).round().astype(int))
    return tuple(
        EpisodeMoment(moment.serial, of, int(moment.step.elapsed_steps[of]), moment.step.poses)
        for moment, of in (lived[i] for i in chosen)
    )
