"""Messages of a pool's workers, and their handling in the dealing process. A message is never a pickle."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

from workbench.jobs.pack_author_files import relocated
from workbench.jobs.scheduler import Chunk, ItemQueue, PoolError, Scheduler, Setup, Work
from workbench.machine.processes.wire import Unpacker, pack
from workbench.task.problem import Problem, TaskError


@dataclass(frozen=True)
class ChunkRequest:
    """A request for a chunk."""


@dataclass(frozen=True)
class ItemUpdate:
    """Progress of a worker."""

    value: bytes
    """Progress of the type `Work.update`, packed."""


@dataclass(frozen=True)
class ItemResult:
    """The result of an item."""

    number: int
    value: bytes
    """Result of the type `Work.result`, packed."""


@dataclass(frozen=True)
class WorkerEnded:
    """The last message of a worker."""

    why: str = ""
    """Reason of its failure; empty if it did not fail."""
    problem: Problem | None = None
    """Exception of the author's code, if that is the reason."""


Message = ChunkRequest | ItemUpdate | ItemResult | WorkerEnded
MESSAGES = get_args(Message)


class WorkerQueue(ABC):
    """The chunks of a worker that runs in another process than the scheduler."""

    origin: Mapping[str, str] = {}
    """Maps folders on this worker to folders of the submitting side; see `ItemQueue.origin`."""

    @abstractmethod
    def next(self) -> Chunk | None: ...

    @abstractmethod
    def limit(self) -> int: ...

    @abstractmethod
    def send(self, message: Message) -> None: ...

    def send_result(self, number: int, result: Any) -> None:
        self.send(ItemResult(number, pack(relocated(result, self.origin))))

    def send_update(self, update: Any) -> None:
        self.send(ItemUpdate(pack(relocated(update, self.origin))))


def work_on(run: Callable[[Setup, ItemQueue], None], setup: Setup, queue: WorkerQueue) -> None:
    """Call `Work.run`, and send its outcome."""
    try:
        run(setup, queue)
        queue.send(WorkerEnded())
    except TaskError as error:
        problem = relocated(error.problem, queue.origin)
        queue.send(WorkerEnded(str(error) or "TaskError", problem))
    except (OSError, ValueError, RuntimeError) as error:
        queue.send(WorkerEnded(relocated(str(error), queue.origin) or type(error).__name__))


@dataclass(frozen=True)
class Listener:
    """Handles the messages of workers for a scheduler."""

    kind: str
    """Name of a worker in messages: "*a process* that records was killed"."""
    work: Work[Any, Any, Any]
    scheduler: Scheduler[Any, Any]
    on_death: Callable[[str], None]
    """Called with a sentence when a worker has died and the job continues."""
    _unpacker: Unpacker = field(default_factory=Unpacker)

    def take(self, worker: Hashable, message: Message) -> Literal["asks", "goes on", "failed", "done"]:
        """Handle a message.

        Returns:
            ``asks``: the worker waits for a chunk. ``goes on``: the worker continues. ``failed``: the worker
            has failed, and the job continues. ``done``: the worker has finished.

        Raises:
            TaskError, PoolError: the worker failed, and the job is over.
            Unreadable: a result or an update does not have the type that the work declares.
        """
        if isinstance(message, ChunkRequest):
            return "asks"
        if isinstance(message, ItemUpdate):
            self.scheduler.update(self._unpacker.unpack(message.value, self.work.update))
            return "goes on"
        if isinstance(message, ItemResult):
            result = self._unpacker.unpack(message.value, self.work.result)
            self._named(lambda: self.scheduler.result(worker, message.number, result))
            return "goes on"
        if message.problem is not None:
            self.scheduler.failed(worker, TaskError(message.problem))
            return "failed"
        if message.why:
            raise PoolError(message.why)
        self._named(lambda: self.scheduler.ended(worker))
        return "done"

    def died(self, worker: Hashable, how: str, code: int | None) -> None:
        """Handle the death of a worker. Raises PoolError if the job is over."""
        self._named(lambda: self.scheduler.died(worker, how, code))
        if self.scheduler.limit():
            self.on_death(f"{self.kind} {self.work.name} {how}; its unfinished items are dealt again")

    def _named(self, act: Callable[[], None]) -> None:
        """Call `act`; prefix a PoolError of the scheduler with the name of the worker."""
        try:
            act()
        except PoolError as error:
            raise PoolError(f"{self.kind} {self.work.name} {error}") from None
