"""The state of planning alone: events and the effects that follow."""

from __future__ import annotations

from typing import Any, cast

import pytest

from tests.drive.session import DEATH
from workbench.live.events import FileSaved, WorkerDied
from workbench.live.messages import PlanDropped
from workbench.solve.state import EndPlan, SolveState, SolveView, Solving, apply


@pytest.mark.parametrize(
    "event", [PlanDropped(), FileSaved(), WorkerDied(DEATH, "")], ids=lambda event: type(event).__name__
)
@pytest.mark.parametrize("state", ["starting", "planning", "none", "failed"])
def test_planning_ends_with_its_request_its_version_and_its_worker(state: SolveState, event: object) -> None:
    solving = Solving(SolveView(state, activity="importing"))
    ended, effects = apply(solving, event, cast(Any, None))
    if state in ("none", "failed"):
        assert (ended, effects) == (solving, [])
    else:
        assert (ended.shared.state, ended.shared.activity, effects) == ("none", "", [EndPlan()])
