"""Settings of the whole process that a task may change and that no reload undoes."""

from __future__ import annotations

import os
import resource
import signal
import sys
import threading
import types
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from workbench.machine.processes.debugger import may_be_debugged

_MODULES = (
    *("torch", "torch.nn.functional", "numpy", "numpy.random", "random", "time", "math", "os", "builtins"),
    *("mani_skill.envs.sapien_env", "mani_skill.utils.common", "mani_skill.utils.sapien_utils", "sapien"),
)
"""Modules whose functions are compared: a task may have replaced one of these functions."""
_FUNCTIONS = (types.FunctionType, types.BuiltinFunctionType)

_TRACED = "sys.settrace()"

ProcessState = Mapping[str, object]


def read_process_state() -> ProcessState:
    """The present settings by name. Takes some milliseconds. `changed_settings` compares two states."""
    state: dict[str, object] = {
        "torch.get_default_dtype()": torch.get_default_dtype(),
        "torch.get_default_device()": torch.get_default_device(),
        "torch.is_grad_enabled()": torch.is_grad_enabled(),
        "torch.are_deterministic_algorithms_enabled()": torch.are_deterministic_algorithms_enabled(),
        "torch.get_num_threads()": torch.get_num_threads(),
        "numpy.geterr()": np.geterr(),
        "os.umask()": _umask(),
    }
    state |= {f"os.environ[{name!r}]": value for name, value in os.environ.items()}
    state |= {f"signal handler of {number.name}": signal.getsignal(number) for number in signal.Signals}
    state |= {
        f"resource.{name}": resource.getrlimit(getattr(resource, name))
        for name in dir(resource)
        if name.startswith("RLIMIT_")
    }
    state |= {"sys.excepthook": sys.excepthook, _TRACED: sys.gettrace() is not None}
    for module in _MODULES:
        members = vars(sys.modules[module]) if module in sys.modules else {}
        for name, value in members.items():
            if isinstance(value, _FUNCTIONS):
                state[f"{module}.{name}"] = value
    return state


def changed_settings(before: ProcessState, now: ProcessState) -> list[str]:
    """Names of settings that were changed or removed, and of environment variables that were added."""
    if may_be_debugged():
        # A debugger replaces functions of Python by its own, some when it attaches.
        before = {
            name: value
            for name, value in before.items()
            if name != _TRACED and not isinstance(value, _FUNCTIONS)
        }
    found = [name for name, value in before.items() if name not in now or now[name] != value]
    return found + [name for name in now if name not in before and name.startswith("os.environ")]


def some_of(names: list[str]) -> str:
    """The first two names and the number of the others, as part of a sentence."""
    more = f" and {len(names) - 2} more" if len(names) > 2 else ""
    return ", ".join(names[:2]) + more


def threads_of(files: Mapping[str, Any]) -> list[str]:
    """Names of the threads, other than the main one, that run code of these files."""
    frames = sys._current_frames()
    found = []
    for thread in threading.enumerate():
        frame = frames.get(thread.ident or 0)
        while frame is not None and thread is not threading.main_thread():
            if frame.f_code.co_filename in files:
                found.append(f"the thread {thread.name}")
                break
            frame = frame.f_back
    return found


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
