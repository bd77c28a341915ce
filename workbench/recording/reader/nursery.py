"""The process that readers are made of: it has imported what they need, and has read nothing itself.

Started as ``python -m workbench.recording.reader.nursery SOCKET``, it forks a reader for each folder that somebody
wants to look into. That takes milliseconds where starting Python takes half a second, and a reader that was ended is
replaced as quickly. It has one thread (numpy's threads are turned off in its environment), since a fork takes no other
along, and ends when its socket closes; a reader ends with it.
"""

from __future__ import annotations

import gc
import os
import signal
import socket
import sys
from multiprocessing.connection import Connection

from workbench.jobs.wire import Unpacker, pack
from workbench.machine.confinement import confine, end_with_parent
from workbench.recording.reader.requests import Ended, NewReader
from workbench.recording.reader.serve import serve, warm_up

MOST_MEMORY = 3 << 30
"""Bytes that a reader may allocate; an episode has at most a third of it as numbers."""
LONGEST = 1 << 20


def main() -> None:
    """Entry of the process."""
    control = socket.socket(fileno=int(sys.argv[1]))
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    gc.freeze()
    while True:
        message, fds, _, _ = socket.recv_fds(control, LONGEST, 1)
        if not message:
            return
        wanted = Unpacker().unpack(message, NewReader | Ended)
        if isinstance(wanted, Ended):
            _, status = os.waitpid(wanted.pid, 0)
            control.send(pack(os.waitstatus_to_exitcode(status)))
            continue
        nursery = os.getpid()
        pid = os.fork()
        if pid == 0:
            control.close()
            _be_a_reader(Connection(fds[0]), wanted, nursery)
        os.close(fds[0])
        try:
            os.setpgid(pid, pid)  # whoever ends it ends its group, perhaps before it has come to this itself
        except OSError:
            pass  # it has, or it is gone
        control.send(pack(pid))


def _be_a_reader(connection: Connection, wanted: NewReader, nursery: int) -> None:
    try:
        end_with_parent(nursery)
        os.setpgid(0, 0)
        if wanted.episodes:
            warm_up()
        confine(wanted.paths, MOST_MEMORY)
        serve(connection)
    finally:
        os._exit(0)


if __name__ == "__main__":
    main()
