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

import msgspec

from workbench.machine.confinement import confine, end_with_parent
from workbench.recording.reader.nursery_messages import Ended, NewReader
from workbench.recording.reader.serve import serve, warm_up
from workbench.recording.reader.wire import path_of

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
        wanted = msgspec.msgpack.decode(message, type=NewReader | Ended)
        if isinstance(wanted, Ended):
            _, status = os.waitpid(wanted.pid, 0)
            control.send(msgspec.msgpack.encode(os.waitstatus_to_exitcode(status)))
            continue
        nursery = os.getpid()
        pid = os.fork()
        if pid == 0:
            control.close()
            _be_a_reader(socket.socket(fileno=fds[0]), wanted, nursery)
        os.close(fds[0])
        try:
            os.setpgid(pid, pid)  # whoever ends it ends its group, perhaps before it has come to this itself
        except OSError:
            pass  # it has, or it is gone
        control.send(msgspec.msgpack.encode(pid))


def _be_a_reader(connection: socket.socket, wanted: NewReader, nursery: int) -> None:
    try:
        end_with_parent(nursery)
        os.setpgid(0, 0)
        if wanted.episodes:
            warm_up()
        confine([path_of(path) for path in wanted.paths], MOST_MEMORY)
        serve(connection)
    finally:
        os._exit(0)


if __name__ == "__main__":
    main()
