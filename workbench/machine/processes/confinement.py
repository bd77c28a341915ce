"""Confines a process that reads untrusted files (Landlock and resource limits)."""

from __future__ import annotations

import ctypes
import os
import resource
import site
import sys
from collections.abc import Iterable
from pathlib import Path

_CREATE_RULESET, _ADD_RULE, _RESTRICT_SELF = 444, 445, 446
_ASK_VERSION = 1
_PATH_BENEATH = 1
_EXECUTE, _WRITE_FILE, _READ_FILE, _READ_DIR = 1 << 0, 1 << 1, 1 << 2, 1 << 3
_FILE_RIGHTS = {1: (1 << 13) - 1, 2: 1 << 13, 3: 1 << 14, 5: 1 << 15}
"""File rights that each version of Landlock adds. `confine` takes all of them away, except where a path is
allowed."""
_FILE_ONLY_RIGHTS = _EXECUTE | _WRITE_FILE | _READ_FILE
"""Rights that apply to files that are not folders."""
_TCP_RIGHTS = 0b11
"""Rights to bind and to connect, from version 4 on."""
_SCOPES = 0b11
"""Scopes, from version 6 on: they forbid connections to abstract sockets of other processes, and signals to
these processes."""
_PR_SET_NO_NEW_PRIVS = 38
_SYSTEM_PATHS = ("/usr", "/lib", "/lib64", "/nix/store", "/gnu/store", "/etc/ld.so.cache", "/etc/localtime",
           "/proc/self", "/proc/cpuinfo", "/proc/meminfo", "/proc/sys", "/sys/devices/system", "/dev/urandom")  # fmt: skip
MAX_WRITTEN_BYTES = 1 << 20
"""Maximum size of a file that a process can write if `confine` was called without `writes`; enforced even
without Landlock."""
MAX_OPEN_FILES = 512


def landlock_version() -> int:
    """Version of Landlock in this kernel; 0 if the kernel has none, or Landlock is turned off.

    Uses system calls, since libc has no functions for Landlock (``include/uapi/linux/landlock.h``).
    """
    return max(_call(_CREATE_RULESET, None, 0, _ASK_VERSION), 0)


def confine(reads: Iterable[Path], most_memory: int, writes: Iterable[Path] = ()) -> None:
    """Restrict this process and its children: they can read only programs, libraries, and what is below
    `reads`.

    They can write only below `writes`, open no TCP connection, signal no outside process, and gain no rights
    from programs that they start. A kernel without Landlock enforces only that they gain no rights, and the
    limits on memory, open files and (without `writes`) file size.

    Args:
        most_memory: maximum bytes that may be allocated.
    """
    writes = tuple(writes)
    resource.setrlimit(resource.RLIMIT_DATA, (most_memory, most_memory))
    if not writes:
        resource.setrlimit(resource.RLIMIT_FSIZE, (MAX_WRITTEN_BYTES, MAX_WRITTEN_BYTES))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    most = min(MAX_OPEN_FILES, resource.getrlimit(resource.RLIMIT_NOFILE)[1])
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))
    ctypes.CDLL(None).prctl(_PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0)
    if landlock_version():
        _restrict(tuple(reads), writes)


def _restrict(reads: tuple[Path, ...], writes: tuple[Path, ...]) -> None:
    version = landlock_version()
    rights = sum(bits for since, bits in _FILE_RIGHTS.items() if since <= version)
    wanted = [rights, _TCP_RIGHTS if version >= 4 else 0, _SCOPES if version >= 6 else 0]
    asked = (ctypes.c_uint64 * 3)(*wanted)
    # The kernel refuses a struct longer than it knows.
    size = 8 * (3 if version >= 6 else 2 if version >= 4 else 1)
    ruleset = _call(_CREATE_RULESET, ctypes.byref(asked), size, 0)
    if ruleset < 0:
        raise OSError(ctypes.get_errno(), "Landlock refused to create a ruleset")
    try:
        read = _READ_FILE | _READ_DIR
        for path in (*_SYSTEM_PATHS, *_python()):
            _allow(ruleset, path, read | _EXECUTE)
        for path in reads:
            _allow(ruleset, os.fspath(path), read)
        for path in writes:
            _allow(ruleset, os.fspath(path), rights & ~_EXECUTE)
        _allow(ruleset, os.devnull, _READ_FILE | _WRITE_FILE)
        if _call(_RESTRICT_SELF, ruleset, 0) < 0:
            raise OSError(ctypes.get_errno(), "Landlock refused to restrict this process")
    finally:
        os.close(ruleset)


def _python() -> set[str]:
    """Folders of this interpreter and its packages."""
    user = [site.getusersitepackages()]
    return {os.path.realpath(path) for path in (sys.prefix, sys.base_prefix, *sys.path, *user) if path}


def _allow(ruleset: int, path: str, rights: int) -> None:
    try:
        place = os.open(path, os.O_PATH | os.O_CLOEXEC)
    except OSError:
        return  # not on this system
    try:
        if not os.path.isdir(path):
            rights &= _FILE_ONLY_RIGHTS
        rule = rights.to_bytes(8, sys.byteorder) + place.to_bytes(4, sys.byteorder, signed=True)
        if _call(_ADD_RULE, ruleset, _PATH_BENEATH, rule, 0) < 0:
            raise OSError(ctypes.get_errno(), f"Landlock refused the rule for {path}")
    finally:
        os.close(place)


def _call(number: int, *arguments: object) -> int:
    if not sys.platform.startswith("linux"):
        return -1
    return ctypes.CDLL(None, use_errno=True).syscall(ctypes.c_long(number), *arguments)
