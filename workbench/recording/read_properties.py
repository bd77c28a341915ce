"""What an ``.rrd`` says of itself in rerun's properties: the episode, the versions, the source.

It is all that a library needs of a bare ``.rrd``, and less than `read_episode` reads. A file without a footer (its
writer was killed) is read as far as it goes.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rerun.chunk import RrdReader

_PROPERTIES = "/__properties"


def read_properties(path: Path) -> dict[str, dict[str, Any]]:
    """The properties of the first recording in `path`, by name and then by component.

    A component of one value is that value, a longer one a list.

    Raises:
        ValueError: `path` holds no recording.
        OSError: `path` cannot be read.
    """
    found: dict[str, dict[str, Any]] = {}
    for chunk in RrdReader(path).stream():
        if not chunk.entity_path.startswith(_PROPERTIES):
            continue
        name = chunk.entity_path[len(_PROPERTIES) :].lstrip("/")
        batch = chunk.to_record_batch()
        for field, column in zip(batch.schema, batch.columns):
            if (field.metadata or {}).get(b"rerun:kind") == b"data" and batch.num_rows:
                value = column[batch.num_rows - 1].as_py()
                if value is not None:
                    component = field.name.rsplit(":", 1)[-1]
                    found.setdefault(name, {})[component] = value[0] if len(value) == 1 else value
    return found
