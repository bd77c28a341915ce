"""A packed snapshot as one string of bytes, made where nobody can read it.

The server keeps what a worker packed (`snapshot_parts`) and imports neither torch nor ManiSkill. When a
moment is to be put back it joins the body and its parts into bytes that any worker unpickles as a plain
`Snapshot`, so whoever receives one need not know that it was ever cut.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class WholeSnapshot:
    """Unpickles as the `core.snapshot.Snapshot` that it was packed from."""

    body: bytes
    parts: tuple[bytes, ...]

    def __reduce__(self) -> tuple[Any, tuple[bytes, tuple[bytes, ...]]]:
        return unpacked, (self.body, self.parts)


def unpacked(body: bytes, parts: tuple[bytes, ...]) -> Any:
    """The snapshot itself; needs what the server has not."""
    from workbench.core.snapshot_parts import unpack_snapshot

    return unpack_snapshot(body, parts)
