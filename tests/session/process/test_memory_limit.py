from __future__ import annotations

import mmap
import os
from pathlib import Path

import pytest

from workbench.machine.processes.family import allocated_memory, resident_memory
from workbench.session.process.memory_limit import parse_memory, total_memory


@pytest.mark.parametrize(
    ("text", "size"),
    [("8GB", 8 * 2**30), ("1.5 GiB", 3 * 2**29), ("2048m", 2**31), ("none", None), (" 8g ", 8 * 2**30)],
)
def test_sizes_as_people_write_them(text: str, size: int | None) -> None:
    assert parse_memory(text) == size


@pytest.mark.parametrize("text", ["", "8 XB", "-1GB", "many", "100MB", "1e9", "8GB8"])
def test_what_is_no_size_or_too_little_is_refused_with_a_reason(text: str) -> None:
    with pytest.raises(ValueError, match="--memory-limit"):
        parse_memory(text)


def test_auto_leaves_something_to_the_others() -> None:
    limit = parse_memory("auto")
    assert limit is not None and 0.5 * total_memory() < limit < 0.9 * total_memory()


def test_what_a_process_allocates_is_told_from_the_files_that_it_maps(tmp_path: Path) -> None:
    size = 64 * 2**20
    (tmp_path / "library").write_bytes(b"x" * size)
    before, resident = allocated_memory(os.getpid()), resident_memory(os.getpid())
    with open(tmp_path / "library", "rb") as file, mmap.mmap(file.fileno(), 0, prot=mmap.PROT_READ) as mapped:
        assert mapped.find(b"y") == -1  # read, so that it is in memory
        assert resident_memory(os.getpid()) - resident > 0.9 * size
        assert allocated_memory(os.getpid()) - before < 0.1 * size
    held = mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE)
    held.write(b"x" * size)
    assert allocated_memory(os.getpid()) - before > 0.9 * size
    held.close()
    assert allocated_memory(2**22 + 1) == 0
