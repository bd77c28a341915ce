"""Where a worker hangs, or died, in the author's words: read from faulthandler's dumps.

A process that loops in native code, or that a segmentation fault ends, cannot be asked anything any more. But
Python's ``faulthandler`` writes the stack from within a signal handler, without the interpreter's help, into
a file that both processes hold. The server reads it here: the frames, which of them is the author's, and in
which hook of the task it all happened. (Format: ``_Py_DumpTraceback`` in CPython's ``Python/traceback.c``;
innermost frame first, no source lines, characters beyond ASCII as backslash escapes.)

A worker that loops for ever sends nothing, and one that is paused sends nothing either. To tell them apart
without asking (the one that hangs would not answer), the worker notes in shared memory when it begins and
ends a piece of work: two small writes a control step, no message. The clock is CLOCK_MONOTONIC, which is the
same in every process of the machine.
"""

from __future__ import annotations

import mmap
import os
import re
import struct
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import dropwhile
from pathlib import Path
from traceback import FrameSummary, StackSummary
from typing import Literal, get_args

from workbench.authoring.loading.modules import read_source
from workbench.authoring.problem import HOOK_STAGES, Problem

_FRAME = re.compile(r'^  File "(?P<file>.*)", line (?P<line>\d+|\?\?\?) in (?P<function>.*)$', re.MULTILINE)
_FATAL = re.compile(r"^Fatal Python error: (?P<what>.+)$", re.MULTILINE)
_EXIT = re.compile(r"^os\._exit\((?P<code>[^)]*)\)$", re.MULTILINE)
_MOST_FRAMES = 60
_OURS = ("/workbench/session/", "/workbench/core/", "/workbench/authoring/", "<frozen runpy>")


@dataclass(frozen=True)
class Busy:
    """A piece of work that has lasted long, and where it was when the worker was last looked at."""

    seconds: float
    doing: str
    """For people: ``in evaluate``, ``loading``."""
    file: str | None = None
    """The author's file, if one of their lines is being executed."""
    line: int | None = None
    code: str | None = None
    traceback: str = ""
    drawing: bool = False
    """The renderer is at work, which may take long the first time."""
    getting_ready: bool = False
    """A new worker imports and compiles; no line of the author's is at work."""
    deaf: bool = False
    """It was interrupted and went on all the same."""
    held: bool = False
    """A debugger makes it stand still, or is waited for: it does not hang, and goes on when that says so."""
    awaited: bool = False
    """Nothing is done until a debugger attaches."""


def parse_stack(dump: str) -> list[FrameSummary]:
    """The frames of the dump's last stack, innermost first; empty when there is none."""
    last = dump.rfind("(most recent call first):")
    return [
        FrameSummary(
            found["file"], int(found["line"]) if found["line"].isdigit() else 0, found["function"], line=""
        )
        for found in _FRAME.finditer(dump, max(last, 0))
    ][:_MOST_FRAMES]


def fatal_error(dump: str) -> str | None:
    """What the dump says of the end: ``Segmentation fault``, ``called os._exit(3)``; None if nothing."""
    fatal, left = _FATAL.search(dump), _EXIT.search(dump)
    if fatal is not None:
        return fatal["what"]
    return None if left is None else f"called os._exit({left['code']})"


def author_place(
    frames: Sequence[FrameSummary], own_files: Iterable[str], texts: Mapping[str, str] | None = None
) -> tuple[str | None, int | None, str | None]:
    """File, line and code of the innermost frame in one of `own_files` (the author's paths); None where there is none.

    Args:
        texts: as of `as_traceback`.
    """
    named = {path.encode("ascii", "backslashreplace").decode(): path for path in own_files}
    for frame in frames:
        if frame.filename in named:
            file, line = named[frame.filename], frame.lineno or 0
            return file, line, code_of(file, line, texts)
    return None, None, None


def hook_of(frames: Sequence[FrameSummary]) -> str | None:
    """The stage of the innermost hook of a task on the stack: ``evaluate``, ``reward``, ``build`` ..."""
    return next((HOOK_STAGES[f.name] for f in frames if f.name in HOOK_STAGES), None)


def as_traceback(frames: Sequence[FrameSummary], texts: Mapping[str, str] | None = None) -> str:
    """As Python prints a traceback: outermost first, with the lines; less the workbench's own at its start.

    Args:
        texts: source by path, of files whose running version is not what is on disk.
    """
    theirs = dropwhile(lambda frame: any(part in frame.filename for part in _OURS), reversed(frames))
    with_code = [_frame(f.filename, f.lineno or 0, f.name, texts) for f in theirs]
    said = "".join(StackSummary.from_list(with_code).format()).rstrip()
    return f"Traceback (most recent call last):\n{said}" if said else ""


def _frame(file: str, line: int, function: str, texts: Mapping[str, str] | None) -> FrameSummary:
    # Never without a text, or Python would read the file: it may be a device or a pipe by now.
    return FrameSummary(file, line, function, line=code_of(file, line, texts) or "")


def code_of(file: str, line: int, texts: Mapping[str, str] | None = None) -> str | None:
    """Text of a line, stripped; None where it cannot be had."""
    text = None if texts is None else texts.get(file)
    try:
        # Not linecache: the file may be a device or a pipe by now, and this is the page's process.
        lines = (read_source(file) if text is None else text).splitlines()
    except (OSError, SyntaxError):
        return None
    return lines[line - 1].strip() or None if 0 < line <= len(lines) else None


def busy_at(
    seconds: float, doing: Doing, dump: str, own_files: Iterable[str], deaf: bool, held: bool = False
) -> Busy:
    """What a look at a worker at work showed; `dump` may be empty. Other arguments are as of `Busy`."""
    frames = parse_stack(dump)
    hook, (file, line, code) = hook_of(frames), author_place(frames, own_files)
    return Busy(
        seconds=seconds,
        doing=f"in {hook}" if hook is not None else doing,
        file=file,
        line=line,
        code=code,
        traceback=as_traceback(frames),
        drawing=doing == "drawing" and hook is None,
        getting_ready=doing in ("starting", "warming up") and hook is None,
        deaf=deaf,
        held=held,
        awaited=held and doing == "waiting for a debugger",
    )


def death_problem(
    why: str, doing: str | None, dump: str, own_files: Sequence[str], printed: str, texts: Mapping[str, str]
) -> Problem:
    """Why there is no worker any more, at the author's line if its last words name one.

    Args:
        why: for example ``was killed by SIGSEGV``.
        doing: what it was at: ``stepping``; None when it was at nothing.
        dump: its last stack, or empty.
        printed: the last lines that it printed.
        texts: source by path of the version that ran.
    """
    frames = parse_stack(dump)
    hook, fatal = hook_of(frames), fatal_error(dump)
    file, line, code = author_place(frames, own_files, texts)
    message = f"the worker process {why}"
    if fatal is not None and fatal.startswith("called"):
        message = f"the worker process {fatal}"
    elif fatal is not None:
        message += f" ({fatal})"
    if hook is not None:
        message += f" in {hook}"
    elif doing is not None:
        message += f" while {doing}"
    parts = [as_traceback(frames, texts), f"The last lines that it printed:\n{printed}" if printed else ""]
    return Problem(
        stage="worker",
        message=message,
        file=file,
        line=line,
        code=code,
        traceback="\n\n".join(part for part in parts if part),
    )


def own_files_of(source_files: Iterable[str], own_file: Path | None) -> list[str]:
    """The author's files, the task's own first, also before it was ever loaded."""
    own = [] if own_file is None else [str(own_file)]
    return own + [path for path in source_files if path not in own]


# --- What the worker is doing now, readable while it hangs: a page of memory that both processes see ---


Doing = Literal[
    "starting",
    "idle",
    "warming up",
    "loading",
    "stepping",
    "resetting",
    "drawing",
    "importing the policy",
    "waiting for a debugger",
]
_DOINGS: tuple[Doing, ...] = get_args(Doing)
_LAYOUT = struct.Struct("=QdB")
"""Number of the piece of work, its beginning in seconds, index into `_DOINGS`."""
_PID, _PID_AT = struct.Struct("=I"), 64
"""Of the worker; 0 until it has begun."""
_HELD_AT = 128
"""A byte: 1 while a debugger holds it."""


@dataclass(frozen=True)
class Beat:
    """What a worker was doing when it was looked at."""

    number: int
    """Counts pieces of work: the same number a while later is the same piece. 0 until the first."""
    doing: Doing
    since: float
    """``time.monotonic()`` of its beginning."""
    held: bool = False
    """A debugger makes it stand still, or is waited for."""

    @property
    def seconds(self) -> float:
        """How long it has been at it; 0 for a worker that waits to be asked."""
        return 0.0 if self.doing == "idle" or self.number == 0 else max(0.0, time.monotonic() - self.since)


def make_pulse() -> int:
    """The memory, as a file descriptor that can be passed on; the caller closes it."""
    fd = os.memfd_create("workbench-pulse")
    os.ftruncate(fd, mmap.PAGESIZE)
    return fd


class PulseWriter:
    """The worker's side."""

    def __init__(self, fd: int) -> None:
        self._memory = mmap.mmap(fd, mmap.PAGESIZE)
        _PID.pack_into(self._memory, _PID_AT, os.getpid())
        self._number = 0

    def begin(self, doing: Doing) -> None:
        self._number += 1
        _LAYOUT.pack_into(self._memory, 0, self._number, time.monotonic(), _DOINGS.index(doing))

    def hold(self, held: bool) -> None:
        """A debugger makes the worker stand still, or lets it go on."""
        self._memory[_HELD_AT] = held


class PulseReader:
    """The server's side."""

    def __init__(self, fd: int) -> None:
        self._memory = mmap.mmap(fd, mmap.PAGESIZE, prot=mmap.PROT_READ)

    @property
    def pid(self) -> int:
        """Process id of the worker; 0 until it has begun."""
        return _PID.unpack_from(self._memory, _PID_AT)[0]

    def read(self) -> Beat:
        # Written by another process without a lock: a torn reading is one that changes when read again.
        for _ in range(100):
            first = self._memory[: _LAYOUT.size]
            if first == self._memory[: _LAYOUT.size]:
                break
        number, since, doing = _LAYOUT.unpack(first)
        return Beat(number, _DOINGS[min(doing, len(_DOINGS) - 1)], since, self._memory[_HELD_AT] == 1)
