"""How a worker process begins: ready to say where it died before anything that may die is imported.

The heavy modules are imported last. By then a crash writes its stack, the server can look at the process by
a signal, the kernel knows whom to end when memory is short, and the process goes when its server does (`family`).

The server starts it as ``python -m workbench.session.worker.start SOCKET PULSE STACKS SERVER NICENESS``: three file
descriptors (see `process`), the server's process id, and by how much others come first.
"""

from __future__ import annotations

import faulthandler
import os
import signal
import sys
import threading
import traceback
from pathlib import Path
from typing import NoReturn

from workbench.machine.processes.child_python import quick_imports
from workbench.machine.processes.family import begin_family


def main() -> None:
    """Entry of the process."""
    connection, heartbeat_fd, stacks, server, niceness = map(int, sys.argv[1:6])
    begin_family(server)
    if niceness:
        os.nice(niceness)
    # A server that a script has started in the background hands down that SIGINT is ignored.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    _be_the_first_to_go()
    leave = os._exit
    _tell_where(stacks)
    from workbench.session.process.heartbeat import HeartbeatWriter

    heartbeat = HeartbeatWriter(heartbeat_fd)
    heartbeat.begin("starting")
    from workbench.machine.processes.breakpoints import OPEN_WITH_DEBUG, pass_breakpoints, refuse_breakpoints

    if niceness:  # it works in the background, with a version that is being debugged elsewhere
        pass_breakpoints()
    else:
        refuse_breakpoints(OPEN_WITH_DEBUG)
    code = 0
    try:
        with quick_imports():
            from workbench.session.worker.loop import work

        work(connection, heartbeat)
    except BaseException:
        traceback.print_exc()
        code = 1
    # Else the interpreter would wait for threads of the task, and the page for a process that answers nothing.
    others = [thread for thread in threading.enumerate() if thread is not threading.main_thread()]
    if code or not all(thread.daemon for thread in others):
        try:
            sys.stdout.flush()
            sys.stderr.flush()
        finally:  # the task may have closed them
            leave(code)


def _be_the_first_to_go() -> None:
    """When memory runs out the kernel ends the process with the highest score: not the page's, ours."""
    try:
        Path("/proc/self/oom_score_adj").write_text("1000")
    except OSError:
        pass  # a sandbox may forbid it; the server watches over the memory as well


def _tell_where(stacks: int) -> None:
    """Write the stack into the file `stacks`: at a crash, when the server asks, and when the code leaves."""
    from workbench.session.process.heartbeat import INTERRUPT_SIGNAL, STACK_SIGNAL

    faulthandler.enable(file=stacks, all_threads=False)
    faulthandler.register(STACK_SIGNAL, file=stacks, all_threads=False)
    # Until the worker takes it up there is nothing to interrupt, and its default would end us.
    signal.signal(INTERRUPT_SIGNAL, signal.SIG_IGN)
    leave, us = os._exit, os.getpid()

    def leave_with_words(code: int) -> NoReturn:
        # The one way out that tells nobody: no exception, no handler, only an exit code.
        if os.getpid() == us:  # not in a process that the author's code forked
            os.write(stacks, f"os._exit({code})\n".encode())
            faulthandler.dump_traceback(file=stacks, all_threads=False)
        leave(code)

    os._exit = leave_with_words


if __name__ == "__main__":
    main()
