"""Deals a job's numbered items in fixed chunks, and tracks their results."""

from __future__ import annotations

import re
import sys
from collections import deque
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby, islice
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

from workbench.task.problem import Problem, TaskError

NO_LIMIT = sys.maxsize
MAX_ALIKE_FIRST, MAX_ALIKE_LATER = 5, 20
"""If this many chunks of a group fail in the same way, without a result in between, the rest of the group is
not tried; without groups, the job ends. The first number applies before the group's first result, the second
one after it."""
_MAX_EARLY_DEATHS = 3
"""The job ends when this many workers have died before their first chunk, without a result in between."""
_NO_GROUP = -1
"""Placeholder for the group of a worker that has no chunk yet."""

Setup = TypeVar("Setup")
Result = TypeVar("Result")
Update = TypeVar("Update")


class PoolError(RuntimeError):
    """A worker died or failed; the other workers were stopped and dropped their running items."""


@dataclass(frozen=True)
class Chunk:
    """Items that one worker runs together.

    The division into chunks is the same for any number of workers. So the results are the same too, although
    the outputs of a policy depend, in the last bits, on the batch size and on the row in the batch.
    """

    numbers: tuple[int, ...]
    """Item numbers, ascending."""
    wanted: frozenset[int]
    """Items whose results are still missing."""
    again: bool = False
    """Whether another worker, or an earlier run of the job, may have begun the chunk and left files of it."""


class ItemQueue(Protocol):
    """The chunks of one worker. Used on one thread."""

    @property
    def origin(self) -> Mapping[str, str]:
        """Maps folders on this worker to the folders of the submitting side from which their files came."""
        ...

    def next(self) -> Chunk | None:
        """The next chunk to begin; None if there is none."""
        ...

    def limit(self) -> int:
        """Items from this number on are not needed, even if they have begun. The limit never rises."""
        ...

    def send_result(self, number: int, result: Any) -> None:
        """Send the result of an item."""
        ...

    def send_update(self, update: Any) -> None:
        """Send progress."""
        ...


@dataclass(frozen=True)
class Failure:
    """Items that gave no result."""

    numbers: tuple[int, ...]
    problem: Problem


def kind_of(problem: Problem) -> object:
    """Key that is equal for failures of the same kind: raised in the same stage, at the same line."""
    return problem.stage, problem.file, problem.line


def by_kind(failures: Iterable[Failure]) -> list[tuple[Problem, list[int]]]:
    """The first problem of each kind, with the items of all failures of that kind."""
    found: dict[object, tuple[Problem, list[int]]] = {}
    for failure in failures:
        found.setdefault(kind_of(failure.problem), (failure.problem, []))[1].extend(failure.numbers)
    return [(problem, sorted(numbers)) for problem, numbers in found.values()]


@dataclass(frozen=True)
class Shard:
    """One of the equal parts of a job."""

    index: int = 1
    """Number of the part, counted from 1."""
    count: int = 1

    def part(self, total: int) -> range:
        """Range of the chunks in this part, out of `total` chunks. Sizes of parts differ by at most one."""
        return range(total * (self.index - 1) // self.count, total * self.index // self.count)

    def __str__(self) -> str:
        return f"{self.index}/{self.count}"


def parse_shard(text: str) -> Shard:
    """The part that ``--shard`` names, as in ``3/64``. Raises ValueError for any other text."""
    match = re.fullmatch(r"([0-9]{1,6})/([0-9]{1,6})", text)
    if match is None or not 1 <= int(match[1]) <= int(match[2]):
        raise ValueError(f"--shard takes a part of the job, as in 3/64 for the third of 64; got {text!r}")
    return Shard(int(match[1]), int(match[2]))


@dataclass(eq=False)
class _Held:
    """A chunk that a worker has."""

    chunk: Chunk
    missing: set[int]
    """Wanted items that have no result yet."""


class Scheduler(Generic[Result, Update]):
    """The chunks of a job, and the callbacks for the results of its items. Used on one thread.

    Chunks are dealt in ascending order. Items from the limit on are not needed: a caller with enough results lowers the
    limit, and a limit of 0 stops the job. A chunk whose worker died is dealt again, after all other chunks.
    """

    def __init__(
        self,
        numbers: Iterable[int],
        on_result: Callable[[int, Result], None],
        on_update: Callable[[Update], None] = lambda update: None,
        stop: Callable[[], bool] = lambda: False,
        *,
        chunk: int = 1,
        tries: int = 1,
        on_failure: Callable[[Failure], None] | None = None,
        group: int | None = None,
    ) -> None:
        """
        Args:
            numbers: item numbers, ascending, from 0 on.
            stop: called often; as soon as it returns True, no more items are needed.
            chunk: number of items in a chunk: item k belongs to chunk ``k // chunk``.
            tries: maximum number of times that a chunk is started, if its workers die.
            on_failure: called with items that failed: the author's code raised in them, or their workers died
                in every try. The job then continues, unless too many chunks fail in the same way. Without
                `on_failure`, the first failure ends the job.
            group: number of items in a group: item k belongs to group ``k // group``. Each group begins with
                a new chunk. If too many chunks of a group fail in the same way, or the task cannot be built
                for the group, the rest of the group counts as failed, and the job continues.
        """
        self._numbers, self._size, self._tries = numbers, chunk, tries
        self._on_result, self._on_update, self._stop = on_result, on_update, stop
        self._on_failure, self._group = on_failure, group or NO_LIMIT
        self._with_results: set[int] = set()
        """Groups that have a result."""
        self._given_up: dict[int, Problem] = {}
        """For each group that was given up: its problem."""
        self._known: Mapping[int, Result] = {}
        self._keep: Callable[[int, Result], None] = lambda number, result: None
        self._left = self._chunks()
        self._ahead: deque[Chunk] = deque()
        """Chunks that were already taken from `_left`."""
        self._alone: deque[Chunk] = deque()
        """Items of failed chunks, as chunks of one item each: dealt first, to find out which items fail."""
        self._returned: deque[Chunk] = deque()
        self._held: dict[Hashable, list[_Held]] = {}
        self._deaths: dict[int, int] = {}
        """Number of workers that died with a chunk, by the chunk's first item."""
        self._failed_alike: dict[int, list[tuple[object, int]]] = {}
        """Failures of each group since its last result: (kind, first item of the chunk)."""
        self._limit = NO_LIMIT
        self.is_going_on = False
        """True while `go_on` passes results of an earlier run to `on_result`."""
        self.results = 0
        self.failures: list[Failure] = []

    # --- before it begins ------------------------------------------------------------------------------

    def take_part(self, shard: Shard) -> None:
        """Keep only the chunks of this part."""
        total = sum(1 for _ in self._chunks())
        part = shard.part(total)
        self._left = islice(self._chunks(), part.start, part.stop)

    def go_on(self, known: Mapping[int, Result], keep: Callable[[int, Result], None]) -> None:
        """Take the results of an earlier run of the job; only items without a result are dealt.

        Args:
            keep: called with each new result before anything else uses it.
        """
        self._known, self._keep, self.is_going_on = known, keep, True
        for number in sorted(known):
            self.results += 1
            self._with_results.add(number // self._group)
            self._on_result(number, known[number])
        self.is_going_on = False

    # --- for the workers -------------------------------------------------------------------------------

    def next(self, worker: Hashable) -> Chunk | None:
        """The next chunk for this worker."""
        limit = self.limit()
        for waiting in (self._alone, self._ahead, self._returned):
            if waiting is self._ahead:
                self._look(1)
            while waiting and min(waiting[0].wanted) >= limit:
                if waiting is self._ahead:
                    break  # all later chunks are beyond the limit too
                waiting.popleft()
            if waiting and min(waiting[0].wanted) < limit:
                chunk = waiting.popleft()
                self._held.setdefault(worker, []).append(_Held(chunk, set(chunk.wanted)))
                return chunk
        return None

    def count_left(self, most: int) -> int:
        """Number of chunks that can still be dealt, at most `most`."""
        limit = self.limit()
        again = sum(min(chunk.wanted) < limit for chunk in (*self._alone, *self._returned))
        return min(self._look(most) + again, most)

    def limit(self) -> int:
        if self._stop():
            self.lower(0)
        return self._limit

    def lower(self, limit: int) -> None:
        """Lower the limit: items from `limit` on are not needed."""
        self._limit = min(limit, self._limit)

    def result(self, worker: Hashable, number: int, result: Result) -> None:
        """Take the result of an item. Raises PoolError if the worker does not have this item."""
        held = next((held for held in self._held.get(worker, ()) if number in held.missing), None)
        if held is None:
            raise PoolError("sent the result of an item that it was not given")
        held.missing.remove(number)
        if not held.missing:
            self._held[worker].remove(held)
        self._with_results.add(number // self._group)
        for group in (number // self._group, _NO_GROUP):
            self._failed_alike.pop(group, None)
        self.results += 1
        self._keep(number, result)
        self._on_result(number, result)

    def update(self, update: Update) -> None:
        self._on_update(update)

    def ended(self, worker: Hashable) -> None:
        """Handle a worker's last message. Raises PoolError if the worker still has needed items."""
        held = self._held.pop(worker, [])
        if min((number for one in held for number in one.missing), default=NO_LIMIT) < self.limit():
            raise PoolError("ended before it was done")

    def failed(self, worker: Hashable, error: TaskError) -> None:
        """Handle a failure of the author's code in the last chunk of this worker; the worker has ended. The
        items of the failed chunk are then dealt one by one.

        Raises:
            TaskError: the job is over: the worker had no chunk, too many chunks failed in this way, or there
                is no `on_failure`.
        """
        held = self._held.pop(worker, [])
        if not held or self._on_failure is None:
            raise error
        *others, last = held
        for one in others:
            self._give_back(one)
        # A task that cannot be built would also fail in the next chunk of its group.
        unbuilt = self._group != NO_LIMIT and error.problem.stage in ("syntax", "import", "build")
        if not unbuilt and self._divide(last):
            return
        self._fail(last.missing, error.problem)
        if self._alike(kind_of(error.problem), last) or unbuilt:
            self._give_up_group(last, error, error.problem)

    def died(self, worker: Hashable, how: str, code: int | None) -> None:
        """Handle the death of a worker that sent no last message.

        Args:
            how: what happened to the worker, as a predicate: ``was killed by SIGKILL``.
            code: exit code of the worker, if known; deaths with the same code are of the same kind.

        Raises:
            PoolError: the job is over.
        """
        held = self._held.pop(worker, [])
        if self._tries == 1:
            raise PoolError(how)
        if self.limit() == 0:
            return
        if not held:
            # The worker died before its first chunk: the machine or the import is at fault.
            before = self._failed_alike.setdefault(_NO_GROUP, [])
            before.append((code, -len(before) - 1))
            if len(before) >= _MAX_EARLY_DEATHS:
                raise PoolError(how)
        for one in held:
            first = one.chunk.numbers[0]
            self._deaths[first] = self._deaths.get(first, 0) + 1
            over = self._deaths[first] >= self._tries
            if not over:
                self._give_back(one)
            problem = Problem("worker", f"the worker {how}", None, None, None, "")
            if self._alike(code, one):
                self._give_up_group(one, PoolError(how), problem)
            if over and not self._divide(one):
                if self._on_failure is None or not (self.results or self.count_left(1)):
                    raise PoolError(how)
                self._fail(one.missing, problem)

    def require_results(self) -> None:
        """Raise the TaskError of the first failure, if no item has a result."""
        if self.failures and not self.results:
            raise TaskError(self.failures[0].problem)

    # --- inside ----------------------------------------------------------------------------------------

    def _chunks(self) -> Iterator[tuple[int, ...]]:
        for _, numbers in groupby(self._numbers, lambda number: number // self._size):
            yield tuple(numbers)

    def _look(self, most: int) -> int:
        """Fill `_ahead` with up to `most` chunks; returns how many of these are needed."""
        while len(self._ahead) < most and (numbers := next(self._left, None)) is not None:
            if wanted := frozenset(numbers) - self._known.keys():
                if (problem := self._given_up.get(numbers[0] // self._group)) is not None:
                    self._fail(wanted, problem)
                    continue
                self._ahead.append(Chunk(numbers, wanted, again=bool(self._known)))
        limit = self.limit()
        return sum(min(chunk.wanted) < limit for chunk in islice(self._ahead, most))

    def _give_back(self, held: _Held) -> None:
        if (problem := self._given_up.get(held.chunk.numbers[0] // self._group)) is not None:
            self._fail(held.missing, problem)
        else:
            self._returned.append(Chunk(held.chunk.numbers, frozenset(held.missing), again=True))

    def _divide(self, held: _Held) -> bool:
        """Deal the missing items of a chunk one by one. Returns False if the chunk is not divided: it has
        only one item, none of its missing items is needed, its group was given up, or there is no
        `on_failure`."""
        limit = self.limit()
        missing = sorted(number for number in held.missing if number < limit)
        given_up = held.chunk.numbers[0] // self._group in self._given_up
        if len(held.chunk.numbers) == 1 or not missing or self._on_failure is None or given_up:
            return False
        for number in missing:
            self._alone.append(Chunk((number,), frozenset((number,)), again=True))
            self._deaths[number] = self._tries - 1
        return True

    def _give_up_group(self, held: _Held, error: TaskError | PoolError, problem: Problem) -> None:
        """Mark the rest of the chunk's group as failed; without groups, raise the error."""
        if self._group == NO_LIMIT or self._on_failure is None:
            raise error
        group = held.chunk.numbers[0] // self._group
        self._given_up[group] = problem
        for waiting in (self._ahead, self._returned, self._alone):
            for chunk in [chunk for chunk in waiting if chunk.numbers[0] // self._group == group]:
                waiting.remove(chunk)
                self._fail(chunk.wanted, problem)

    def _fail(self, numbers: Iterable[int], problem: Problem) -> None:
        limit = self.limit()
        failure = Failure(tuple(sorted(number for number in numbers if number < limit)), problem)
        self.failures.append(failure)
        if self._on_failure is not None:
            self._on_failure(failure)

    def _alike(self, key: object, held: _Held) -> bool:
        """Record a failure of this kind. Returns whether to give up the group: enough of its chunks have
        failed in this way since its last result."""
        first = held.chunk.numbers[0]
        group = first // self._group
        before = self._failed_alike.setdefault(group, [])
        before.append((key, first))
        alike = {first for kind, first in before if kind == key}
        return len(alike) >= (MAX_ALIKE_LATER if group in self._with_results else MAX_ALIKE_FIRST)


@dataclass(frozen=True)
class Work(Generic[Setup, Result, Update]):
    """What each worker of a job does, and the files that it needs."""

    run: Callable[[Setup, ItemQueue], None]
    """A function that can be imported by name. It returns when its queue has no next chunk and all items that
    it began are finished.

    If it raises a TaskError, its last chunk has failed; an OSError, ValueError or RuntimeError ends the job.
    """
    setup: Setup
    """The first argument of `run`; can be pickled."""
    result: Any
    update: Any
    """Types of results and updates; `wire` checks the messages of other processes against these types."""
    name: str
    """Clause that describes a worker in messages: "a process *that records* was killed by SIGKILL"."""
    folders: Sequence[Path] = ()
    """Folders of the author that workers on other machines need, with everything below."""
    files: Sequence[Path] = ()
    """Other files that workers on other machines need. Paths in `setup` outside `folders` and `files` must
    exist on all machines. A path that must not be relocated although it is in a copied folder, such as the
    results folder, is stored as bytes."""


class Executor(Protocol):
    """Does the work of a job."""

    @property
    def is_remote(self) -> bool:
        """Whether workers may run on other machines."""
        ...

    def run(self, work: Work[Setup, Result, Update], scheduler: Scheduler[Result, Update]) -> None:
        """Deal chunks until no more are left, or no more are needed; return when all running items are
        finished.

        Raises:
            TaskError, PoolError: too much failed (see `Scheduler`), or a worker failed in the workbench's own
                code. The other workers were stopped and dropped their running items.
        """
        ...


class ThisProcess:
    """Runs the work in this process; exceptions of `Work.run` other than TaskError pass through."""

    @property
    def is_remote(self) -> bool:
        return False

    def run(self, work: Work[Setup, Result, Update], scheduler: Scheduler[Result, Update]) -> None:
        while True:
            try:
                work.run(work.setup, _OwnQueue(scheduler))
                return scheduler.ended(None)
            except TaskError as error:
                scheduler.failed(None, error)
            if not scheduler.count_left(1):
                return


@dataclass(frozen=True)
class _OwnQueue:
    """The chunks of the dealing process itself."""

    scheduler: Scheduler[Any, Any]
    origin: Mapping[str, str] = field(default_factory=dict)

    def next(self) -> Chunk | None:
        return self.scheduler.next(None)

    def limit(self) -> int:
        return self.scheduler.limit()

    def send_result(self, number: int, result: Any) -> None:
        self.scheduler.result(None, number, result)

    def send_update(self, update: Any) -> None:
        self.scheduler.update(update)
