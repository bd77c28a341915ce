"""What the batch lived through since its scene was built, in the shapes in which it is looked at.

The same events are the moments of the timeline, the rows of the table of envs, the curves of the reward and those of its
terms. They are told all four here, and begin anew together.
"""

from __future__ import annotations

from workbench.core.step import StepResult
from workbench.session.env_table import EnvTable
from workbench.session.messages import Stepped, TaskDescription
from workbench.session.recent_curves import RecentCurves
from workbench.session.reward_terms import TermHistory
from workbench.session.timeline import Timeline
from workbench.session.view import Curves


class Chronicle:
    """See the module's text. Not thread-safe: the session locks."""

    def __init__(self, task: TaskDescription, first: StepResult, limit: int, first_serial: int) -> None:
        """
        Args:
            first: the state that the task was loaded with.
            limit: bytes that the moments may take.
            first_serial: the number of the first moment.
        """
        self.timeline = Timeline(task.num_envs, limit, first_serial)
        self.table = EnvTable(task, first)
        self.terms = TermHistory(task.num_envs)
        self._recent = RecentCurves(task.num_envs)
        self._curves: Curves | None = None

    def add(self, event: Stepped) -> StepResult:
        """Take an event; returns its result as it is kept (see `History.add`)."""
        self._recent.add(event)
        moment = self.timeline.add(event, max(0, self._recent.count - 1))
        self.table.add(event, self.timeline.history)
        self.terms.add(event)
        return moment.step

    def curves(self) -> Curves:
        """Copied once for every control step, however often they are asked for."""
        if self._curves is None or self._curves.serial != self._recent.count:
            self._curves = self._recent.curves()
        return self._curves
