"""A schema in fewer bytes says the same to Arrow, and so to rerun."""

from __future__ import annotations

import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st

from workbench.recording.rerun.pack_schema import packed_schema

TEXT = st.text(max_size=12)
FLAT = st.sampled_from(
    [
        pa.float32(),
        pa.float64(),
        pa.uint8(),
        pa.int64(),
        pa.bool_(),
        pa.string(),
        pa.binary(16),
        pa.duration("ns"),
    ]
)


def lists(of: st.SearchStrategy[pa.DataType]) -> st.SearchStrategy[pa.DataType]:
    items = st.builds(pa.field, TEXT, of, nullable=st.booleans())
    sized = st.builds(pa.list_, items, st.integers(1, 7))
    structs = st.builds(pa.struct, st.lists(items, max_size=3))
    return st.builds(pa.list_, items) | sized | structs


FIELDS = st.builds(
    pa.field,
    TEXT,
    st.recursive(FLAT, lists, max_leaves=4),
    nullable=st.booleans(),
    metadata=st.none() | st.dictionaries(TEXT, TEXT, max_size=4),
)


@given(st.lists(FIELDS, max_size=6))
def test_any_schema_stays_what_it_is(fields: list[pa.Field]) -> None:
    schema = pa.schema(fields)
    message = schema.serialize().to_pybytes()
    packed = packed_schema(message)
    assert len(packed) <= len(message)
    assert pa.ipc.read_schema(pa.py_buffer(packed)).equals(schema, check_metadata=True)


@pytest.mark.parametrize(
    "schema",
    [
        pa.schema([("at", pa.timestamp("ns", "UTC"))]),  # a type with a text in it
        pa.schema([("one", pa.int8())], metadata={"of": "the whole"}),
        pa.schema([("one", pa.dictionary(pa.int8(), pa.string()))]),
    ],
)
def test_what_it_does_not_know_stays_as_it_is(schema: pa.Schema) -> None:
    message = schema.serialize().to_pybytes()
    assert packed_schema(message) == message
