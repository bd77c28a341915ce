"""Steps N physics systems on all cores, without the interpreter lock."""

from __future__ import annotations

import ctypes
import os
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache, partial

import sapien
import sapien.physx as physx


class Stepper:
    """Steps N systems lazily: substeps are done when they are needed.

    PickCube-v1, 64 envs, two cores, physics part of a control step of five substeps (all variants give the
    same bits, ``tests/envs/simulation/test_stepping.py``):

        one thread, env after env, substep after substep        24 ms
        two threads                                             14 ms
        one thread, the five substeps of an env in a row        17 ms
        two threads, the five substeps in a row                  9 ms

    *Threads*, not processes: `native_step` releases the interpreter lock, so no system is forked or copied, and a task can
    use its SAPIEN objects directly. One system for all envs with PhysX's own threads would need the envs metres apart, which
    costs float precision.

    *In a row*: a Panda, table and cube touch some hundreds of kB, which a walk through all envs evicts from
    the cache. ManiSkill runs hooks between substeps, so an env's substeps are done in a row only when no hook
    can notice (`merging`).

    The thread that stepped an env also packs its state, while that is in the core's cache (12 us cold, 3 us
    warm).
    """

    def __init__(
        self,
        systems: Sequence[physx.PhysxCpuSystem],
        scenes: Sequence[sapien.Scene],
        threads: int | None = None,
    ) -> None:
        """
        Args:
            threads: maximum number of threads; None for one on each core that this process may use.
        """
        self._systems, self._scenes = systems, scenes
        self.threads = 1 if native_step() is None else (threads or usable_cores())
        self.step_once: list[Callable[[], None]] = [*map(_step_of, systems)]
        self._owed = 0
        self._in_a_row = 1
        self._writes: list[Callable[[int], None]] = []
        self._packs: list[bytes | None] = [None] * len(systems)
        self._pose_packs: list[bytes | None] = [None] * len(systems)
        self.frozen: frozenset[int] = frozenset()
        """Envs that are neither stepped nor given drive targets."""

    def renew(self, env: int) -> None:
        """Use the env's new system; call it after the system was replaced in the list."""
        self.step_once[env] = _step_of(self._systems[env])
        self.forget()

    @property
    def owes(self) -> bool:
        """Whether substeps are pending."""
        return self._owed > 0

    def step(self) -> bool:
        """Make one substep in every env; False if it is deferred to the last substep of the control step."""
        self._owed += 1
        if self._owed < self._in_a_row:
            return False
        self.catch_up()
        return True

    @contextmanager
    def merging(self, substeps: int) -> Iterator[None]:
        """Context that does `substeps` calls of `step` together: at the last call, or earlier if state is
        read."""
        self._in_a_row = substeps
        try:
            yield
        finally:
            self._in_a_row = 1

    def write_before_step(self, write: Callable[[int], None]) -> None:
        """Call ``write(env)`` for each env before its next substep, in the thread that steps the env; or
        before its state is packed, if that is earlier."""
        self._writes.append(write)

    def write_now(self) -> None:
        """Do the pending writes."""
        writes, self._writes = self._writes, []
        for env in range(len(self._systems)) if writes else ():
            for write in writes if env not in self.frozen else ():
                write(env)
            self._packs[env] = None

    def catch_up(self) -> None:
        """Do the pending substeps."""
        count, self._owed = self._owed, 0
        if count == 0:
            return
        writes, self._writes = self._writes, []
        packs: list[bytes] = [b""] * len(self._systems)
        pose_packs: list[bytes] = [b""] * len(self._systems)
        # No fetch follows a single substep within a control step, so packing would be wasted.
        packing = count > 1

        def advance(env: int) -> None:
            if env not in self.frozen:
                for write in writes:
                    write(env)
                step = self.step_once[env]
                for _ in range(count):
                    step()
            if packing:
                packs[env] = self._systems[env].pack()
                pose_packs[env] = self._scenes[env].pack_poses()

        env_threads().run(advance, len(self._systems), self.threads)
        count = len(packs)
        self._packs = [*packs] if packing else [None] * count
        self._pose_packs = [*pose_packs] if packing else [None] * count

    def forget(self, envs: Iterable[int] | None = None) -> None:
        """Drop the packs of these envs (None: of all) after a write to the simulation."""
        self.write_now()
        for env in range(len(self._systems)) if envs is None else envs:
            self._packs[env] = self._pose_packs[env] = None

    def packs(self) -> list[bytes]:
        """``pack()`` of the present state of every system."""
        self.write_now()
        made = [
            system.pack() if pack is None else pack
            for system, pack in zip(self._systems, self._packs, strict=True)
        ]
        self._packs = [*made]
        return made

    def pose_packs(self) -> list[bytes]:
        """``pack_poses()`` of the present state of every scene."""
        made = [
            scene.pack_poses() if pack is None else pack
            for scene, pack in zip(self._scenes, self._pose_packs, strict=True)
        ]
        self._pose_packs = [*made]
        return made


def _step_of(system: physx.PhysxCpuSystem) -> Callable[[], None]:
    native = native_step()
    return system.step if native is None else partial(native.call, native.address_of(system))


# --- PhysX's step of one CPU system, called without holding Python's interpreter lock ---------


LIBRARY = "libsapien.so"
STEP = "_ZN6sapien5physx14PhysxSystemCpu4stepEv"
"""``sapien::physx::PhysxSystemCpu::step()``."""
TYPE_INFO = "_ZTIN6sapien5physx14PhysxSystemCpuE"
"""``typeid(sapien::physx::PhysxSystemCpu)``."""
CONDUIT = "_pybind11_conduit_v1_"
PLATFORM_ABI = b"system_libstdcpp_gxx_abi_1xxx_use_cxx11_abi_1"
"""ABI of SAPIEN's wheels for Linux, as pybind11 spells it."""


@dataclass(frozen=True)
class NativeStep:
    """The C++ method behind ``PhysxCpuSystem.step()``, and the means to find the address of its object.

    ``step()`` holds the interpreter lock, so threads over independent systems gain nothing. SAPIEN's shared
    library exports the C++ method, and ctypes releases the lock while it runs: the same code on the same
    object. The object's address comes from ``_pybind11_conduit_v1_`` (pybind11 2.14, "Allowing extensions of
    one binding to use another's objects"), which checks ABI and C++ type. The exported names are those of
    sapien 3.0.3 on Linux (``tests/envs/simulation/test_native_step.py``). If one is missing, `why_not_native`
    names it, and SAPIEN's own binding steps the systems one after the other.
    """

    call: Callable[[int], None]
    """Steps the system at this address once; the interpreter lock is released while it runs."""
    type_capsule: object

    def address_of(self, system: physx.PhysxCpuSystem) -> int:
        """Address of the C++ object of `system`, valid while `system` lives."""
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
    """The step without the interpreter lock, or None if SAPIEN's build does not offer it."""
    found = _find()
    return found if isinstance(found, NativeStep) else None


def why_not_native() -> str | None:
    """Why `native_step` does not work, in one sentence; None if it works."""
    found = _find()
    return found if isinstance(found, str) else None


@lru_cache(maxsize=1)
def _find() -> NativeStep | str:
    version = f"sapien {sapien.__version__}"
    try:
        # Use only the copy that pysapien has loaded: another would have its own PhysX.
        library = ctypes.CDLL(LIBRARY, mode=os.RTLD_NOLOAD | os.RTLD_NOW)
        step = library[STEP]
        type_info = ctypes.addressof(ctypes.c_char.in_dll(library, TYPE_INFO))
    except (OSError, AttributeError, ValueError) as error:
        return f"{version} does not export the names that a step without the interpreter lock needs: {error}"
    step.argtypes, step.restype = [ctypes.c_void_p], None
    new = ctypes.pythonapi.PyCapsule_New
    new.restype, new.argtypes = ctypes.py_object, [ctypes.c_void_p, ctypes.c_char_p, ctypes.c_void_p]
    native = NativeStep(step, new(type_info, _CAPSULE_NAME, None))
    try:
        native.address_of(physx.PhysxCpuSystem())
    except (AttributeError, RuntimeError) as error:
        return f"{version} does not give the addresses of its systems: {error}"
    return native


_CAPSULE_NAME = ctypes.c_char_p(b"St9type_info")
"""``typeid(std::type_info).name()``; a capsule keeps a pointer to its name, so this must not be collected."""


# --- threads that take envs off one list, kept for the life of the process --------------------


def usable_cores() -> int:
    """Number of cores that this process may run on."""
    return len(os.sched_getaffinity(0))


class EnvThreads:
    """Thread pool for one `run` at a time.

    Envs take unequal time, so all threads, including the caller's, take the next env from one iterator; ``next`` on a list
    iterator is atomic under the interpreter lock. (16 Pandas on two cores: 2.6 ms; with a ``concurrent.futures`` executor of
    two threads 4.0 ms, in one thread 4.8 ms.)
    """

    def __init__(self) -> None:
        self._busy = threading.Lock()
        self._helpers: list[_Helper] = []

    def run(self, job: Callable[[int], None], count: int, threads: int) -> None:
        """Run ``job(0)`` to ``job(count - 1)``, each once, on up to `threads` threads; the caller is one of them.

        Raises:
            Exception: the first exception of a job, after all threads have stopped.
        """
        todo = iter(range(count))
        helpers = min(threads, count) - 1
        if helpers <= 0:
            for index in todo:
                job(index)
            return
        working: list[_Helper] = []
        with self._busy:
            # An interrupted run (RecursionError, KeyboardInterrupt) drops its helpers: their state is
            # unknown.
            every, self._helpers = self._helpers, []
            try:
                while len(every) < helpers:
                    every.append(_Helper())
                for helper in every[:helpers]:
                    helper.begin(job, todo)
                    working.append(helper)
                for index in todo:
                    job(index)
            finally:
                # Wait even after an exception in this thread: the helpers still use objects of the caller.
                errors = [helper.end() for helper in working]
            self._helpers = every
        for error in errors:
            if error is not None:
                raise error


class _Helper:
    def __init__(self) -> None:
        self._go, self._done = threading.Lock(), threading.Lock()
        self._go.acquire()
        self._done.acquire()
        self._job: Callable[[int], None] | None = None
        self._todo: Iterator[int] = iter(())
        self._error: BaseException | None = None
        # A daemon thread, so that it does not keep the interpreter alive.
        threading.Thread(target=self._work, name="env-step", daemon=True).start()

    def begin(self, job: Callable[[int], None], todo: Iterator[int]) -> None:
        self._job, self._todo, self._error = job, todo, None
        self._go.release()

    def end(self) -> BaseException | None:
        self._done.acquire()
        self._job = None  # the job holds the env, which must not be kept alive here
        return self._error

    def _work(self) -> None:
        while True:
            self._go.acquire()
            job = self._job
            assert job is not None, "begin() sets the job before it releases the thread"
            try:
                for index in self._todo:
                    job(index)
            except BaseException as error:
                self._error = error
            del job
            self._done.release()


_shared = EnvThreads()


def env_threads() -> EnvThreads:
    """The threads of this process."""
    return _shared


def _after_fork() -> None:
    # Threads do not survive a fork: the child would wait for them without end.
    global _shared
    _shared = EnvThreads()


os.register_at_fork(after_in_child=_after_fork)
