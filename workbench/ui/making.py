"""Something is made from recordings in a process of its own, while the page goes on.

Encoding a film takes a core for a while, and drawing a scene takes a renderer that the server's process must not
import (a crash in a driver would take the page along). So the process is handed what is wanted as JSON, says on its
standard output how far it is, a line of JSON each, and may be ended at any moment: what it had not finished it takes
away with it.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn

import msgspec

from workbench.machine.child_python import child_environment, python_command
from workbench.machine.family import describe_exit
from workbench.machine.guarded_terminal import guard_terminal
from workbench.machine.software_vulkan import ensure_render_device
from workbench.machine.watched_thread import say_failure
from workbench.ui.make_shared import Made, Wanted, make

END_SECONDS = 5.0


@dataclass(frozen=True)
class MakingView:
    """How it stands."""

    running: bool = False
    done: float = 0.0
    """0..1"""
    doing: str = ""
    problem: str = ""
    """Why it could not be made, in a sentence; empty if it could, or was stopped."""
    made: tuple[Made, ...] = ()
    """All that was made so far, the newest first."""


class Making:
    """At most one process at a time. All methods may be called from any thread.

    Args:
        on_change: called after every change of the view, on a thread of this.
    """

    def __init__(self, on_change: Callable[[], None] = lambda: None) -> None:
        self._lock = threading.Lock()
        self._on_change = on_change
        self._view = MakingView()
        self._process: subprocess.Popen[str] | None = None
        self._stopped = False
        self._scratch: Path | None = None

    def view(self) -> MakingView:
        return self._view

    def scratch(self) -> Path:
        """A folder for what is fetched by the page and then not needed any more; gone after `close`."""
        with self._lock:
            if self._scratch is None:
                self._scratch = Path(tempfile.mkdtemp(prefix="workbench-shared-"))
            return self._scratch

    def start(self, wanted: Wanted) -> bool:
        """Begin; False where something is made already."""
        with self._lock:
            if self._view.running:
                return False
            self._stopped = False
            self._view = MakingView(running=True, doing="starting", made=self._view.made)
        self._on_change()
        threading.Thread(target=self._run, args=(wanted,), name="making", daemon=True).start()
        return True

    def stop(self) -> None:
        """End what is made now; nothing of it stays. Returns at once."""
        with self._lock:
            self._stopped = True
            process = self._process
        if process is not None:
            with contextlib.suppress(ProcessLookupError):
                process.terminate()

    def close(self) -> None:
        """Stop, wait for the end of the process, and take the scratch folder away."""
        self.stop()
        process = self._process
        if process is not None:
            _end(process)
        if self._scratch is not None:
            shutil.rmtree(self._scratch, ignore_errors=True)

    def _run(self, wanted: Wanted) -> None:
        problem, made = "", None
        try:
            problem, made = self._ask(wanted)
        except OSError as error:
            problem = f"The process that makes it could not be started: {error}."
        except (ValueError, KeyError, TypeError) as error:
            say_failure("What the process that makes it said could not be read", error)
            problem = "The process that makes it said what cannot be read; the terminal says more."
        with self._lock:
            self._process = None
            known = self._view.made if made is None else (made, *self._view.made)
            self._view = MakingView(problem="" if self._stopped else problem, made=known)
        self._on_change()

    def _ask(self, wanted: Wanted) -> tuple[str, Made | None]:
        with subprocess.Popen(
            python_command("-m", "workbench.ui.making"),
            env=child_environment(),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            encoding="utf-8",
            # Ctrl-C in the terminal is for the page, which ends this itself.
            start_new_session=True,
        ) as process:
            with self._lock:
                self._process = process
                stopped = self._stopped
            if stopped:
                process.terminate()
            assert process.stdin is not None and process.stdout is not None
            problem, made = "", None
            with contextlib.suppress(BrokenPipeError):
                process.stdin.write(encode(wanted))
                process.stdin.close()
            for line in process.stdout:
                said = json.loads(line)
                if "problem" in said:
                    problem = said["problem"]
                elif "made" in said:
                    made = Made(tuple(map(Path, said["made"])), said["words"])
                else:
                    with self._lock:
                        self._view = replace(self._view, done=said["done"], doing=said["doing"])
                    self._on_change()
            _end(process)
        if made is None and not problem:
            more = "; the terminal says more" if process.returncode >= 0 else ""
            problem = f"The process that makes it {describe_exit(process.returncode)}{more}."
        return problem, made


def _end(process: subprocess.Popen[str]) -> None:
    try:
        process.wait(timeout=END_SECONDS)
    except subprocess.TimeoutExpired:
        # It and the ffmpeg that it started.
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


# --- over the pipe ---------------------------------------------------------------------------------


def encode(wanted: Wanted) -> str:
    return msgspec.json.encode(wanted, enc_hook=str).decode()


def decode(text: str) -> Wanted:
    def path(kind: type, value: Any) -> Any:
        if kind is Path:
            return Path(value)
        raise NotImplementedError(f"{kind} does not cross this pipe")

    return msgspec.json.decode(text.encode(), type=Wanted, dec_hook=path)


# --- the process: ``python -m workbench.ui.making`` -------------------------------------------------

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
    if wanted.what == "scene":
        os.environ.update(ensure_render_device(install=False).env)
    try:
        made = make(wanted, on_progress)
        say(made=[os.fspath(path) for path in made.paths], words=made.words)
    except (ValueError, OSError, RuntimeError) as error:
        say(problem=str(error))


if __name__ == "__main__":
    main()
