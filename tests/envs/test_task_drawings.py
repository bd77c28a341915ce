"""Drawings of some envs stand beside those of the others, and each env gets its own."""

from __future__ import annotations

import numpy as np
import pytest

from workbench.envs.task_drawings import Drawing, TaskDrawings


def texts(*words: str) -> Drawing:
    data = np.array([[[number, 0, 0]] for number, _ in enumerate(words)], np.float32)
    return Drawing("text", data, texts=words)


def test_each_env_gets_its_rows_and_its_text() -> None:
    kept = TaskDrawings()
    kept.put("it", texts("a", "b", "c"))
    kept.put("it", texts("x", "y"), [2, 0])
    drawn = kept.of_batch(4)["it"]
    assert drawn.texts == ("y", "b", "x", "") and drawn.data[:3, 0, 0].tolist() == [1, 1, 0]
    assert np.isnan(drawn.data[3]).all()
    for env, (word, x) in enumerate([("y", [1]), ("b", [1]), ("x", [0]), ("", [])]):
        own = drawn.of_env(env)
        assert own.texts == (word,) and own.data.shape == (1, len(x), 3) and own.data[0, :, 0].tolist() == x
    assert kept.of_batch(2) == {}, "a drawing of more envs belongs to another batch"


def test_items_with_a_nan_are_left_out_of_an_env() -> None:
    data = np.zeros((2, 3, 2, 3), np.float32)
    data[1, 0, 1, 2], data[1, 2] = np.nan, 5
    own = Drawing("lines", data).of_env(1)
    assert own.data.shape == (1, 2, 2, 3) and own.data[0, 1].tolist() == [[5, 5, 5]] * 2
    assert Drawing("lines", data).of_env(0).data.shape == (1, 3, 2, 3)


@pytest.mark.parametrize("fewer_first", [True, False])
def test_more_and_fewer_items_stand_side_by_side_and_another_kind_replaces_all(fewer_first: bool) -> None:
    kept = TaskDrawings()
    one, three = (Drawing("points", np.full((1, count, 3), count, np.float32)) for count in (1, 3))
    for env, drawing in ((0, one), (1, three)) if fewer_first else ((1, three), (0, one)):
        kept.put("it", drawing, [env])
    drawn = kept.of_batch(2)["it"]
    assert [drawn.of_env(env).data.tolist() for env in range(2)] == [[[[1] * 3]], [[[3] * 3] * 3]]
    kept.put("it", Drawing("lines", np.zeros((1, 1, 2, 3), np.float32)), [1])
    drawn = kept.of_batch(2)["it"]
    assert drawn.kind == "lines" and [drawn.of_env(env).data.shape[1] for env in range(2)] == [0, 1]


def test_a_rebuild_removes_the_drawings_of_earlier_versions() -> None:
    kept = TaskDrawings()
    for name in ("old", "both"):
        kept.put(name, texts("a"))
    kept.begin_version()
    for name in ("both", "new"):
        kept.put(name, texts("b"))
    kept.scene_replaced()
    assert kept.of_batch(1).keys() == {"both", "new"}
    kept.begin_version()
    kept.scene_replaced()
    assert kept.of_batch(1) == {}


def test_drawings_of_another_env_are_kept_apart_also_after_an_error() -> None:
    kept, other = TaskDrawings(), dict[str, Drawing]()
    kept.put("mine", texts("a"))
    with pytest.raises(ZeroDivisionError), kept.taken_into(other):
        assert kept.on
        kept.put("theirs", texts("b"))
        raise ZeroDivisionError
    assert not kept.on and kept.of_batch(1).keys() == {"mine"} and other.keys() == {"theirs"}
