"""The other end of `workbench.ui.making`: ``python -m workbench.ui.making_process``."""

from __future__ import annotations

import json
import os
import signal
import sys
import time
from types import FrameType
from typing import NoReturn

from workbench.machine.guarded_terminal import guard_terminal
from workbench.ui.making import decode

SAY_EVERY = 0.1
"""Seconds. A sheet of pictures is quick, and a line a frame would be more to read than to make."""


def main() -> None:
    def on_signal(number: int, frame: FrameType | None) -> NoReturn:
        raise SystemExit(1)  # through the blocks that take half-written files away

    signal.signal(signal.SIGTERM, on_signal)
    guard_terminal()  # what is said of recordings has names from them in it
    # What libraries print goes where the author sees it, and not between our lines.
    ours = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)

    def say(**said: object) -> None:
        print(json.dumps(said), file=ours, flush=True)

    last = 0.0

    def on_progress(done: float, doing: str) -> None:
        nonlocal last
        if time.monotonic() - last >= SAY_EVERY:
            last = time.monotonic()
            say(done=done, doing=doing)

    wanted = decode(sys.stdin.read())
    from workbench.machine.software_vulkan import ensure_render_device
    from workbench.ui.make_shared import make

    if wanted.what == "scene":
        os.environ.update(ensure_render_device(install=False).env)
    try:
        made = make(wanted, on_progress)
        say(made=[os.fspath(path) for path in made.paths], words=made.words)
    except (ValueError, OSError, RuntimeError) as error:
        say(problem=str(error))


if __name__ == "__main__":
    main()
