"""Differences between two recordings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tests.drive.episodes import BODY, geometry_of, made, poses_of
from workbench.review.differences import ARM_METRES, Difference, difference, distances, source_changes


def parts_at(found: Difference) -> int | None:
    assert found.bodies is not None
    return found.bodies.position


def test_the_first_body_that_moves_elsewhere_and_when() -> None:
    a, b = made(10), made(10)
    poses_of(b)[6:, BODY["arm/hand"], 2] += 0.02
    poses_of(b)[8:, BODY["cube"], 1] += 0.5
    b.evaluate["success"][9:] = True
    b.reward[3:] *= 2
    found = difference(a, b, (0, 0))
    assert found.bodies is not None and found.bodies.position == 6 and found.body == "arm/hand"
    assert "2 cm" in found.bodies.values and "50 cm (cube)" in found.bodies.largest
    differing = [(p.name, p.position) for p in found.numbers if p.position is not None]
    assert differing == [("reward", 4), ("success", 9)]
    reward = found.numbers[0]
    assert reward.values == "4 → 8" and reward.totals == "55 → 104"
    assert found.same_seed and found.same_source and not found.source
    assert parts_at(difference(a, b, (0, 0), tolerance=0.1)) == 8


def test_different_bodies_lengths_and_entries_are_reported() -> None:
    a, b = made(10), made(4)
    b.geometry = replace(geometry_of(b), body_names=("ground", "table", "arm/hand", "box"), visuals=())
    del b.evaluate["distance"]
    b.action = np.zeros((4, 3), np.float32)
    found = difference(a, b, (0, 0))
    assert found.not_in_both == ("cube (only in A)", "box (only in B)") and found.compared == 5
    values = {p.name: p.values for p in found.numbers}
    assert values["distance"] == "only in A" and values["action"] == "shape (2,) → (3,)"
    b.geometry = None
    assert difference(a, b, (0, 0)).bodies is None


def test_turning_counts_and_either_sign_of_a_quaternion_is_the_same() -> None:
    still, turned = np.array([0, 0, 0, 1, 0, 0, 0.0]), np.array([0, 0, 0, np.cos(0.1), np.sin(0.1), 0, 0])
    assert np.isclose(distances(still, turned), 0.2 * ARM_METRES)
    assert distances(still, -still) == 0
    lacking = np.full(7, np.nan)
    assert distances(still, lacking) == np.inf and distances(lacking, lacking) == 0


def test_changed_source_lines_are_listed() -> None:
    ((name, lines),) = source_changes(
        {"a/task_v1.py": "a\nb\n", "a/m.py": "x"}, {"b/task_v2.py": "a\nc\n", "b/m.py": "x"}
    )
    assert name == "task_v1.py → task_v2.py" and [text for kind, text in lines if kind in ("add", "del")] == [
        "-b",
        "+c",
    ]
    ((name, lines),) = source_changes({"/old/push.py": "a\nb\nc\n"}, {"/new/push.py": "a\nB\nc\n"})
    assert name == "push.py"
    assert ("del", "-b") in lines and ("add", "+B") in lines and ("same", " a") in lines
