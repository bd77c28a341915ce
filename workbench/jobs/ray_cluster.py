"""Runs a job's work on a Ray cluster: a running one, or one that is started on this machine.

A worker is a Ray actor that runs the same function as a local process. It sends its messages, packed by
`wire`, to another actor, the broker. The process that deals the chunks polls the broker. So sending a message
never blocks a worker, and the dealing process never loads a pickle that the author's code may have made. When
Ray reports that a worker has ended, the worker's chunk is dealt again.
"""

from __future__ import annotations

import asyncio
import os
import pickle
import platform
import shutil
import tempfile
import time
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil

from workbench.jobs.pack_author_files import WorkerFiles, pack_worker_files, relocated
from workbench.jobs.ray_connection import AUTO, BREAKPOINT, ClusterHealth, ClusterLost, NoCluster, connected
from workbench.jobs.scheduler import NO_LIMIT, Chunk, PoolError, Result, Scheduler, Setup, Update, Work
from workbench.jobs.worker_messages import MESSAGES, ChunkRequest, Listener, Message, WorkerQueue, work_on
from workbench.machine.processes.child_environment import quick_imports
from workbench.machine.processes.debugger import ONE_PROCESS, refuse_breakpoints
from workbench.machine.processes.wire import Unpacker, Unreadable, pack_message
from workbench.machine.versions import package_versions
from workbench.task.problem import TaskError, treat_ctrl_c_as_error

_POLL_SECONDS = 0.1
_ANSWER_SECONDS = 1.0
"""Timeout of a request to the broker, after which the cluster is checked: a broker that has ended never answers."""
_SEND_SECONDS = 1.0
"""Interval at which a worker sends its messages: the broker handles only a few thousand messages per second
from all workers together."""
_END_SECONDS = 120.0
"""Timeout for a stopped worker to write its finished items."""
_EXIT_SECONDS = 10.0
_FOLDER = "workbench-job-"


@dataclass(frozen=True)
class Cluster:
    """An executor whose workers are actors of a Ray cluster."""

    address: str = AUTO
    """Address of a running cluster, ``local`` or ``auto``. ``local`` starts a cluster on this machine; only
    this user can connect to it, and it ends with the job. ``auto`` uses a running cluster; if there is none,
    it does the same as ``local``."""
    workers: int | None = None
    """Number of workers; None for as many as the cluster has room for."""
    cpus_per_worker: float = 1
    gpus_per_worker: float = 0
    on_death: Callable[[str], None] = lambda text: None
    """Called with a sentence when a worker has died and the job continues; see `Listener`."""

    @property
    def is_remote(self) -> bool:
        return True

    def run(self, work: Work[Setup, Result, Update], scheduler: Scheduler[Result, Update]) -> None:
        """Run the work on the cluster; see `Executor.run`.

        Raises:
            NoCluster: no cluster answers, Ray is not installed, or the cluster has no room for a worker.
            PoolError: a machine has other versions of the packages, or the cluster ended; also as in
                `Executor.run`.
            TooMuch: the files for the workers are too large.
        """
        worker_files = pack_worker_files(work.folders, work.files)
        with connected(self.address) as ray:
            try:
                with closing(ClusterHealth()) as health:
                    pool = _ActorPool(ray, self, work, scheduler, worker_files, health)
                    try:
                        pool.serve()
                    finally:
                        pool.end()
            except (ray.exceptions.RayError, ClusterLost) as error:
                # Ray's own message is a traceback: leave it out.
                why = str(error) if isinstance(error, ClusterLost) else f"Ray raised {type(error).__name__}"
                raise PoolError(
                    f"the Ray cluster ended before the job: {why}. Finished results are kept. Start the cluster again "
                    "and repeat this command; with --job FILE it continues after the finished results"
                ) from error


def versions_here() -> dict[str, str]:
    """Versions that must be the same on all machines of a job."""
    return {"Python": ".".join(platform.python_version_tuple()[:2]), **package_versions()}


class OtherVersions(RuntimeError):
    """A machine has other versions of the packages; the message names them."""


# --- where the chunks are dealt ----------------------------------------------------------------------------


@dataclass(eq=False)
class _Started:
    """A worker as the dealing process sees it."""

    handle: Any
    ended: Any
    """Reference that is ready when the actor has ended."""


class _ActorPool:
    """Starts the actors of one run, deals chunks to them, and replaces those that fail."""

    def __init__(
        self,
        ray: Any,
        how: Cluster,
        work: Work[Any, Any, Any],
        scheduler: Scheduler[Any, Any],
        worker_files: WorkerFiles,
        health: ClusterHealth,
    ) -> None:
        self._ray, self._how, self._work, self._scheduler, self._health = ray, how, work, scheduler, health
        self._listener = Listener("a worker", work, scheduler, how.on_death)
        self._read = Unpacker(MESSAGES).message
        self._broker = ray.remote(num_cpus=0)(MessageBroker).remote()
        self._worker_files = ray.put(worker_files)
        self._work_bytes = pickle.dumps((work.run, work.setup))
        self._actor = ray.remote(
            num_cpus=how.cpus_per_worker, num_gpus=how.gpus_per_worker, max_restarts=0, max_task_retries=0
        )(RayWorker)
        self._busy: dict[int, _Started] = {}
        self._ending: list[_Started] = []
        """Workers that have sent their last message. Each is killed as soon as it has removed its folder."""
        self._started = 0

    def serve(self) -> None:
        for _ in range(self._scheduler.count_left(self._how.workers or self._room())):
            self._start()
        sent_limit, stopped = self._scheduler.limit(), 0.0
        failure: TaskError | PoolError | None = None
        while self._busy:
            self._health.check()
            if (limit := self._scheduler.limit()) != sent_limit:
                sent_limit = limit
                self._broker.set_limit.remote(limit)
            if limit == 0:
                stopped = stopped or time.monotonic()
                if time.monotonic() - stopped > _END_SECONDS:
                    raise failure or PoolError(f"a worker {self._work.name} did not end in time")
            for number, raw in self._messages(_POLL_SECONDS):
                failure = self._guarded(
                    number, failure, lambda raw=raw, number=number: self._take(number, raw)
                )
            self._reap()
            for number in self._gone():
                failure = self._guarded(number, failure, lambda number=number: self._died(number))
            if not self._busy and self._scheduler.count_left(1):
                self._start()
        if failure is not None:
            raise failure

    def end(self) -> None:
        """Wait until finished actors end, and kill the others at once: these may hang after a second
        Ctrl-C."""
        if self._ending:
            ended = [actor.ended for actor in self._ending]
            self._ray.wait(ended, num_returns=len(ended), timeout=_EXIT_SECONDS)
        for actor in (*self._busy.values(), *self._ending):
            self._ray.kill(actor.handle)
        self._ray.kill(self._broker)

    def _messages(self, seconds: float) -> list[tuple[int, bytes]]:
        """Messages of the workers since the last call; see `MessageBroker.take`. Raises ClusterLost."""
        reply = self._broker.take.remote(seconds)
        while not self._ray.wait([reply], timeout=_ANSWER_SECONDS)[0]:
            self._health.check()
        return self._ray.get(reply)

    def _reap(self) -> None:
        """End the actors that have removed their folders: an actor keeps its cores until it ends."""
        if not self._ending:
            return
        ended = [actor.ended for actor in self._ending]
        ready, _ = self._ray.wait(ended, num_returns=len(ended), timeout=0)
        for actor in [actor for actor in self._ending if actor.ended in ready]:
            self._ray.kill(actor.handle)
            self._ending.remove(actor)

    def _guarded(self, number: int, failure: Any, act: Any) -> Any:
        """Call `act` for a worker. If `act` raises an error that ends the job, kill this worker and stop the
        others. Returns `failure` if it is not None, else the error of `act` (None if it raised none)."""
        try:
            act()
        except (TaskError, PoolError) as error:
            self._leave(number)
            self._scheduler.lower(0)
            return failure or error
        return failure

    def _room(self) -> int:
        """Number of workers that the cluster has room for.

        Raises:
            NoCluster: there is no room for a single worker.
        """
        asked = {"CPU": self._how.cpus_per_worker, "GPU": self._how.gpus_per_worker}
        rooms = [
            min(int(node["Resources"].get(name, 0) // count) for name, count in asked.items() if count > 0)
            for node in self._ray.nodes()
            if node["Alive"]
        ]
        if not sum(rooms):
            needs = ", ".join(f"{count:g} {name}" for name, count in asked.items() if count > 0)
            raise NoCluster(f"a worker needs {needs}, and no machine of the cluster has that")
        return sum(rooms)

    def _start(self) -> None:
        number = self._started
        self._started += 1
        handle = self._actor.remote(self._broker, number, self._how.cpus_per_worker)
        ended = handle.run.remote(self._work_bytes, self._worker_files, versions_here())
        self._busy[number] = _Started(handle, ended)

    def _leave(self, number: int) -> None:
        if (actor := self._busy.pop(number, None)) is not None:
            self._ray.kill(actor.handle)

    def _take(self, number: int, raw: bytes) -> None:
        if number not in self._busy:
            return  # a late message of a worker whose chunk was dealt again
        try:
            outcome = self._listener.take(number, self._read(raw))
        except Unreadable as error:
            raise PoolError(f"a worker {self._work.name} sent an unreadable message ({error})") from error
        if outcome == "asks":
            self._broker.answer.remote(number, self._scheduler.next(number))
        elif outcome in ("failed", "done"):
            self._ending.append(self._busy.pop(number))
            if outcome == "failed" and self._scheduler.count_left(1):
                self._start()

    def _gone(self) -> list[int]:
        """Workers whose actor has ended."""
        by_ref = {actor.ended: number for number, actor in self._busy.items()}
        ready, _ = self._ray.wait(list(by_ref), num_returns=len(by_ref), timeout=0) if by_ref else ([], [])
        return [by_ref[ref] for ref in ready]

    def _died(self, number: int) -> None:
        """Read the last messages of the worker, and handle its end.

        Raises:
            TaskError, PoolError: the job is over.
        """
        for one, raw in self._messages(0.0):
            self._take(one, raw)
        actor = self._busy.get(number)
        if actor is None:
            return
        how = "ended without a message"
        try:
            self._ray.get(actor.ended)
        except self._ray.exceptions.RayTaskError as error:
            cause = error.cause if isinstance(error.cause, Exception) else error
            self._leave(number)
            raise PoolError(str(cause)) from error
        except self._ray.exceptions.RayError as error:
            how = f"has ended ({type(error).__name__})"
        self._leave(number)
        self._listener.died(number, how, None)
        if self._scheduler.count_left(1):
            self._start()


class MessageBroker:
    """Actor that passes messages between the workers and the dealing process. It keeps messages until they are taken."""

    def __init__(self) -> None:
        self._messages: deque[tuple[int, bytes]] = deque()
        self._came = asyncio.Event()
        self._answers: dict[int, asyncio.Future[Chunk | None]] = {}
        self._limit = NO_LIMIT

    async def put(self, worker: int, messages: list[bytes]) -> int:
        """Store messages of a worker; returns the scheduler's limit (`ItemQueue.limit`)."""
        self._messages.extend((worker, message) for message in messages)
        self._came.set()
        return self._limit

    async def ask(self, worker: int, messages: list[bytes]) -> tuple[Chunk | None, int]:
        """Store messages, the last of which requests a chunk; returns this chunk and the scheduler's
        limit."""
        future: asyncio.Future[Chunk | None] = asyncio.get_running_loop().create_future()
        self._answers[worker] = future
        await self.put(worker, messages)
        return await future, self._limit

    async def answer(self, worker: int, chunk: Chunk | None) -> None:
        if (future := self._answers.pop(worker, None)) is not None:
            future.set_result(chunk)

    async def take(self, seconds: float) -> list[tuple[int, bytes]]:
        """New messages; waits up to `seconds` for the first one."""
        if not self._messages and seconds:
            self._came.clear()
            try:
                await asyncio.wait_for(self._came.wait(), seconds)
            except asyncio.TimeoutError:
                return []
        messages = list(self._messages)
        self._messages.clear()
        return messages

    async def set_limit(self, limit: int) -> None:
        self._limit = limit


# --- a worker ----------------------------------------------------------------------------------------------


class RayWorker:
    """A worker, in its own process."""

    def __init__(self, broker: Any, number: int, cpus: float) -> None:
        # Without this the software renderer starts a thread for each core of the machine.
        os.environ["LP_NUM_THREADS"] = str(max(1, int(cpus)))
        self._broker, self._number = broker, number

    def run(self, work: bytes, worker_files: WorkerFiles, versions: Mapping[str, str]) -> None:
        """Do the work.

        Args:
            work: the pickled function and its setup. Unpickling them imports modules, which takes seconds;
                `quick_imports` shortens this time.

        Raises:
            OtherVersions: this machine has other versions of the packages than the submitting side.
        """
        from workbench.machine.software_vulkan import use_private_driver

        _require_versions(versions)
        # Without this a line with breakpoint() waits for Ray's debugger.
        os.environ.pop(BREAKPOINT, None)
        refuse_breakpoints(ONE_PROCESS)
        treat_ctrl_c_as_error()
        use_private_driver()
        _remove_left_folders()
        folder = Path(tempfile.mkdtemp(prefix=f"{_FOLDER}{os.getpid()}-"))
        try:
            places = worker_files.unpack(folder)
            queue = _BrokerQueue(self._broker, self._number, {str(folder): ""})
            with quick_imports():
                run, setup = pickle.loads(work)
            work_on(run, relocated(setup, places), queue)
            queue.flush()
        finally:
            os.chdir("/")
            shutil.rmtree(folder, ignore_errors=True)


def _remove_left_folders() -> None:
    """Remove the folders that killed actors left on this machine."""
    for path in Path(tempfile.gettempdir()).glob(f"{_FOLDER}*-*"):
        pid = path.name.removeprefix(_FOLDER).partition("-")[0]
        if pid.isdigit() and not psutil.pid_exists(int(pid)):
            shutil.rmtree(path, ignore_errors=True)


def _require_versions(versions: Mapping[str, str]) -> None:
    here = versions_here()
    if here != versions:
        differences = [
            f"{name} {here.get(name, 'not installed')} (submitting side: {versions.get(name, 'none')})"
            for name in dict.fromkeys((*versions, *here))
            if here.get(name) != versions.get(name)
        ]
        raise OtherVersions(
            f"{platform.node()} has {'; '.join(differences)}: install the same versions on all machines"
        )


class _BrokerQueue(WorkerQueue):
    """The chunks of an actor, requested from the broker."""

    def __init__(self, broker: Any, worker: int, origin: Mapping[str, str]) -> None:
        self._broker, self._worker, self.origin = broker, worker, origin
        self._waiting: list[bytes] = []
        self._last_sent = 0.0
        self._limit: int = NO_LIMIT
        self._put: Any = None
        """Ray reference to the result of the last `MessageBroker.put` call: the limit at that time."""

    def next(self) -> Chunk | None:
        import ray

        messages, self._waiting = [*self._waiting, pack_message(ChunkRequest())], []
        chunk, self._limit = ray.get(self._broker.ask.remote(self._worker, messages))
        return chunk

    def limit(self) -> int:
        import ray

        if time.monotonic() - self._last_sent > _SEND_SECONDS:
            self._send()
        if self._put is not None and ray.wait([self._put], timeout=0)[0]:
            self._limit, self._put = int(ray.get(self._put)), None
        return self._limit

    def send(self, message: Message) -> None:
        self._waiting.append(pack_message(message))
        if time.monotonic() - self._last_sent > _SEND_SECONDS:
            self._send()

    def flush(self) -> None:
        """Wait until all messages are sent."""
        import ray

        self._send()
        if self._put is not None:
            ray.get(self._put)

    def _send(self) -> None:
        messages, self._waiting = self._waiting, []
        self._put = self._broker.put.remote(self._worker, messages)
        self._last_sent = time.monotonic()
