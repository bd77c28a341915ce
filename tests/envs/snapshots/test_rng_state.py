"""Random generators that are read at every step, in full only when they were drawn from, and put back."""

# numpy says that ``get_state`` may give a dict, which it does for other algorithms only.
# pyright: reportArgumentType=false

from __future__ import annotations

import gc
import random
from typing import Any

import numpy as np
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st

from workbench.envs.snapshots.rng_state import RngReader, read_shared_rng, write_shared_rng

CPU = torch.device("cpu")


def generators(count: int = 3) -> list[np.random.RandomState]:
    return [np.random.RandomState(seed) for seed in range(count)]


def same(one: Any, other: Any) -> bool:
    return all(np.array_equal(a, b) for a, b in zip(one, other, strict=True))


def assert_reads_true(reader: RngReader, kept: list[np.random.RandomState], purpose: str = "episode") -> None:
    for state, generator in zip(reader.read(purpose, kept), kept, strict=True):
        assert same(state, generator.get_state())


DRAWS = {
    "nothing": lambda g: None,
    "uniform": lambda g: g.uniform(),
    "normal": lambda g: g.normal(),
    "two normals": lambda g: g.normal(size=2),
    "integer": lambda g: g.randint(1000),
    "seed": lambda g: g.seed(5),
}


# A normal number that is kept aside is put back, and taking it, which changes no byte of the key, is seen.
@example(
    [
        ("draw", 1, 0, "normal"),
        ("keep", 0, 0, "nothing"),
        ("draw", 1, 0, "normal"),
        ("write", 1, 1, "nothing"),
        ("draw", 1, 0, "normal"),
    ]
)
@settings(max_examples=60)
@given(
    st.lists(
        st.tuples(
            st.sampled_from(["draw", "keep", "write"]), st.integers(0, 2), st.integers(0, 2),
            st.sampled_from(sorted(DRAWS)),
        ),
        max_size=14,
    )
)  # fmt: skip
def test_what_is_read_is_what_each_generator_says(history: list[tuple[str, int, int, str]]) -> None:
    reader, held = RngReader(), generators()
    kept = [reader.read("episode", held)]
    for what, env, source, draw in history:
        if what == "draw":
            DRAWS[draw](held[env])
        elif what == "keep":
            kept.append(list(reader.read("episode", held)))
        else:
            state = kept[-1][source]
            reader.write("episode", held, [env], [state])
            assert same(held[env].get_state(), state)
        assert_reads_true(reader, held)


def test_states_go_into_the_generators_that_are_named_in_whichever_order() -> None:
    reader, held = RngReader(), generators()
    states = [g.get_state() for g in generators(5)[3:]]
    untouched = held[1].get_state()
    reader.write("episode", held, [2, 0], states)
    expected = [states[1], untouched, states[0]]
    assert all(same(g.get_state(), state) for g, state in zip(held, expected, strict=True))
    assert_reads_true(reader, held)


def test_two_lists_of_generators_are_kept_apart_and_others_in_their_place_are_read_anew() -> None:
    reader, episode, main = RngReader(), generators(), generators(5)[2:]
    assert_reads_true(reader, episode)
    assert_reads_true(reader, main, "main")
    assert_reads_true(reader, episode)
    episode[0] = np.random.RandomState(99)
    assert_reads_true(reader, episode)
    del episode
    gc.collect()
    assert_reads_true(reader, generators(5)[1:4])


def test_the_processs_generators_go_back_to_where_they_were() -> None:
    def draw() -> tuple[float, float, float, float]:
        return float(torch.rand(1)), float(np.random.rand()), float(np.random.normal()), random.random()

    before = read_shared_rng(CPU)
    try:
        np.random.normal()
        kept = read_shared_rng(CPU)
        first = draw()
        assert draw() != first
        write_shared_rng(kept, CPU)
        assert draw() == first
        np.random.uniform()
        write_shared_rng(kept, CPU)
        assert draw() == first, "what is kept is not drawn from"
        assert kept.torch_device is None
    finally:
        write_shared_rng(before, CPU)
