"""Reads numbers from untrusted HDF5 files, within limits."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from workbench.machine.files import open_regular_file
from workbench.machine.processes.child_environment import unchanged_environment

with unchanged_environment():
    # HDF5 reads the variable when plugins are first needed; "::" disables them. A file may name a filter, which HDF5 would
    # load from a folder of libraries.
    os.environ.setdefault("HDF5_PLUGIN_PRELOAD", "::")
    h5py.h5pl.size()

MAX_BYTES = 1 << 30
"""Maximum size of the numbers that are read from one open file."""
MAX_NODES = 200_000
"""Maximum number of groups and datasets that are looked up in one open file."""
MAX_DEPTH = 32
"""Maximum nesting of groups; hard links can form a cycle."""
ALLOWED_BYTES = 1 << 20
"""Size that a dataset may claim without storage: a dataset that was never written has no storage, and reads
as zeros."""
MAX_COMPRESSION_RATIO = 1100
"""Maximum compression ratio; deflate's limit is 1032."""
MAX_CHUNK_BYTES = 16 << 20
"""Size that a chunk may have regardless of its dataset's storage."""

_FILTERS = {
    h5py.h5z.FILTER_DEFLATE,
    h5py.h5z.FILTER_SHUFFLE,
    h5py.h5z.FILTER_FLETCHER32,
    h5py.h5z.FILTER_SZIP,
    h5py.h5z.FILTER_NBIT,
    h5py.h5z.FILTER_SCALEOFFSET,
    h5py.h5z.FILTER_LZF,
}
"""Filters that come with h5py."""
_NUMBERS = "biuf"


class RefusedH5(ValueError):
    """The file is refused; the message follows the file's name.

    HDF5 by default follows external links, external storage and virtual datasets into other files of the machine, loads
    filter plugins, and allocates the size that a dataset claims (terabytes in a file of 8 kB). The classes of
    this module follow only hard links and the soft links within the file, read only plain numbers, and
    compare a dataset's size with its storage before they allocate anything.
    """


@contextmanager
def open_h5(path: Path) -> Iterator[H5Group]:
    """The root group of the file at `path`, open during the block.

    Raises:
        OSError: it cannot be opened, or is not a regular HDF5 file.
    """
    with open_regular_file(path) as file:
        size = os.fstat(file.fileno()).st_size
    # Without a lock, because a recorder may have the file open.
    with h5py.File(path, "r", locking=False) as opened:
        yield H5Group(opened, _Budget(size))


class _Budget:
    """How much may still be read from an open file."""

    def __init__(self, file_size: int) -> None:
        self.file_size = file_size
        self._bytes, self._nodes = MAX_BYTES, MAX_NODES

    def take_node(self) -> None:
        self._nodes -= 1
        if self._nodes < 0:
            raise RefusedH5(f"holds more than {MAX_NODES:,} groups and datasets")

    def take_bytes(self, name: str, count: int) -> None:
        self._bytes -= count
        if self._bytes < 0:
            raise RefusedH5(f"holds more than {MAX_BYTES >> 30} GB of numbers (at {name})")


class H5Group:
    """A group; its content is looked up by name, or by a path with ``/``."""

    def __init__(self, group: h5py.Group, budget: _Budget, depth: int = 0) -> None:
        self._group, self._budget, self._depth = group, budget, depth

    def __iter__(self) -> Iterator[str]:
        if len(self._group) > MAX_NODES:
            raise RefusedH5(f"holds a group of {len(self._group):,} entries")
        return (str(name) for name in self._group)

    def __contains__(self, path: str) -> bool:
        return self.get(path) is not None

    def __getitem__(self, path: str) -> H5Group | H5Dataset:
        """The entry. Raises KeyError if it is missing, and RefusedH5."""
        found = self.get(path)
        if found is None:
            raise KeyError(f"{self._where(path)} is missing")
        return found

    def get(self, path: str) -> H5Group | H5Dataset | None:
        """The entry; None if it is missing. Raises RefusedH5."""
        return self._follow(path, 0)

    def group(self, path: str) -> H5Group | None:
        """The group; None if it is missing or not a group. Raises RefusedH5."""
        found = self.get(path)
        return found if isinstance(found, H5Group) else None

    def numbers(self, path: str) -> NDArray:
        """All numbers of a dataset. Raises KeyError if there is none, and RefusedH5."""
        found = self[path]
        if not isinstance(found, H5Dataset):
            raise KeyError(f"{path} is a group, not a dataset")
        return found.read()

    def _follow(self, path: str, links: int) -> H5Group | H5Dataset | None:
        node: H5Group | H5Dataset | None = self
        for name in (part for part in path.split("/") if part not in ("", ".")):
            if not isinstance(node, H5Group):
                return None
            node = node._child(name, links)
        return node

    def _child(self, name: str, links: int) -> H5Group | H5Dataset | None:
        self._budget.take_node()
        link = self._group.get(name, getlink=True)
        if isinstance(link, h5py.ExternalLink):
            raise RefusedH5(f"has {self._where(name)} in another file (an external link), which is not read")
        if isinstance(link, h5py.SoftLink):
            if links >= MAX_DEPTH:
                raise RefusedH5(f"has links that form a cycle (at {self._where(name)})")
            begin = H5Group(self._group.file, self._budget) if link.path.startswith("/") else self
            return begin._follow(link.path, links + 1)
        if link is None:
            return None
        if self._depth >= MAX_DEPTH:
            raise RefusedH5(f"has groups more than {MAX_DEPTH} deep (at {self._where(name)})")
        found = self._group[name]
        if isinstance(found, h5py.Group):
            return H5Group(found, self._budget, self._depth + 1)
        return H5Dataset(found, self._budget) if isinstance(found, h5py.Dataset) else None

    def _where(self, name: str) -> str:
        return f"{self._group.name or ''}/{name}".strip("/")


class H5Dataset:
    """A dataset of this file, read on request."""

    def __init__(self, dataset: h5py.Dataset, budget: _Budget) -> None:
        """Raises RefusedH5."""
        self.name = str(dataset.name)
        creation = dataset.id.get_create_plist()
        # Check before reading the shape, for which HDF5 opens the files of a virtual dataset.
        if creation.get_layout() == h5py.h5d.VIRTUAL:
            raise RefusedH5(
                f"has {self._short} composed of other files (a virtual dataset), which are not read"
            )
        if creation.get_external_count():
            raise RefusedH5(f"has {self._short} stored in another file (external storage), which is not read")
        for index in range(creation.get_nfilters()):
            if (code := creation.get_filter(index)[0]) not in _FILTERS:
                raise RefusedH5(
                    f"has {self._short} compressed with a filter that does not come with h5py ({code})"
                )
        self._dataset, self._budget = dataset, budget
        self.dtype: np.dtype = dataset.dtype
        self.shape: tuple[int, ...] = tuple(dataset.shape or ())
        self._check_size()

    @property
    def ndim(self) -> int:
        return len(self.shape)

    @property
    def is_numbers(self) -> bool:
        """Whether it holds plain booleans, integers or floating point numbers."""
        return self.dtype.kind in _NUMBERS and self._dataset.shape is not None

    def __len__(self) -> int:
        return self.shape[0] if self.shape else 0

    def read(self) -> NDArray:
        """Read the whole dataset. Raises RefusedH5."""
        self._check_numbers()
        self._budget.take_bytes(self._short, self._size(self.shape))
        return _native(self._dataset[()])

    def row(self, number: int) -> NDArray:
        """Row `number`. Raises RefusedH5, and IndexError if there is none."""
        self._check_numbers()
        if not self.shape:
            raise RefusedH5(f"has a single number instead of rows (at {self._short})")
        index = range(len(self))[number]
        self._budget.take_bytes(self._short, self._size(self.shape[1:]))
        return _native(self._dataset[index])

    def _check_numbers(self) -> None:
        if not self.is_numbers:
            raise RefusedH5(f"has {self._short} of type {self.dtype}, which is not a plain number")

    def _check_size(self) -> None:
        """Compare the size that the shape claims with the dataset's storage."""
        storage = self._dataset.id.get_storage_size()
        if storage > self._budget.file_size:
            raise RefusedH5(
                f"claims {storage:,} bytes for {self._short}, but the file has {self._budget.file_size:,} in all"
            )
        claimed = self._size(self.shape)
        chunk = self._dataset.chunks
        if claimed > ALLOWED_BYTES + storage * (1 if chunk is None else MAX_COMPRESSION_RATIO):
            raise RefusedH5(
                f"claims {claimed:,} bytes of numbers for {self._short}, but stores {storage:,} bytes"
            )
        if chunk is not None and self._size(chunk) > MAX_CHUNK_BYTES + storage * MAX_COMPRESSION_RATIO:
            raise RefusedH5(f"claims chunks of {self._size(chunk):,} bytes for {self._short}")

    def _size(self, shape: tuple[int, ...]) -> int:
        return math.prod(shape) * max(self.dtype.itemsize, 1)

    @property
    def _short(self) -> str:
        return self.name.strip("/")


def _native(numbers: NDArray) -> NDArray:
    """Numbers in this machine's byte order, which torch requires."""
    array = np.asarray(numbers)
    return array.astype(array.dtype.newbyteorder("="), copy=False)
