"""PhysX's step of one CPU system, called without holding Python's interpreter lock.

``PhysxCpuSystem.step()`` keeps the lock for as long as it runs: a second Python thread makes no
progress, so threads over N systems gain nothing. The systems themselves are independent, and PhysX allows
scenes to be simulated at once from several threads. What stands in between is only the binding, so it is
passed by: SAPIEN's shared library exports the C++ method behind ``step()``, and ctypes gives the lock
back while it runs. The bits are those of ``step()``, since it is the same code on the same object.

The address of the C++ object comes from pybind11's own door for other libraries,
``_pybind11_conduit_v1_`` (pybind11 2.14, "Allowing extensions of one binding to use another's objects"),
which checks the ABI and the C++ type and gives nothing when either differs. The exported names are those
of sapien 3.0.3 on Linux; ``tests/core/test_native_step.py`` names each of them. Where one is missing,
`why_not_native` says which, and the systems are stepped by SAPIEN's own binding, one after the other.
"""

from __future__ import annotations

import ctypes
import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import sapien
import sapien.physx as physx

LIBRARY = "libsapien.so"
STEP = "_ZN6sapien5physx14PhysxSystemCpu4stepEv"
"""``sapien::physx::PhysxSystemCpu::step()``."""
TYPE_INFO = "_ZTIN6sapien5physx14PhysxSystemCpuE"
"""``typeid(sapien::physx::PhysxSystemCpu)``."""
CONDUIT = "_pybind11_conduit_v1_"
PLATFORM_ABI = b"system_libstdcpp_gxx_abi_1xxx_use_cxx11_abi_1"
"""What SAPIEN's wheels for Linux were built with, as pybind11 spells it."""


@dataclass(frozen=True)
class NativeStep:
    """The C++ method, and what is needed to find the object to call it on."""

    call: Callable[[int], None]
    """Steps the system at this address once; the interpreter lock is free while it runs."""
    type_capsule: object

    def address_of(self, system: physx.PhysxCpuSystem) -> int:
        """Where the C++ object of `system` lies; good for as long as `system` lives."""
        capsule = getattr(system, CONDUIT)(PLATFORM_ABI, self.type_capsule, b"raw_pointer_ephemeral")
        if capsule is None:
            raise RuntimeError(f"pybind11 gives no pointer to a PhysxCpuSystem for ABI {PLATFORM_ABI!r}")
        name = ctypes.pythonapi.PyCapsule_GetName
        pointer = ctypes.pythonapi.PyCapsule_GetPointer
        name.restype, name.argtypes = ctypes.c_char_p, [ctypes.py_object]
        pointer.restype, pointer.argtypes = ctypes.c_void_p, [ctypes.py_object, ctypes.c_char_p]
        return pointer(capsule, name(capsule))


@lru_cache(maxsize=1)
def native_step() -> NativeStep | None:
    """The step without the interpreter lock, or None where SAPIEN is built otherwise."""
    found = _find()
    return found if isinstance(found, NativeStep) else None


def why_not_native() -> str | None:
    """One sentence, or None when `native_step` works."""
    found = _find()
    return found if isinstance(found, str) else None


@lru_cache(maxsize=1)
def _find() -> NativeStep | str:
    version = f"sapien {sapien.__version__}"
    try:
        # Only the copy that pysapien has loaded already: another would have its own PhysX.
        library = ctypes.CDLL(LIBRARY, mode=os.RTLD_NOLOAD | os.RTLD_NOW)
        step = library[STEP]
        type_info = ctypes.addressof(ctypes.c_char.in_dll(library, TYPE_INFO))
    except (OSError, AttributeError, ValueError) as error:
        return f"{version} does not export what a step beside the interpreter lock needs: {error}"
    step.argtypes, step.restype = [ctypes.c_void_p], None
    new = ctypes.pythonapi.PyCapsule_New
    new.restype, new.argtypes = ctypes.py_object, [ctypes.c_void_p, ctypes.c_char_p, ctypes.c_void_p]
    native = NativeStep(step, new(type_info, _CAPSULE_NAME, None))
    try:
        native.address_of(physx.PhysxCpuSystem())
    except (AttributeError, RuntimeError) as error:
        return f"{version} does not show where its systems lie: {error}"
    return native


_CAPSULE_NAME = ctypes.c_char_p(b"St9type_info")
"""``typeid(std::type_info).name()``; a capsule keeps the pointer to its name, so this must not be collected."""
