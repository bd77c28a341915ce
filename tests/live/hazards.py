"""A task that harms its process in a chosen way, in a chosen hook."""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np

from tests.drive.session import TASKS
from workbench.envs.step_result import StepResult
from workbench.machine.processes.wire import pack, pack_message
from workbench.task.description import Stepped

_MISCHIEF = """
import ctypes as _ctypes, os as _os, signal as _signal, socket as _socket, sys as _sys, threading as _threading, time as _time
from pathlib import Path as _Path


def _raise_enough(*_):
    raise ValueError("enough")


def _line_to_server():
    for name in sorted(_os.listdir("/proc/self/fd"), key=int):
        try:
            end = _socket.socket(fileno=_os.dup(int(name)))
        except OSError:
            continue  # no socket
        with end:
            if (end.family, end.type) == (_socket.AF_UNIX, _socket.SOCK_STREAM):
                return int(name)
    raise AssertionError("there is no line to the server")


def hazard(place):
    file = _Path(__file__).with_name("hazard")
    if not file.exists():
        return
    wanted, what = file.read_text().split()
    if wanted != place:
        return
    file.with_name("provoked").touch()
    if what == "loop":
        while True:
            pass
    if what == "catch":
        while True:
            try:
                _time.sleep(0.05)
            except BaseException:
                pass
    if what == "native":
        sum(range(10**15))  # one loop in C, days long
    if what == "slow":
        for _ in range(100):
            _time.sleep(0.1)
            if not file.exists():
                return
    if what == "exit":
        _os._exit(3)
    if what == "leave":
        _sys.exit("enough")
    if what == "segfault":
        _ctypes.string_at(0)
    if what == "abort":
        _os.abort()
    if what == "kill":
        _os.kill(_os.getpid(), _signal.SIGKILL)
    if what == "memory":
        eaten = []
        while True:
            eaten.append(b"x" * 2**24)
    if what == "children":
        if _os.fork() == 0:
            _time.sleep(3600)
        _os.kill(_os.getpid(), _signal.SIGKILL)
    if what in ("garbage", "detach"):
        if _os.fork() == 0:
            _os.setsid()
            if _os.fork() == 0:
                _os.execve("/bin/sleep", ["innocent", "3600"], {})
            _os._exit(0)
        _os.wait()
    if what == "detach":
        _os.kill(_os.getpid(), _signal.SIGKILL)
    if what == "garbage":
        _os.write(_line_to_server(), b"print(1)\\n")
        _time.sleep(3600)
    if what == "wrong":
        raw = @WRONG@
        _os.write(_line_to_server(), len(raw).to_bytes(4, "big") + raw)
        _time.sleep(3600)
    if what == "misfit":
        raw = @MISFIT@
        _os.write(_line_to_server(), len(raw).to_bytes(4, "big") + raw)
        _time.sleep(3600)
    if what == "half":
        _os.write(_line_to_server(), b"\\0\\0\\1\\0abc")
        while True:
            pass
    if what == "headless":
        _threading.Thread(target=_time.sleep, args=(3600,)).start()
        _ctypes.CDLL(None).pthread_exit(None)
    if what == "thread":
        _threading.Thread(target=_time.sleep, args=(3600,)).start()
        # Raises wherever the main thread is by then: outside of every hook.
        _signal.signal(_signal.SIGALRM, _raise_enough)
        _signal.setitimer(_signal.ITIMER_REAL, 0.5)
    if what == "ctrl_c":
        raise KeyboardInterrupt
    if what == "interrupt_main":
        _signal.raise_signal(_signal.SIGINT)
    if what == "own_base":
        raise GeneratorExit("of this")
    if what == "chdir":
        _os.chdir("/")
        file.unlink()
    if what == "flood":
        block = "all work and no play " * 50 + "\\n"
        for _ in range(20_000):
            print(block * 10, end="")
        file.unlink()
    if what == "read":
        input("your name? ")


"""
# Literals: code that imports pickle can reach anything, so a change to it is never applied as a patch.
_NOTHING: Any = np.zeros(0)
_MISFIT = Stepped(StepResult(_NOTHING, _NOTHING, _NOTHING, _NOTHING, {}, _NOTHING), _NOTHING)
for _place, _message in (("@WRONG@", pack(("dict", None, {}))), ("@MISFIT@", pack_message(_MISFIT))):
    _MISCHIEF = _MISCHIEF.replace(_place, repr(_message))
_HOOKS = {
    "build": "        build_ground(self.scene)\n",
    "reset": '        self.agent.reset(self.agent.keyframes["rest"].qpos)\n',
    "evaluate": '        return {"success"',
}


def line_of(file: Path, code: str) -> int:
    """1-based number of the only line of `file` that is `code`."""
    (number,) = [n for n, line in enumerate(file.read_text().splitlines(), 1) if line.strip() == code]
    return number


def write_task(folder: Path) -> Path:
    """``tasks/minimal.py`` with a hazard in each hook; none acts until `provoke`."""
    file = Path(shutil.copy(TASKS / "minimal.py", folder / "risky.py"))
    text = file.read_text()
    for place, line in _HOOKS.items():
        assert text.count(line) == 1
        text = text.replace(line, f'        hazard("{place}")\n{line}')
    # Part of the scene: an `edit` of it rebuilds the envs.
    text = text.replace('        hazard("build")\n', '        hazard("build")\n        assert VERSION >= 0\n')
    reward = "\n    def compute_sparse_reward(self, obs, action, info):\n"
    reward += '        hazard("reward")\n        return super().compute_sparse_reward(obs, action, info)\n'
    text = text.replace("\n\n# ManiSkill takes", reward + "\n\n# ManiSkill takes")
    before = '@register_env("WorkbenchMinimal'
    text = text.replace(before, f'{_MISCHIEF}hazard("import")\nVERSION = 0\n\n\n{before}')
    file.write_text(text)
    return file


def provocation(file: Path) -> Path:
    """The file whose existence triggers the hazard."""
    return file.with_name("hazard")


def provoke(file: Path, place: str, what: str) -> None:
    """Make the hazard `what` happen in the hook `place` from now on."""
    provocation(file).write_text(f"{place} {what}")


def calm(file: Path) -> None:
    """Stop the hazard."""
    provocation(file).unlink(missing_ok=True)


def provoked(file: Path) -> bool:
    """Whether the hazard has started."""
    return file.with_name("provoked").exists()


def edit(file: Path) -> None:
    """Save a new version with the same behaviour that rebuilds all envs."""
    text = file.read_text()
    number = int(re.findall(r"^VERSION = (\d+)$", text, flags=re.MULTILINE)[0])
    file.write_text(text.replace(f"\nVERSION = {number}\n", f"\nVERSION = {number + 1}\n"))
