"""The way from a recording to the live env, while it takes: what is being done, and when one is there.

Opening a task takes seconds, and making recorded actions again does too. A live page has nothing to show until then,
so the review stays, with the recorded scene in the view, and says what it waits for. The page changes when the env
stands in the recorded state; and before that where only the live page can help, because the task's code failed, or has
been at one thing for so long that one may want to interrupt it.
"""

from __future__ import annotations

from dataclasses import dataclass

from workbench.core.recorded_run import RecordedRun
from workbench.recording.episode import EpisodeInfo
from workbench.session.session import Session
from workbench.session.view import SessionView
from workbench.ui.busy_banner import is_shown as is_busy_for_long


@dataclass(frozen=True)
class GoingLive:
    session: Session
    number: int
    """What `TimelineView.entered` is when it is there."""
    task: str
    state: int
    problems: int

    def is_over(self, view: SessionView) -> bool:
        """Whether the live page has something to show now."""
        arrived = view.timeline.entered == self.number
        failed = view.problem_serial > self.problems or view.state == "stopped"
        return arrived or failed or is_busy_for_long(view)

    def words(self, view: SessionView) -> str:
        """What is waited for."""
        if view.task is None:
            doing = f"loading {self.task} at step {self.state}"
        else:
            doing = f"putting {self.task} into step {self.state}"
        return f"{doing}: {view.activity}" if view.activity else f"{doing} …"


def begin_to_go(
    session: Session, run: RecordedRun, everywhere: bool, info: EpisodeInfo, state: int
) -> GoingLive:
    """Ask the session for a recorded moment."""
    problems = session.view().problem_serial
    number = session.step_back(run, everywhere, info.source_file, info.source)
    return GoingLive(session, number, info.task, state, problems)
