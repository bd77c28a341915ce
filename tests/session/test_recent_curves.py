"""The ring of rewards and successes that the curves are drawn from."""

from __future__ import annotations

import numpy as np
import pytest

from tests.session.moments import N, stepped
from workbench.session.recent_curves import RecentCurves


def test_a_row_is_a_step_and_the_first_of_an_episode_is_marked_however_many_resets_were_before_it() -> None:
    recent = RecentCurves(N)
    recent.add(stepped(1))
    recent.add(stepped(0, jumped=(1,)))
    recent.add(stepped(0, jumped=(2,)))
    recent.add(stepped(2, success=(2,)))
    recent.add(stepped(3))
    curves = recent.curves()
    assert curves.serial == recent.count == 3 and curves.tick.tolist() == [0, 1, 2]
    assert curves.reward.tolist() == [[1.0] * N, [2.0] * N, [3.0] * N]
    assert curves.success.tolist() == [[0, 0, 0], [0, 0, 1], [0, 0, 0]]
    assert curves.started.tolist() == [[True] * N, [False, True, True], [False] * N]


@pytest.mark.parametrize("count", [999, 1000, 1001, 2500])
def test_only_the_newest_are_kept_oldest_first(count: int) -> None:
    recent = RecentCurves(N)
    for number in range(count):
        recent.add(stepped(number))
    curves = recent.curves()
    kept = list(range(max(0, count - 1000), count))
    assert curves.tick.tolist() == kept and curves.reward[:, 1].tolist() == kept
    assert curves.serial == count


def test_curves_that_were_taken_do_not_change_and_a_task_without_success_has_none() -> None:
    recent = RecentCurves(N)
    one = stepped(1)
    one.step.evaluate.pop("success")
    recent.add(one)
    curves = recent.curves()
    before = curves.reward.copy()
    for number in range(2000):
        recent.add(stepped(number))
    assert np.array_equal(curves.reward, before) and np.isnan(curves.success).all()
