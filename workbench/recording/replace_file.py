"""A file whose content changes in one step: whoever reads it, or dies meanwhile, finds the old one or the new one."""

from __future__ import annotations

import contextlib
import os
import shutil
import uuid
from pathlib import Path


def replace_file(path: Path, content: bytes) -> None:
    """Let `path`, whether or not it is there yet, hold `content`: all of it, or what it held before.

    Raises:
        OSError: it cannot be written.
    """
    path = path.resolve()  # a link stays one
    temporary = path.with_name(f".{uuid.uuid4().hex}{path.suffix}.part")
    try:
        with temporary.open("xb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        with contextlib.suppress(OSError):  # a new file has no mode to keep
            shutil.copymode(path, temporary)
        os.replace(temporary, path)
    except BaseException:
        with contextlib.suppress(OSError):  # what is to be told is why it was not written
            temporary.unlink(missing_ok=True)
        raise
