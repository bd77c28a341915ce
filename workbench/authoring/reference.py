"""What a task reference names, told from its form alone.

The server must know which file to follow before, and whether or not, the worker can load it, and it
must not import ManiSkill to find out: that takes seconds and a graphics driver.
"""

from __future__ import annotations

import re
from pathlib import Path

_FILE = re.compile(r"(?P<file>.+\.py)(:[^/\\]*)?", re.DOTALL)


def named_file(reference: str) -> Path | None:
    """The file of ``file.py`` or ``file.py:ClassName``, whether or not it exists; None for an env id."""
    match = _FILE.fullmatch(reference)
    return None if match is None else Path(match["file"]).expanduser().resolve()
