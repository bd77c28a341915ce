"""Keeps the bytes of chunks that one file after the other has, such as a scene's meshes: encoding them is most of the work."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeAlias

import numpy as np
import pyarrow as pa
from rerun.chunk import Chunk

from workbench.recording.rerun.append_blueprint import BlueprintBytes, write_end
from workbench.recording.rerun.private_api import read_fields
from workbench.recording.rerun.rrd_index import (
    ID,
    MESSAGE,
    PLACE,
    SIZE,
    Manifest,
    Schema,
    moved,
    packed,
    read_index,
)

_MOST_KEPT = 32
"""Sets of chunks: an env each, where a scene names its bodies by env. A set has some hundred kilobytes."""
_MOST_SHAPES = 16
"""Sorts of files with one set: which bodies move, and what ``evaluate()`` returns, may differ."""
_RECORDING_ID = 2
"""Field of a store's ids."""

Key: TypeAlias = tuple[str, ...]


@dataclass(frozen=True)
class _Kept:
    """A set of chunks as it was in a file."""

    recording_id: bytes
    messages: bytes
    """With that id in each."""
    rows: pa.RecordBatch
    """In the index, with places counted from the first of `messages`."""
    schema: Schema
    """Of the whole file."""


_kept: OrderedDict[Key, dict[bytes, _Kept]] = OrderedDict()
"""By the hash of the schema of all other chunks of a file, too."""
_keeping = threading.Lock()


def key_of(application_id: str, chunks: Sequence[Chunk]) -> Key:
    """Of a set of chunks that files of this application share."""
    return (application_id, *(chunk.id for chunk in chunks))


def is_known(key: Key) -> bool:
    """Whether these chunks were in a file before. The first time it is not worth keeping them: they may not come again."""
    with _keeping:
        if key in _kept:
            _kept.move_to_end(key)
            return True
        _kept[key] = {}
        if len(_kept) > _MOST_KEPT:
            _kept.popitem(last=False)
        return False


def keep(key: Key, whole: Path, rest: bytes) -> None:
    """Keep the bytes of these chunks from a file that rerun has written.

    Args:
        rest: `schema_hash` of the file without them.

    Raises OSError.
    """
    with whole.open("rb") as file:
        manifest = Manifest.read(read_index(file, whole.name).manifests[0])
        file.seek(0)
        content = file.read()
    table = manifest.table
    ids = {bytes.fromhex(id_.rpartition("_")[2]) for id_ in key[1:]}
    rows = np.flatnonzero([id_ in ids for id_ in table.column(ID).to_pylist()])
    places, sizes = (table.column(name).to_numpy().take(rows).tolist() for name in (PLACE, SIZE))
    each = [content[place - MESSAGE.size : place + size] for place, size in zip(places, sizes)]
    ends = np.cumsum([len(message) for message in each])
    column = table.schema.get_field_index(PLACE)
    begins = pa.array((ends - np.array(sizes)).astype(np.uint64))
    table = table.take(pa.array(rows)).set_column(column, table.schema.field(column), begins)
    id_, messages = _recording_id(manifest), b"".join(each)
    with _keeping:
        kept = _kept.setdefault(key, {})
        for other in kept.values():  # with other chunks beside them, mostly the same bytes
            if other.messages == messages.replace(id_, other.recording_id):
                id_, messages = other.recording_id, other.messages
                break
        if len(kept) >= _MOST_SHAPES:
            kept.clear()
        kept[rest] = _Kept(id_, messages, table, packed(manifest.schema))


def schema_hash(path: Path) -> bytes:
    """That of a file without the shared chunks. Raises OSError."""
    with path.open("rb") as file:
        return Manifest.read(read_index(file, path.name).manifests[0]).schema.hash


def add_kept(path: Path, key: Key, blueprint: BlueprintBytes) -> bool:
    """Add the kept chunks behind those of the file at `path`, and a blueprint; whether there were any. Raises OSError."""
    with path.open("r+b") as file:
        index = read_index(file, path.name)
        manifest = Manifest.read(index.manifests[0])
        with _keeping:
            kept = _kept.get(key, {}).get(manifest.schema.hash)
        if kept is None:
            return False
        messages = kept.messages.replace(kept.recording_id, _recording_id(manifest))
        table = _joined(manifest.table, moved(kept.rows, index.begin))
        whole = replace(manifest, schema=kept.schema, table=table)
        file.seek(index.begin)
        file.write(messages)
        write_end(file, index.begin + len(messages), [whole.written()], blueprint)
    return True


def _joined(own: pa.RecordBatch, kept: pa.RecordBatch) -> pa.RecordBatch:
    """All rows. What `own` lacks are columns that say whether a chunk has a component for all times."""
    numbers = {name: number for number, name in enumerate(own.schema.names)}
    absent = pa.array(np.zeros(own.num_rows, np.bool_))
    columns = [own.column(numbers[name]) if name in numbers else absent for name in kept.schema.names]
    rows = pa.Table.from_batches([pa.RecordBatch.from_arrays(columns, schema=kept.schema), kept])
    return rows.combine_chunks().to_batches()[0]


def _recording_id(manifest: Manifest) -> bytes:
    found = dict(read_fields(manifest.store))[_RECORDING_ID]
    assert not isinstance(found, int)
    return bytes(found)
