"""All that a session knows, as one value, and how each event changes it."""

from __future__ import annotations

from dataclasses import dataclass, replace

from workbench.commands.command import Command
from workbench.session.record import recording as of_recording
from workbench.session.record.recording import RecordEffect, RecordEvent, Recording, RecordingWanted
from workbench.session.record.saving import SaveEvent, SaveWanted
from workbench.session.rescore import rescoring as of_rescoring
from workbench.session.rescore.rescoring import PastRescoring, RescoreEffect, RescoreEvent
from workbench.session.run import apply as of_run
from workbench.session.run import asked
from workbench.session.run.events import Now, RunEffect, RunEvent
from workbench.session.run.run import Run

DOES: frozenset[type[Command]] = asked.DOES | of_recording.DOES | of_rescoring.DOES
"""Commands that `apply` takes."""
SessionEvent = RunEvent | RecordingWanted | RecordEvent | SaveWanted | SaveEvent | RescoreEvent
Effect = RunEffect | RecordEffect | RescoreEffect


@dataclass(frozen=True)
class State:
    """One moment of a session. Parts that an event did not change are the same objects."""

    run: Run
    recording: Recording
    rescoring: PastRescoring = PastRescoring()


def apply(
    state: State, event: SessionEvent, now: Now, solved: tuple[int, ...] = ()
) -> tuple[State, list[Effect]]:
    """The state after an event, and what has to be done.

    Args:
        solved: envs whose episode is solved.

    Raises:
        Refused: a command makes no sense now; nothing has changed.
    """
    run, for_run = of_run.apply(state.run, event, now)
    recording, for_recording = of_recording.apply(state.recording, event, state.run, run, now, solved)
    rescoring, for_rescoring = of_rescoring.apply(state.rescoring, event, state.run, run)
    parts = {"run": run, "recording": recording, "rescoring": rescoring}
    changed = {name: part for name, part in parts.items() if part is not getattr(state, name)}
    # Those of the run come last: after a load a recording continues before a recorded run is entered.
    return replace(state, **changed) if changed else state, [*for_recording, *for_rescoring, *for_run]
