"""A file's size as a person says it."""

from __future__ import annotations


def size_in_words(size: float) -> str:
    """``640 B``, ``2.5 MB``, ``1.2 GB``: to three digits, by 1000."""
    for unit in ("B", "kB", "MB"):
        if size < 999.5:
            return f"{size:.3g} {unit}"
        size /= 1000
    return f"{size:.3g} GB"
