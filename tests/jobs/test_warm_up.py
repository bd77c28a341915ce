"""What a spare worker does before it is needed."""

from __future__ import annotations

import pytest

from workbench.jobs.open_task import warm_up
from workbench.jobs.task import TaskOptions


@pytest.mark.usefixtures("renderer")
@pytest.mark.parametrize(("kwargs", "pictures"), [({}, 1), ({"render_backend": "none"}, 0)])
def test_it_draws_where_the_task_does(kwargs: dict[str, object], pictures: int) -> None:
    asked: list[bool] = []

    def keep_going() -> bool:
        """Asked before each picture; one question is enough to know."""
        asked.append(True)
        return False

    warm_up(TaskOptions(1, "cpu", 0, {"obs_mode": "rgb", "of_the_task": 3} | kwargs), keep_going)
    assert len(asked) == pictures
