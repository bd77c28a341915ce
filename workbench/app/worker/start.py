"""Entry of a worker process: installs its crash handlers before any heavy import."""

from __future__ import annotations

import contextlib
import faulthandler
import os
import signal
import sys
import threading
import traceback
from pathlib import Path
from typing import NoReturn

from workbench.machine.maniskill_installed import lines_if_lacking
from workbench.machine.processes.child_environment import LOWEST_NICENESS, quick_imports
from workbench.machine.processes.family import begin_family
from workbench.machine.versions import untested_text


def main() -> None:
    """Run a worker: ``python -m workbench.app.worker.start SOCKET HEARTBEAT STACKS SERVER NICENESS``; see `run`."""
    run(*map(int, sys.argv[1:6]))


def run(connection: int, heartbeat_fd: int, stacks: int, server: int, niceness: int) -> None:
    """Fork: the child becomes the worker, and this process becomes its keeper.

    `connection`, `heartbeat_fd` and `stacks` are file descriptors (see `WorkerProcess`), `server` is the
    process id of the parent. Before it imports heavy modules, the worker sets up the following: a crash
    writes its stack; the server can request the stack by a signal; when memory is short, the kernel kills the
    worker first; and the worker ends with its server (`family`).
    """
    begin_family(server)
    if niceness:
        os.nice(niceness)
    if niceness >= LOWEST_NICENESS:
        # Use only CPU time that no other process wants. Some containers forbid this policy.
        with contextlib.suppress(OSError):
            os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    # A server that a script started in the background ignores SIGINT, and we would inherit that.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    _let_kernel_end_us_first()
    leave = os._exit
    _install_stack_writers(stacks)
    from workbench.live.process.heartbeat import INTERRUPT_SIGNAL, HeartbeatWriter

    heartbeat = HeartbeatWriter(heartbeat_fd)
    heartbeat.begin("starting")
    from workbench.machine.processes.debugger import OPEN_WITH_DEBUG, pass_breakpoints, refuse_breakpoints

    if niceness:  # a background worker; only the worker that plays can be debugged
        pass_breakpoints()
    else:
        refuse_breakpoints(OPEN_WITH_DEBUG)
    code = 0
    try:
        if (lacking := lines_if_lacking("A task")) is not None:
            print(*lacking, sep="\n", file=sys.stderr)
            code = 1
        else:
            with quick_imports():
                from workbench.app.worker.main_loop import work

            work(connection, heartbeat)
    except BaseException as error:
        traceback.print_exc()
        if isinstance(error, ImportError) and (text := untested_text()):
            print(f"workbench: {text}", file=sys.stderr)
        code = 1
    signal.signal(INTERRUPT_SIGNAL, signal.SIG_IGN)  # from here on the default action would end the process
    # Without this, the interpreter would wait for the task's threads, and the page would wait for this
    # process.
    others = [thread for thread in threading.enumerate() if thread is not threading.main_thread()]
    if code or not all(thread.daemon for thread in others):
        try:
            sys.stdout.flush()
            sys.stderr.flush()
        finally:  # flushing raises if the task has closed the streams
            leave(code)


def _let_kernel_end_us_first() -> None:
    """Set the highest OOM score: when memory runs out, the kernel kills this process, not the server."""
    try:
        Path("/proc/self/oom_score_adj").write_text("1000")
    except OSError:
        pass  # a sandbox may forbid it; the supervisor checks the memory as well


def _install_stack_writers(stacks: int) -> None:
    """Write the stack into the file `stacks`: at a crash, at the server's signal, and at ``os._exit``."""
    from workbench.live.process.heartbeat import INTERRUPT_SIGNAL, STACK_SIGNAL

    faulthandler.enable(file=stacks, all_threads=False)
    # At exit the interpreter removes faulthandler's handler and restores the previous one. With the default action the
    # signal would then end the process, and the page would name the signal as the cause.
    signal.signal(STACK_SIGNAL, signal.SIG_IGN)
    faulthandler.register(STACK_SIGNAL, file=stacks, all_threads=False)
    # Until the worker installs its handler there is nothing to interrupt, and the default action would end the process.
    signal.signal(INTERRUPT_SIGNAL, signal.SIG_IGN)
    leave, us = os._exit, os.getpid()

    def leave_with_stack(code: int) -> NoReturn:
        # os._exit runs no handler and raises nothing: without this only the exit code would be known.
        if os.getpid() == us:  # not in a process that the author's code forked
            os.write(stacks, f"os._exit({code})\n".encode())
            faulthandler.dump_traceback(file=stacks, all_threads=False)
        leave(code)

    os._exit = leave_with_stack


if __name__ == "__main__":
    main()
