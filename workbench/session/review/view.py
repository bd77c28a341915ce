"""What the review page reads: one immutable snapshot of the opened recordings and of where one looks.

Recordings are looked at one beside the other, and they differ in length and in when things happen in them. So there
is one *position* for all, counted from the moment at which they are aligned (their starts, or the first success of
each ...): position 0 is that moment in every one of them, and each shows its own state there. Before its start an
episode shows its first state, after its end its last.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from workbench.recording.episode.episode import Episode
from workbench.session.review.events import Happening

START = "start"
"""The alignment that every recording has."""


@dataclass(frozen=True, eq=False)
class Opened:
    """One recording that is open. Two are equal only if they are the same one, opened once."""

    id: str
    """Of the library's row."""
    name: str
    """As people call it: its file."""
    episode: Episode
    happenings: tuple[Happening, ...]
    scene: str = ""
    """What there is to say of its 3-D scene while it has none: that it is being made, or why it cannot be."""
    making: bool = False
    """Its scene is being made in the background."""

    @property
    def length(self) -> int:
        """Control steps; there is one state more."""
        return len(self.episode.reward)

    @property
    def has_scene(self) -> bool:
        return self.episode.geometry is not None and self.episode.poses is not None

    def first(self, name: str) -> int | None:
        """The first state at which something began; None if it never did."""
        return next((h.state for h in self.happenings if h.name == name), None)


@dataclass(frozen=True)
class ReviewView:
    serial: int = 0
    """Grows with every change of anything here."""
    opened: tuple[Opened, ...] = ()
    opened_serial: int = 0
    """Grows when other recordings are open, or one of them has got its scene."""
    selected: int = 0
    """Whose cameras and numbers are shown: index into `opened`."""
    align: str = START
    alignments: tuple[str, ...] = (START,)
    """At what the opened ones can be aligned."""
    anchors: tuple[int, ...] = ()
    """The state of each that lies at position 0."""
    position: int = 0
    first: int = 0
    last: int = 0
    """Ends of what `position` can be."""
    playing: bool = False
    speed: float = 1.0
    loop: bool = False
    loading: str = ""
    """What is being opened."""
    problems: tuple[str, ...] = ()
    """What could not be opened, and what has become of files since, a sentence each."""

    @property
    def states(self) -> tuple[int, ...]:
        """The state of each that is shown at the position."""
        return tuple(
            state_at(self.position, a, o.length) for o, a in zip(self.opened, self.anchors, strict=True)
        )

    @property
    def chosen(self) -> Opened | None:
        return self.opened[self.selected] if self.opened else None


def state_at(position: int, anchor: int, length: int) -> int:
    """Of an episode of `length` steps: the state at that position, its first or last one beyond its ends."""
    return min(max(position + anchor, 0), length)


def column_at(
    states: NDArray[np.integer], values: NDArray[np.float64], anchor: int, axis: NDArray[np.int64]
) -> NDArray[np.float64]:
    """One episode's numbers over the positions of `axis`; NaN where it has none."""
    line = np.full(len(axis), np.nan)
    if len(axis):
        places = states.astype(np.int64) - anchor - int(axis[0])
        inside = (places >= 0) & (places < len(axis))
        line[places[inside]] = values[inside]
    return line
