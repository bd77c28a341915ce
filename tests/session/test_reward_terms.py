from __future__ import annotations

from typing import Any

import numpy as np

from tests.ui.scenes import step_of, table_scene
from workbench.core.step import OtherEntry
from workbench.session.messages import Stepped
from workbench.session.reward_terms import MOST, TermHistory

STEP, RESET = np.zeros(2, bool), np.array([True, False])


def stepped(mask: np.ndarray = STEP, **terms: Any) -> Stepped:
    _, poses = table_scene(2)
    entries = {f"reward_terms/{name}": np.asarray(value, np.float32) for name, value in terms.items()}
    return Stepped(step_of(poses, success=np.zeros(2, bool), **entries), mask)


def test_terms_are_kept_by_their_name_and_other_entries_are_not() -> None:
    history = TermHistory(2)
    history.add(stepped(reach=[1, 2]))
    history.add(stepped(RESET))
    history.add(stepped(reach=[3, 4], push=[5, 6]))
    curves = history.curves()
    assert curves.tick.tolist() == [0, 1]
    assert curves.terms.keys() == {"reach", "push"}
    assert curves.terms["reach"].tolist() == [[1, 2], [3, 4]]
    np.testing.assert_array_equal(curves.terms["push"], [[np.nan, np.nan], [5, 6]])


def test_what_is_no_number_for_each_env_has_no_curve_and_is_named() -> None:
    history = TermHistory(2)
    result = stepped(reach=[1, 2], both=[[1, 2], [3, 4]]).step
    mean, note = OtherEntry("float", numbers=np.array(0.5)), OtherEntry("str", ("none",))
    result.others.update({"reward_terms/mean": mean, "reward_terms/note": note, "other": note})
    for _ in range(2):
        history.add(Stepped(result, STEP))
    curves = history.curves()
    assert (list(curves.terms), curves.no_curve) == (["reach"], ("both", "mean", "note"))
    history.add(stepped(reach=[1, 2]))
    assert history.curves().no_curve == ()


def test_a_ring_keeps_the_newest_oldest_first() -> None:
    history = TermHistory(2, length=3)
    for number in range(5):
        history.add(stepped(reach=[number, -number]))
    assert history.curves().tick.tolist() == [2, 3, 4]
    assert history.curves().terms["reach"][:, 0].tolist() == [2, 3, 4]


def test_a_term_that_a_new_version_drops_goes_when_its_last_value_goes() -> None:
    history = TermHistory(2, length=3)
    history.add(stepped(reach=[1, 1]))
    for _ in range(2):
        history.add(stepped(push=[1, 1]))
    assert history.curves().terms.keys() == {"reach", "push"}
    history.add(stepped(push=[1, 1]))
    assert history.curves().terms.keys() == {"push"}


def test_the_number_of_terms_is_bounded() -> None:
    history = TermHistory(2)
    terms: dict[str, Any] = {f"term{i}": [0, 0] for i in range(MOST + 5)}
    history.add(stepped(**terms))
    assert len(history.curves().terms) == MOST
