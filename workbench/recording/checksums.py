"""Whether a file of a recording is as it was written.

Neither format notices a changed byte: HDF5 has a checksum for chunks alone, which most columns of an episode are too small to be, and costs
whoever reads; rerun takes what a chunk's bytes say. An episode judged again from such a file is wrong without a word. So the ``.json``
says how long each of the other two is and what it hashes to: both are in the system's memory when they have just been written,
where reading and hashing them takes a hundredth of what writing them took, and no program that reads the files alone is concerned.

It tells damage, not forgery: who changes a file can change the ``.json`` too. And whoever changed one on purpose (``rerun rrd optimize``) takes
its entry out of ``workbench.files`` in the ``.json``, and is believed.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import xxhash

from workbench.machine.regular_file import open_regular_file
from workbench.recording.document import Checksum

_BLOCK = 1 << 20


def checksum(path: Path) -> Checksum:
    """Of the file at `path`. Raises OSError."""
    hashed = xxhash.xxh3_128()
    size = 0
    with open_regular_file(path) as file:
        while block := file.read(_BLOCK):
            hashed.update(block)
            size += len(block)
    return Checksum(size, hashed.hexdigest())


def check(path: Path, said: Mapping[str, Checksum]) -> None:
    """Compare the file at `path` with what its ``.json`` says of files of its suffix, if it says anything.

    Raises:
        OSError: it is another, and how; or it cannot be read.
    """
    if (why := wrong_size(said, path.suffix, path.stat().st_size)) is not None:
        raise OSError(why)
    written = said.get(path.suffix)
    if written is not None and written.xxh3_128 is not None and checksum(path) != written:
        raise OSError("its checksum is not the one that was written down with it")


def wrong_size(said: Mapping[str, Checksum], suffix: str, size: int) -> str | None:
    """What is wrong with a file that is `size` bytes long; None for nothing."""
    if suffix not in said or said[suffix].size == size:
        return None
    return f"it has {size} bytes, and had {said[suffix].size}"
