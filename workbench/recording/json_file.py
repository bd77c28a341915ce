"""Reads JSON files that anybody may have written: regular files of bounded size."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from workbench.machine.regular_file import FileTooLarge, NotARegularFile, read_regular_file

MOST_BYTES = 64 << 20
"""ManiSkill's ``.json`` of 100,000 episodes has 40 MB."""


class NotJson(ValueError):
    """The file holds no JSON that can be read; the message goes on from the file's name."""


def read_json(path: Path, most_bytes: int = MOST_BYTES) -> Any:
    """What a ``.json`` holds.

    Raises:
        OSError: it cannot be read.
        NotJson: it is no JSON, no regular file, or much too long.
    """
    try:
        content = read_regular_file(path, most_bytes)
    except FileTooLarge as error:
        raise NotJson(f"is longer than {most_bytes >> 20} MB") from error
    except NotARegularFile as error:
        raise NotJson(str(error.strerror)) from error
    return parse_json(content)


def parse_json(content: bytes | str) -> Any:
    """Raises NotJson."""
    try:
        return json.loads(content)
    except (ValueError, RecursionError) as error:
        raise NotJson("is not JSON, or was cut short") from error
