"""What a worker is doing, where it hangs or died, and how its work is interrupted."""

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
_MOST_FRAMES = 60
_OURS = ("/workbench/session/", "/workbench/core/", "/workbench/authoring/", "<frozen runpy>")


@dataclass(frozen=True)
class Busy:
    """A piece of work that takes long, and where it was at the last look."""

    seconds: float
    doing: str
    """Text for the page: ``in evaluate``, ``loading``."""
    file: str | None = None
    """The author's file, if one of its lines is being executed."""
    line: int | None = None
    code: str | None = None
    traceback: str = ""
    drawing: bool = False
    """Whether the renderer works, which may take long the first time."""
    getting_ready: bool = False
    """Whether a new worker imports and compiles; none of the author's lines runs then."""
    ignores_interrupt: bool = False
    """Whether the worker was interrupted and continued nevertheless."""
    held: bool = False
    """Whether a debugger has suspended the worker, or is waited for; the worker does not hang then."""
    awaited: bool = False
    """Whether the worker waits until a debugger attaches."""


def parse_stack(dump: str) -> list[FrameSummary]:
    """The frames of the last stack in a dump of ``faulthandler``, innermost first; empty if there is none.

    faulthandler writes from a signal handler without the interpreter's help, so it works in a process that loops in
    native code or dies of a segmentation fault. Format: ``_Py_DumpTraceback`` in CPython's ``Python/traceback.c``;
    innermost frame first, no source lines, characters beyond ASCII as backslash escapes.
    """
    last = dump.rfind("(most recent call first):")
    return [
        FrameSummary(
            found["file"], int(found["line"]) if found["line"].isdigit() else 0, found["function"], line=""
        )
        for found in _FRAME.finditer(dump, max(last, 0))
    ][:_MOST_FRAMES]


def fatal_error(dump: str) -> str | None:
    """How the process ended according to the dump: ``Segmentation fault``, ``called os._exit(3)``; None if not there."""
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
        texts: source by path, for files that run in another version than on disk.
    """
    theirs = dropwhile(lambda frame: any(part in frame.filename for part in _OURS), reversed(frames))
    with_code = [_frame(f.filename, f.lineno or 0, f.name, texts) for f in theirs]
    text = "".join(StackSummary.from_list(with_code).format()).rstrip()
    return f"Traceback (most recent call last):\n{text}" if text else ""


def _frame(file: str, line: int, function: str, texts: Mapping[str, str] | None) -> FrameSummary:
    # Without a text Python would read the file, which may be a device or a pipe by now.
    return FrameSummary(file, line, function, line=code_of(file, line, texts) or "")


def code_of(file: str, line: int, texts: Mapping[str, str] | None = None) -> str | None:
    """Text of a line, stripped; None if it cannot be read."""
    text = None if texts is None else texts.get(file)
    try:
        # Not linecache: the file may be a device or a pipe by now, which would block the page.
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
) -> Busy:
    """`Busy` from the worker's stack; `dump` may be empty."""
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
        ignores_interrupt=ignores_interrupt,
        held=held,
        awaited=held and doing == "waiting for a debugger",
    )


def death_problem(
    why: str, doing: str | None, dump: str, own_files: Sequence[str], printed: str, texts: Mapping[str, str]
) -> Problem:
    """How a worker died, at the author's line if the last stack names one.

    Args:
        why: for example ``was killed by SIGSEGV``.
        doing: for example ``stepping``; None for an idle worker.
        dump: its last stack, or empty.
        printed: its last lines of output.
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
    """The author's files, the task's own first, which is known before anything is loaded."""
    own = [] if own_file is None else [str(own_file)]
    return own + [path for path in source_files if path not in own]


# --- what the worker does now, in memory that both processes map -------------------------------------
# A hanging worker and a paused one both send nothing, and asking would not tell them apart. So the worker writes when
# it begins and ends a piece of work: two small writes a control step, no message. The clock is CLOCK_MONOTONIC, which
# is the same in all processes of the machine.


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
"""Layout: number of the piece of work, its beginning in seconds, index into `_DOINGS`."""
_PID, _PID_AT = struct.Struct("=I"), 64
"""Layout and offset of the worker's process id; 0 until the worker has started."""
_HELD_AT = 128
"""Offset of a byte that is 1 while a debugger holds the worker."""


@dataclass(frozen=True)
class Beat:
    """What a worker was doing at one moment."""

    number: int
    """Number of the piece of work, counting up; 0 before the first."""
    doing: Doing
    since: float
    """``time.monotonic()`` at the beginning of the work."""
    held: bool = False
    """Whether a debugger has suspended the worker, or is waited for."""

    @property
    def seconds(self) -> float:
        """How long this piece of work has taken; 0 for an idle worker."""
        return 0.0 if self.doing == "idle" or self.number == 0 else max(0.0, time.monotonic() - self.since)


def make_heartbeat() -> int:
    """Shared memory as a file descriptor for the child; the caller closes it. Until the child writes, it is starting."""
    fd = os.memfd_create("workbench-heartbeat")
    os.ftruncate(fd, mmap.PAGESIZE)
    os.pwrite(fd, _LAYOUT.pack(0, time.monotonic(), _DOINGS.index("starting")), 0)
    return fd


class HeartbeatWriter:
    """The worker's side of the heartbeat."""

    def __init__(self, fd: int) -> None:
        self._memory = mmap.mmap(fd, mmap.PAGESIZE)
        _PID.pack_into(self._memory, _PID_AT, os.getpid())
        self._number = 0

    def begin(self, doing: Doing) -> None:
        self._number += 1
        _LAYOUT.pack_into(self._memory, 0, self._number, time.monotonic(), _DOINGS.index(doing))

    def hold(self, held: bool) -> None:
        """A debugger has suspended the worker, or has let it continue."""
        self._memory[_HELD_AT] = held


class HeartbeatReader:
    """The server's side of the heartbeat."""

    def __init__(self, fd: int) -> None:
        self._memory = mmap.mmap(fd, mmap.PAGESIZE, prot=mmap.PROT_READ)

    @property
    def pid(self) -> int:
        """Process id of the worker; 0 until it has started."""
        return _PID.unpack_from(self._memory, _PID_AT)[0]

    def read(self) -> Beat:
        # There is no lock between the processes: a torn read differs from the next one.
        for _ in range(100):
            first = self._memory[: _LAYOUT.size]
            if first == self._memory[: _LAYOUT.size]:
                break
        number, since, doing = _LAYOUT.unpack(first)
        return Beat(number, _DOINGS[min(doing, len(_DOINGS) - 1)], since, self._memory[_HELD_AT] == 1)


# --- interrupting the author's code ------------------------------------------------------------------

INTERRUPT_SIGNAL = signal.SIGUSR1
"""Signal that interrupts the author's code. Not SIGINT, for which libraries and authors install handlers of their own."""
STACK_SIGNAL = signal.SIGUSR2
"""Signal that makes faulthandler write the worker's stack into its file."""


class Interrupts:
    """Lets the server stop the author's code in the worker's main thread, and never the workbench's own.

    A signal's handler runs in the main thread between two bytecodes and may raise there, so a Python loop that never ends
    is left with a traceback that names the author's line. Elsewhere it must not raise: half a message in the pipe would
    end the session. So a signal counts only while `allowed`, and not within `shielded`. Native code that does not return,
    and a loop that catches everything, cannot be left this way; the supervisor reports that.
    """

    def __init__(self) -> None:
        self.allowed = False
        """Set it after `begin`, and clear it in a ``finally``, by plain assignments: a signal can raise at the start of
        any call, and would leave it set for good."""
        self._waiting = False
        self._began = 0.0

    def install(self) -> None:
        """Install the handler; without it the signal would end the process."""
        signal.signal(INTERRUPT_SIGNAL, self._on_signal)

    def begin(self) -> None:
        """Forget the signals that came before the work that begins now."""
        self._began, self._waiting = time.monotonic(), False

    @contextmanager
    def shielded(self) -> Iterator[None]:
        """Finish what is done within this; a signal that came meanwhile is raised afterwards."""
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
        # Between two pieces of work there is nothing to stop; within `shielded` it is raised at its end.
        self._waiting = True

    def _raise(self) -> None:
        self._waiting = False
        raise Interrupted(f"stopped by hand after {time.monotonic() - self._began:.1f} s")
