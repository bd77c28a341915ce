"""Values from untrusted files become values of the library's rows, or unknown."""

from __future__ import annotations

import datetime
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from workbench.episodes.row import (
    MAX_NOTE_CHARACTERS,
    MAX_TAG_CHARACTERS,
    MAX_TAGS,
    Facts,
    LibraryRow,
    RecordingKind,
    Source,
    boolean,
    clean_facts,
    clean_note,
    clean_tags,
    clean_text,
    integer,
    known_seed,
    number,
    total,
    unix_seconds,
)


@pytest.mark.parametrize(
    ("convert", "value", "found"),
    [
        (clean_text, " a ", "a"),
        (clean_text, "a\nb\x1b", "a b"),
        (clean_text, "é" * 300, "é" * 200),
        (clean_text, 5, ""),
        (integer, 0, 0),
        (integer, 3.0, 3),
        (integer, 3.5, None),
        (integer, [7], 7),
        (integer, [7, 8], None),
        (integer, True, None),
        (integer, "7", None),
        (integer, 2**63 - 1, 2**63 - 1),
        (integer, 2**63, None),
        (integer, -(2**63) - 1, None),
        (known_seed, 0, 0),
        (known_seed, -1, None),
        (number, 2, 2.0),
        (number, -0.5, -0.5),
        (number, True, None),
        (number, math.nan, None),
        (number, math.inf, None),
        (number, 10**400, None),
        (total, math.inf, math.inf),
        (total, "1", None),
        (boolean, [True], True),
        (boolean, False, False),
        (boolean, 1, None),
        (boolean, [True, False], None),
        (unix_seconds, "1970-01-01T00:01:00", 60.0),
        (unix_seconds, "1970-01-01T00:01:00Z", 60.0),
        (unix_seconds, "1970-01-01T01:01:00+01:00", 60.0),
        (unix_seconds, "1969-12-31T23:59:00", None),
        (unix_seconds, "9999-01-01T00:00:00", None),
        (unix_seconds, "yesterday", None),
        (unix_seconds, 60, None),
        (clean_tags, ["b", "a", "b", "", 7, "a,c "], ("b", "a", "a c")),
        (clean_tags, "good", ()),
        (clean_tags, {"good": 1}, ()),
        (clean_tags, None, ()),
        (clean_tags, ["x" * 99], ("x" * MAX_TAG_CHARACTERS,)),
        (clean_tags, map(str, range(99)), tuple(map(str, range(MAX_TAGS)))),
        (clean_note, "y" * 9999, "y" * MAX_NOTE_CHARACTERS),
    ],
)
def test_a_value_of_the_right_type_is_kept_and_any_other_is_unknown(
    convert: Callable[[object], object], value: object, found: object
) -> None:
    kept = convert(value)
    assert kept == found and type(kept) is type(found)


def test_all_texts_and_numbers_of_a_row_are_cleaned() -> None:
    texts = dict.fromkeys(
        "task uid copy_of control_mode acted_by source_hash trajectory note problem".split(), "a\nb"
    )
    wild: dict[str, Any] = {"env_index": "2", "length": 4.0, "written": math.inf, "total_reward": math.nan}
    cleaned = clean_facts(Facts("workbench", **texts, **wild, seed=-1, tags=("a\tb",)))
    assert {getattr(cleaned, name) for name in texts} == {"a b"}
    assert (cleaned.seed, cleaned.env_index, cleaned.length, cleaned.written) == (None, None, 4, None)
    assert cleaned.tags == ("a b",) and cleaned.total_reward is not None and math.isnan(cleaned.total_reward)
    assert clean_facts(Facts("workbench")) == Facts("workbench")


@pytest.mark.parametrize(
    ("kind", "files", "part", "read", "as_kind", "stem"),
    [
        ("workbench", ("in/a.b.json", "in/a.b.h5"), None, "in/a.b.json", "workbench", "a.b"),
        ("maniskill", ("in/demo.json", "in/demo.h5"), "traj_3", "in/demo.h5", "maniskill", "demo_traj_3"),
        ("lerobot", ("in/set.v1/meta/info.json",), "3", "in/set.v1", "lerobot", "set.v1_3"),
    ],
)
def test_a_row_names_what_its_reader_opens(
    kind: RecordingKind, files: tuple[str, ...], part: str | None, read: str, as_kind: str, stem: str
) -> None:
    identity: dict[str, Any] = {"id": "1", "name": "its name", "place": ("", 0), "size": 1}
    row = LibraryRow(kind, trajectory=part, written=60.0, paths=tuple(map(Path, files)), **identity)
    assert row.source == Source(Path(read), part, "1", "its name")
    assert (row.source.kind, row.source.stem) == (as_kind, stem)
    assert row.date == datetime.datetime(1970, 1, 1, 0, 1, tzinfo=datetime.timezone.utc)
