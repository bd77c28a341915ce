"""Hypothesis strategies for any dict that an author's evaluate() may return."""

from __future__ import annotations

import torch
from hypothesis import strategies as st


class Mute:
    def __repr__(self) -> str:
        raise KeyError("nothing to be said")


LEAF = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.floats(),
    st.complex_numbers(),
    st.text(st.characters(), max_size=6),
    st.binary(max_size=4),
    st.lists(st.one_of(st.integers(), st.text(max_size=2), st.none(), st.floats()), max_size=5),
    st.builds(
        lambda shape, dtype: torch.ones(shape, dtype=dtype),
        st.lists(st.integers(0, 5), max_size=3).map(tuple),
        st.sampled_from([torch.bool, torch.int32, torch.float32, torch.bfloat16, torch.complex64]),
    ),
    st.builds(object),
    st.builds(Mute),
)

KEY = st.one_of(st.text(st.characters(), max_size=4), st.integers(), st.none(), st.tuples(st.integers()))

ENTRIES = st.dictionaries(
    KEY, st.recursive(LEAF, lambda inner: st.dictionaries(KEY, inner, max_size=3), max_leaves=6), max_size=5
)
