"""A worker process without a task, which starts in half a second and does what a test asks of it.

Everything else is real: start-up, keeper, heartbeat, signals and connection. Started like `fork_client`.
"""

from __future__ import annotations

import ctypes
import faulthandler
import multiprocessing.connection
import os
import signal
import sys
import threading
import time
import types
from typing import Any, get_args

from workbench.app.worker.questions import QUESTIONS
from workbench.app.worker.start import main
from workbench.cameras.questions import RunCameras
from workbench.live.messages import Answer, ListenForDebugger, Load, Loaded, Loading, Quit, Request
from workbench.live.process.heartbeat import INTERRUPT_SIGNAL, STACK_SIGNAL, HeartbeatWriter, Interrupts
from workbench.machine.processes.wire import Call, Unpacker, pack_message
from workbench.task.problem import Interrupted


class SmallWorker:
    """Answers `Load` with a `Loading` of its name, and does what a `RunCameras` names as the task."""

    def __init__(self, line: multiprocessing.connection.Connection, heartbeat: HeartbeatWriter) -> None:
        self.line, self.heartbeat = line, heartbeat
        self.unpacker = Unpacker(get_args(Request), QUESTIONS)
        self.interrupts = Interrupts()
        self.interrupts.install()
        self.kept: Any = None

    def run(self) -> None:
        while True:
            self.heartbeat.begin("idle")
            request = self.unpacker.message(self.line.recv_bytes())
            if isinstance(request, Quit):
                return
            if isinstance(request, ListenForDebugger):
                self.line.send_bytes(
                    pack_message(Loading(f"debugger at {request.port}, waits: {request.wait}"))
                )
            if isinstance(request, Call) and isinstance(request.request, RunCameras):
                words = str(request.request.task).partition(" ")
                self.interrupts.begin()
                try:
                    try:
                        self.interrupts.allowed = True
                        self.do(*words)
                    finally:
                        self.interrupts.allowed = False
                except Interrupted:
                    self.line.send_bytes(pack_message(Loading("interrupted")))
            elif isinstance(request, Call):
                self.line.send_bytes(pack_message(Answer(request.number)))
            if isinstance(request, Load):
                self.heartbeat.begin("loading")
                self.line.send_bytes(pack_message(Loading(str(request.task))))

    def do(self, what: str, _: str, argument: str) -> None:
        getattr(self, what)(argument)

    def say(self, text: str) -> None:
        self.line.send_bytes(pack_message(Loading(text)))

    def loaded(self, _: str) -> None:
        # Imported here: it takes more than a second, and few workers need it.
        from tests.drive.scenes import description, step_of, table_scene

        geometry, poses = table_scene(1)
        self.line.send_bytes(pack_message(Loaded(description(geometry, ()), step_of(poses), {})))

    def work(self, seconds: str) -> None:
        """Python code that takes this long and that an interrupt stops."""
        self.heartbeat.begin("stepping")
        self._pass_time(float(seconds))

    def work_on(self, seconds: str) -> None:
        """Python code that no interrupt stops."""
        signal.signal(INTERRUPT_SIGNAL, signal.SIG_IGN)
        self.work(seconds)

    def without_handlers(self, seconds: str) -> None:
        """Run without signal handlers, as at interpreter shutdown."""
        faulthandler.unregister(STACK_SIGNAL)
        self.work(seconds)

    def held_by_a_debugger(self, seconds: str) -> None:
        self.heartbeat.begin("stepping")
        self.heartbeat.hold(True)
        self._pass_time(float(seconds))
        self.heartbeat.hold(False)

    def draw(self, seconds: str) -> None:
        self.heartbeat.begin("drawing")
        self._pass_time(float(seconds))

    def last_steps(self, count: str) -> None:
        """Send all steps at once; then the kernel kills the process."""
        for number in range(int(count)):
            self.line.send_bytes(pack_message(Loading(f"step {number}")))
        os.kill(os.getpid(), signal.SIGKILL)

    def chatter(self, _: str) -> None:
        """Send as fast as possible, in messages whose end often arrives separately."""
        number = 0
        while True:
            number += 1
            self.say(f"{number} " + "x" * 20_000)

    def close_its_line(self, seconds: str) -> None:
        self.line.close()
        self.work(seconds)

    def leave(self, code: str) -> None:
        self.heartbeat.begin("stepping")
        os._exit(int(code))

    def fill_memory(self, megabytes: str) -> None:
        self.kept = bytearray(int(megabytes) << 20)

    def nonsense(self, text: str) -> None:
        self.line.send_bytes(pack_message(text))

    def without_a_main_thread(self, seconds: str) -> None:
        threading.Thread(target=time.sleep, args=(float(seconds),), daemon=False).start()
        ctypes.CDLL(None).pthread_exit(None)

    def ends_soon_without_a_main_thread(self, seconds: str) -> None:
        def end() -> None:
            time.sleep(float(seconds))
            os._exit(7)

        threading.Thread(target=end).start()
        ctypes.CDLL(None).pthread_exit(None)

    def _pass_time(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            time.sleep(0.005)


if __name__ == "__main__":
    instead: Any = types.ModuleType("workbench.app.worker.main_loop")
    instead.work = lambda fd, heartbeat: SmallWorker(
        multiprocessing.connection.Connection(fd), heartbeat
    ).run()
    sys.modules["workbench.app.worker.main_loop"] = instead
    main()
