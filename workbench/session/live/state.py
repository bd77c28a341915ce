"""All that a session knows, as one value, and how each event changes it."""

from __future__ import annotations

from dataclasses import dataclass

from workbench.session.cameras import studio as of_studio
from workbench.session.cameras.events import StudioEffect, StudioEvent
from workbench.session.cameras.state import Studio
from workbench.session.run import apply as of_run
from workbench.session.run import asked
from workbench.session.run.events import Now, RunEffect, RunEvent
from workbench.session.run.run import Run

SessionEvent = RunEvent | StudioEvent
Effect = RunEffect | StudioEffect
DOES = asked.DOES | of_studio.DOES
"""Commands that `apply` takes."""


@dataclass(frozen=True)
class State:
    """One moment of a session. Parts that an event did not change are the same objects."""

    run: Run
    studio: Studio


def apply(state: State, event: SessionEvent, now: Now) -> tuple[State, list[Effect]]:
    """The state after an event, and what has to be done.

    Raises:
        Refused: a command makes no sense now; nothing has changed.
    """
    run, effects = of_run.apply(state.run, event, now)
    studio, of_cameras = of_studio.apply(state.studio, event, run, now)
    changed = run is not state.run or studio is not state.studio
    return State(run, studio) if changed else state, [*effects, *of_cameras]
