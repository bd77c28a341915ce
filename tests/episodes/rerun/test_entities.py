"""No body's entity is nested in another body's entity, whatever the bodies' names."""

from __future__ import annotations

import numpy as np
from hypothesis import example, given
from hypothesis import strategies as st

from workbench.envs.scene.shapes import SceneGeometry
from workbench.episodes.rerun.entities import body_entities, series_names

NAME = st.text(st.sampled_from("ab/ c.ä"), max_size=6) | st.sampled_from(["cameras", "cameras/a", "a/b", "a"])


def entities(*names: str) -> tuple[str, ...]:
    count = len(names)
    return body_entities(SceneGeometry(1, names, ("dynamic",) * count, (False,) * count, ()))


def test_entities_are_named_after_bodies() -> None:
    assert entities("cube", "panda/panda_hand") == ("/world/cube", "/world/panda/panda_hand")


def test_series_are_named_in_the_order_in_which_their_numbers_are_written() -> None:
    for shape in ((), (2,), (2, 3), (3, 1, 2)):
        names = series_names("m", np.zeros((4, *shape)))
        assert names == [f"m{list(index)}" if index else "m" for index in np.ndindex(shape)]


@given(st.lists(NAME, max_size=6).map(tuple))
@example(("a", "a/b", "a_", "a_/b"))
@example(("", "/", "unnamed"))
def test_no_entity_is_nested_in_another(names: tuple[str, ...]) -> None:
    found = entities(*names)
    assert len(set(found)) == len(names)
    for one in found:
        assert one.startswith("/world/") and not one.startswith("/world/cameras/") and one != "/world/cameras"
        assert not any(other.startswith(one + "/") for other in found)
