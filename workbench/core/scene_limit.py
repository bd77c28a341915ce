"""How many PhysX scenes a process can hold, told before it is too late.

Each PhysX scene takes one of the process's thread-local keys (``PxTlsAlloc`` in PhysX's NpScene), of which Linux
has 1024 (``PTHREAD_KEYS_MAX``); some twenty are taken once SAPIEN and torch are imported. Who takes the last one
kills the process in native code, at whatever asks for a key next: "Couldn't create autoTSSkey mapping". So
the free keys are counted, by taking all and giving them back, before the scenes of a batch are made.
"""

from __future__ import annotations

import ctypes
import sys

_SPARE = 8
"""For threads, drivers and libraries that start later, and the scene that a restore makes beside the old one."""


def require_scenes(count: int) -> None:
    """Raise if this process cannot hold `count` PhysX scenes more.

    Raises:
        ValueError: says how many it can.
    """
    free = free_thread_keys()
    if free is not None and count > free - _SPARE:
        raise ValueError(
            f"num_envs={count} is more than this process has room for: PhysX takes one of Linux's 1024 thread-local "
            f"keys for each env, and {max(free - _SPARE, 0)} are left here. Use fewer envs, close envs that "
            "are not needed, or divide the envs among processes."
        )


def free_thread_keys() -> int | None:
    """How many more ``pthread_key_create`` would give; None where there is no such limit to find out."""
    if not sys.platform.startswith("linux"):
        return None
    library = ctypes.CDLL(None)
    key, taken = ctypes.c_uint(), []
    while library.pthread_key_create(ctypes.byref(key), None) == 0:
        taken.append(key.value)
    for value in taken:
        library.pthread_key_delete(ctypes.c_uint(value))
    return len(taken)
