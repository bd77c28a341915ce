"""Hypothesis strategies for message values by schema, and a deep equality."""

from __future__ import annotations

from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from hypothesis import strategies as st
from msgspec import inspect

ANY_VALUE = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text(max_size=5) | st.binary(max_size=9)
    | st.builds(msgspec.msgpack.Ext, st.integers(-128, 127), st.binary(max_size=12)),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5) | st.integers(0, 9), inner, max_size=3),
    max_leaves=5,
)  # fmt: skip
ARRAYS = st.builds(
    lambda kind, shape: np.zeros(shape, kind),
    st.sampled_from(["?", "<i4", "<f4", "<f8", "<U3", "|u1"]),
    st.lists(st.integers(0, 3), max_size=3),
)


def same(one: object, other: object) -> bool:
    if isinstance(one, np.ndarray):
        return isinstance(other, np.ndarray) and one.dtype == other.dtype and np.array_equal(one, other)
    if is_dataclass(one):
        return type(one) is type(other) and all(
            same(getattr(one, f.name), getattr(other, f.name)) for f in fields(one)
        )
    if isinstance(one, dict):
        return (
            isinstance(other, dict)
            and one.keys() == other.keys()
            and all(same(one[k], other[k]) for k in one)
        )
    if isinstance(one, tuple):
        return isinstance(other, tuple) and len(one) == len(other) and all(map(same, one, other))
    return one == other or (one != one and other != other)  # NaN


@st.composite
def of_schema(draw: st.DrawFn, kind: inspect.Type, wrong: float) -> Any:
    """Encoded data for a message of this type; each part is replaced by another value with probability `wrong`."""
    if wrong and draw(st.floats(0, 1)) < wrong:
        return draw(ANY_VALUE)
    again = lambda one: draw(of_schema(one, wrong))  # noqa: E731
    several = lambda one: [again(one) for _ in range(draw(st.integers(0, 2)))]  # noqa: E731
    match kind:
        case inspect.DataclassType():
            chosen = [field for field in kind.fields if field.required or draw(st.booleans())]
            left_out = (
                draw(st.sampled_from(kind.fields))
                if wrong and kind.fields and draw(st.integers(0, 9)) == 0
                else None
            )
            return {field.encode_name: again(field.type) for field in chosen if field is not left_out}
        case inspect.UnionType():
            return again(draw(st.sampled_from(kind.types)))
        case inspect.DictType():
            return {
                draw(st.text(max_size=4))
                if isinstance(kind.key_type, inspect.StrType)
                else _hashable(again(kind.key_type)): again(kind.value_type)
                for _ in range(draw(st.integers(0, 2)))
            }
        case inspect.TupleType():
            return [again(one) for one in kind.item_types]
        case (
            inspect.VarTupleType()
            | inspect.ListType()
            | inspect.FrozenSetType()
            | inspect.SetType()
            | inspect.CollectionType()
        ):
            return several(kind.item_type)
        case inspect.LiteralType():
            return draw(st.sampled_from(kind.values))
        case inspect.EnumType():
            return draw(st.sampled_from([one.value for one in kind.cls]))
        case inspect.CustomType():
            return draw(st.binary(max_size=5)) if kind.cls is Path else draw(ARRAYS)
        case inspect.IntType():
            return draw(st.integers(-(2**31), 2**31))
        case inspect.FloatType():
            return draw(st.floats())
        case inspect.StrType():
            return draw(st.text(max_size=5))
        case inspect.BoolType():
            return draw(st.booleans())
        case inspect.BytesType():
            return draw(st.binary(max_size=5))
        case inspect.NoneType():
            return None
    assert isinstance(kind, inspect.AnyType), kind
    return draw(ANY_VALUE.filter(lambda value: not _has_extension(value)))


def _hashable(value: Any) -> Any:
    value = tuple(map(_hashable, value)) if isinstance(value, list) else value
    return value if isinstance(value, str | int | float | bytes | tuple | None) else 0


def _has_extension(value: Any) -> bool:
    if isinstance(value, dict):
        return any(map(_has_extension, value.values()))
    return (
        any(map(_has_extension, value)) if isinstance(value, list) else isinstance(value, msgspec.msgpack.Ext)
    )
