"""The worker's heartbeat: what it is doing, where it hangs or died, and how to interrupt it."""

from __future__ import annotations

import mmap
import os
import re
import signal
import struct
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import dropwhile
from pathlib import Path
from traceback import FrameSummary, StackSummary
from types import FrameType
from typing import Literal, get_args

from workbench.task.modules import read_source
from workbench.task.problem import HOOK_STAGES, Interrupted, Problem

_FRAME = re.compile(r'^  File "(?P<file>.*)", line (?P<line>\d+|\?\?\?) in (?P<function>.*)$', re.MULTILINE)
_FATAL = re.compile(r"^Fatal Python error: (?P<what>.+)$", re.MULTILINE)
_EXIT = re.compile(r"^os\._exit\((?P<code>[^)]*)\)$", re.MULTILINE)
_MAX_FRAMES = 60
_OURS = ("/workbench/app/", "/workbench/live/", "/workbench/envs/", "/workbench/task/", "<frozen runpy>")


@dataclass(frozen=True)
class Busy:
    """A piece of work that takes long, and the line of code that was being executed at the last check."""

    seconds: float
    doing: str
    """What the worker does, as text for the page: ``in evaluate``, ``loading``."""
    file: str | None = None
    """The author's file, if one of its lines is being executed."""
    line: int | None = None
    code: str | None = None
    traceback: str = ""
    drawing: bool = False
    """Whether the worker renders, which may take long the first time."""
    getting_ready: bool = False
    """Whether a new worker imports and compiles; none of the author's code runs then."""
    ignores_interrupt: bool = False
    """Whether the worker continued after an interrupt."""
    held: bool = False
    """Whether a debugger has suspended the worker, or the worker waits for a debugger. Neither is a hang."""
    awaited: bool = False
    """Whether the worker waits until a debugger attaches."""


def parse_stack(dump: str) -> list[FrameSummary]:
    """The frames of the last stack in a dump of ``faulthandler``, innermost first; empty if there is none.

    faulthandler writes in a signal handler without the interpreter, so it works in a process that loops in native code or
    dies of a segmentation fault. Format: ``_Py_DumpTraceback`` in CPython's ``Python/traceback.c``;
    innermost frame first, no source lines, characters beyond ASCII as backslash escapes.
    """
    last = dump.rfind("(most recent call first):")
    return [
        FrameSummary(
            found["file"], int(found["line"]) if found["line"].isdigit() else 0, found["function"], line=""
        )
        for found in _FRAME.finditer(dump, max(last, 0))
    ][:_MAX_FRAMES]


def fatal_error(dump: str) -> str | None:
    """How the process ended according to the dump: ``Segmentation fault``, ``called os._exit(3)``; None if unknown."""
    fatal, left = _FATAL.search(dump), _EXIT.search(dump)
    if fatal is not None:
        return fatal["what"]
    return None if left is None else f"called os._exit({left['code']})"


def author_place(
    frames: Sequence[FrameSummary], own_files: Iterable[str], texts: Mapping[str, str] | None = None
) -> tuple[str | None, int | None, str | None]:
    """File, line and code of the innermost frame in one of `own_files` (the author's paths); None if there is none.

    Args:
        texts: as for `as_traceback`.
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
    """A traceback in Python's format, without the workbench's own frames at its start.

    Args:
        texts: source by path, for files whose running version differs from the disk.
    """
    theirs = dropwhile(lambda frame: any(part in frame.filename for part in _OURS), reversed(frames))
    with_code = [_frame(f.filename, f.lineno or 0, f.name, texts) for f in theirs]
    text = "".join(StackSummary.from_list(with_code).format()).rstrip()
    return f"Traceback (most recent call last):\n{text}" if text else ""


def _frame(file: str, line: int, function: str, texts: Mapping[str, str] | None) -> FrameSummary:
    # Without a text Python would read the file, which may have become a device or a pipe.
    return FrameSummary(file, line, function, line=code_of(file, line, texts) or "")


def code_of(file: str, line: int, texts: Mapping[str, str] | None = None) -> str | None:
    """Text of a line, stripped; None if it cannot be read."""
    text = None if texts is None else texts.get(file)
    try:
        # Not linecache: the file may have become a device or a pipe, which would block the page.
        lines = (read_source(file) if text is None else text).splitlines()
    except (OSError, SyntaxError):
        return None
    return lines[line - 1].strip() or None if 0 < line <= len(lines) else None


def busy_at(
    seconds: float,
    doing: Doing,
    dump: str,
    own_files: Iterable[str],
    ignores_interrupt: bool,
    held: bool = False,
    texts: Mapping[str, str] | None = None,
) -> Busy:
    """`Busy` from the worker's stack; `dump` may be empty.

    Args:
        texts: as for `as_traceback`.
    """
    frames = parse_stack(dump)
    hook, (file, line, code) = hook_of(frames), author_place(frames, own_files, texts)
    return Busy(
        seconds=seconds,
        doing=f"in {hook}" if hook is not None else doing,
        file=file,
        line=line,
        code=code,
        traceback=as_traceback(frames, texts),
        drawing=doing == "drawing" and hook is None,
        getting_ready=doing in ("starting", "warming up") and hook is None,
        ignores_interrupt=ignores_interrupt,
        held=held,
        awaited=held and doing == "waiting for a debugger",
    )


def death_problem(
    why: str, doing: str | None, dump: str, own_files: Sequence[str], printed: str, texts: Mapping[str, str]
) -> Problem:
    """The death of a worker as a problem, at the author's line if the last stack names one.

    Args:
        why: for example ``was killed by SIGSEGV``.
        doing: for example ``stepping``; None for an idle worker.
        dump: the worker's last stack; may be empty.
        printed: the last lines of the worker's output.
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
    """The author's files. The task's own file, which is known before anything is loaded, comes first."""
    own = [] if own_file is None else [str(own_file)]
    return own + [path for path in source_files if path not in own]


# --- the heartbeat in shared memory ------------------------------------------------------------------
# A hanging worker and a paused worker both send nothing. To tell them apart, the worker writes the start and
# end of each piece of work into shared memory: two small writes per control step, and no message. The clock
# is CLOCK_MONOTONIC, which is the same in all processes of the machine.


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
_LAYOUT = struct.Struct("=QdBQ")
"""Layout: number of the piece of work, its start in seconds, index into `_DOINGS`, and the number again. The
two numbers differ while the worker writes."""
_PID, _PID_AT = struct.Struct("=I"), 64
"""Layout and offset of the worker's process id; 0 until the worker has started."""
_HELD_AT = 128
"""Offset of a byte that is 1 while a debugger holds the worker."""


@dataclass(frozen=True)
class Beat:
    """Activity of a worker at one moment."""

    number: int
    """Number of the piece of work, counting up; 0 before the first."""
    doing: Doing
    since: float
    """``time.monotonic()`` at the beginning of the work."""
    held: bool = False
    """Whether a debugger has suspended the worker, or the worker waits for a debugger."""

    @property
    def seconds(self) -> float:
        """How long this piece of work has taken; 0 for an idle worker."""
        return 0.0 if self.doing == "idle" or self.number == 0 else max(0.0, time.monotonic() - self.since)


def make_heartbeat() -> int:
    """Make the shared memory. Returns its file descriptor, for the child; the caller closes it. Until the
    child writes, `HeartbeatReader.read` gives ``starting``."""
    fd = os.memfd_create("workbench-heartbeat")
    os.ftruncate(fd, mmap.PAGESIZE)
    os.pwrite(fd, _LAYOUT.pack(0, time.monotonic(), _DOINGS.index("starting"), 0), 0)
    return fd


class HeartbeatWriter:
    """The worker's side of the heartbeat."""

    def __init__(self, fd: int) -> None:
        self._memory = mmap.mmap(fd, mmap.PAGESIZE)
        _PID.pack_into(self._memory, _PID_AT, os.getpid())
        self._number = 0

    def begin(self, doing: Doing) -> None:
        self._number += 1
        # Not `pack_into`, which clears the memory first: the server might read a start at second 0, and
        # report the worker as busy.
        written = _LAYOUT.pack(self._number, time.monotonic(), _DOINGS.index(doing), self._number)
        self._memory[: _LAYOUT.size] = written

    def hold(self, held: bool) -> None:
        """Report that a debugger has suspended the worker, or has let it continue."""
        self._memory[_HELD_AT] = held


class HeartbeatReader:
    """The server's side of the heartbeat."""

    def __init__(self, fd: int) -> None:
        self._memory = mmap.mmap(fd, mmap.PAGESIZE, prot=mmap.PROT_READ)
        self._last: tuple[int, float, int] = (0, time.monotonic(), _DOINGS.index("starting"))

    @property
    def pid(self) -> int:
        """Process id of the worker; 0 until it has started."""
        return _PID.unpack_from(self._memory, _PID_AT)[0]

    def read(self) -> Beat:
        # There is no lock between the processes, and the worker may be suspended while it writes.
        number, since, doing, again = _LAYOUT.unpack(self._memory[: _LAYOUT.size])
        if number == again:
            self._last = number, since, doing
        number, since, doing = self._last
        return Beat(number, _DOINGS[min(doing, len(_DOINGS) - 1)], since, self._memory[_HELD_AT] == 1)


# --- interrupting the author's code ------------------------------------------------------------------

INTERRUPT_SIGNAL = signal.SIGUSR1
"""Signal that interrupts the author's code. Not SIGINT, since libraries and authors install their own handlers for it."""
STACK_SIGNAL = signal.SIGUSR2
"""Signal that makes faulthandler write the worker's stack into its file."""


class Interrupts:
    """Lets the server stop the author's code in the worker's main thread, but never the workbench's own code.

    A signal handler runs in the main thread between two bytecodes and may raise there: this ends an endless
    Python loop, with a traceback at the author's line. In the workbench's code it must not raise: half a
    message in the pipe would end the session. So the handler raises only while `allowed`, and not within
    `shielded`. It cannot stop native code that does not return, nor a loop that catches everything; the
    supervisor reports both.
    """

    def __init__(self) -> None:
        self.allowed = False
        """Set this after `begin`, and clear it in a ``finally``, by plain assignments: a signal can raise at
        the start of any call, so a method that clears `allowed` might never run."""
        self._waiting = False
        self._began = 0.0

    def install(self) -> None:
        """Install the handler; without it the signal would end the process."""
        signal.signal(INTERRUPT_SIGNAL, self._on_signal)

    def begin(self) -> None:
        """Discard signals that arrived before the work that begins now."""
        self._began, self._waiting = time.monotonic(), False

    @contextmanager
    def shielded(self) -> Iterator[None]:
        """Let the block finish; a signal that arrives meanwhile is raised afterwards."""
        before, self.allowed = self.allowed, False
        try:
            yield
        finally:
            self.allowed = before
        if before and self._waiting:
            self._raise()

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        if self.allowed:
            self._raise()
        # Between two pieces of work there is nothing to stop; `shielded` raises at its end.
        self._waiting = True

    def _raise(self) -> None:
        self._waiting = False
        raise Interrupted(f"stopped by the user after {time.monotonic() - self._began:.1f} s")
