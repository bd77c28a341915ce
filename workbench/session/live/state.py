"""All that a session knows, as one value, and how each event changes it."""

from __future__ import annotations

from dataclasses import dataclass

from workbench.session.run import apply as of_run
from workbench.session.run.events import Now, RunEffect, RunEvent
from workbench.session.run.run import Run

SessionEvent = RunEvent
Effect = RunEffect


@dataclass(frozen=True)
class State:
    """One moment of a session. Parts that an event did not change are the same objects."""

    run: Run


def apply(state: State, event: SessionEvent, now: Now) -> tuple[State, list[Effect]]:
    """The state after an event, and what has to be done.

    Raises:
        Refused: a command makes no sense now; nothing has changed.
    """
    run, effects = of_run.apply(state.run, event, now)
    return (state if run is state.run else State(run)), effects
