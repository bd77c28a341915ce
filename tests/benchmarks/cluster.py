"""Episodes per second on a Ray cluster and on local processes, and the cost of each part: python tests/benchmarks/cluster.py

Both sides record the same episodes with one worker per core, alternately. The start (until the end of the first episode),
the rate from there to the last episode, and the start of the cluster itself are reported separately. Then one worker is
measured, and the parts that do not scale with the number of machines: a message through the broker, a result at the
scheduler and in the job file, and the packed files.

    python tests/benchmarks/cluster.py --write    # also writes a row of the table of benchmarks
"""

from __future__ import annotations

import os
import statistics
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any

import tyro

sys.path.insert(0, str(Path(__file__).parents[2]))
from tests.benchmarks.table import Row, keep
from workbench.jobs.local_processes import Processes
from workbench.jobs.pack_author_files import pack_worker_files
from workbench.jobs.ray_cluster import Cluster, MessageBroker
from workbench.jobs.ray_connection import connected
from workbench.jobs.results_file import JobFile, JobKey
from workbench.jobs.scheduler import Executor, Scheduler, Work
from workbench.jobs.worker_messages import ItemResult, Listener
from workbench.machine.processes.wire import Unpacker, pack, pack_message
from workbench.record.job import Recorded, record
from workbench.record.job_worker import RecordOptions, Written
from workbench.task.description import TaskOptions

ROOT = Path(__file__).resolve().parents[2]
CORES = len(os.sched_getaffinity(0))
PROJECTED_CORES = 1000
"""Number of cores for which `projection` computes the limits."""


@dataclass(frozen=True)
class Options:
    task: str = "PushCube-v1"
    episodes: int = 512
    num_envs: int = 16
    turns: int = 3
    write: bool = False
    """Write a row of the table of benchmarks."""


@dataclass(frozen=True)
class Run:
    """Timing of one recording job."""

    start: float
    """Seconds until the end of the first episode."""
    rate: float
    """Episodes per second from there on."""
    whole: float
    """Episodes per second, start included."""


def recorded(options: Options, executor: Executor, episodes: int) -> tuple[Run, Recorded]:
    over: list[float] = []
    with tempfile.TemporaryDirectory() as folder:
        asked = RecordOptions(
            options.task,
            Path(folder),
            episodes,
            pictures=False,
            options=TaskOptions(options.num_envs, env_kwargs={"render_backend": "none"}),
        )
        began = time.monotonic()
        done = record(
            asked,
            on_progress=lambda now: over.append(time.monotonic()) if now.over is not None else None,
            executor=executor,
        )
        ended = time.monotonic()
    assert len(over) == episodes
    return Run(over[0] - began, (episodes - 1) / (over[-1] - over[0]), episodes / (ended - began)), done


def broker_costs(ray: Any) -> tuple[float, float]:
    """Seconds of a request for a chunk with its answer, and messages per second through one broker."""
    broker = ray.remote(num_cpus=0)(MessageBroker).remote()
    ray.get(broker.put.remote(0, []))
    trips: list[float] = []
    for _ in range(300):
        began = time.perf_counter()
        asked = broker.ask.remote(0, [b"asks"])
        ray.get(broker.take.remote(0.1))
        broker.answer.remote(0, None)
        ray.get(asked)
        trips.append(time.perf_counter() - began)

    @ray.remote(num_cpus=0)
    def talk(broker: Any, count: int) -> None:
        ray.get([broker.put.remote(0, [b"x" * 300]) for _ in range(count)])

    ray.get([talk.remote(broker, 1) for _ in range(2)])
    began = time.perf_counter()
    ray.get([talk.remote(broker, 3000) for _ in range(2)])
    rate = 6000 / (time.perf_counter() - began)
    ray.kill(broker)
    return statistics.median(trips), rate


def result_cost(one: Written) -> tuple[int, float, float]:
    """Bytes of a result, and its seconds at the scheduler and in the job file."""
    count = 2000
    packed = [pack_message(ItemResult(number, pack(one))) for number in range(count)]
    scheduler: Scheduler[Written | None, None] = Scheduler(
        range(count), lambda number, result: None, chunk=count
    )
    work = Work(lambda setup, queue: None, None, Written | None, None, "that records")
    listener = Listener("a worker", work, scheduler, lambda text: None)
    unpacker = Unpacker((ItemResult,))
    scheduler.next(0)
    began = time.perf_counter()
    for raw in packed:
        listener.take(0, unpacker.message(raw))
    taken = (time.perf_counter() - began) / count
    with tempfile.TemporaryDirectory() as folder:
        file = JobFile(Path(folder) / "a.job", JobKey("record", {"command": "record"}, b""))
        began = time.perf_counter()
        for number in range(300):
            file.keep(number, one)
        kept = (time.perf_counter() - began) / 300
        file.close()
    return len(packed[0]), taken, kept


def text(options: Options, kept_rows: list[Row]) -> Iterator[str]:
    began = time.monotonic()
    with connected("local") as ray:
        started = time.monotonic() - began
        sides: dict[str, list[Run]] = {"local": [], "ray": [], "one": []}
        executors = {"local": Processes(CORES), "ray": Cluster(workers=CORES), "one": Processes(1)}
        one: Written | None = None
        for _ in range(options.turns):
            for name, executor in executors.items():
                count = options.episodes // CORES if name == "one" else options.episodes
                run, done = recorded(options, executor, count)
                sides[name].append(run)
                one = done.written[0]
                print(name, run, flush=True)
        trip, messages = broker_costs(ray)
    assert one is not None
    middle = {
        name: Run(
            *(statistics.median(getattr(run, part) for run in runs) for part in ("start", "rate", "whole"))
        )
        for name, runs in sides.items()
    }
    size, taken, kept = result_cost(one)
    began = time.perf_counter()
    worker_files = pack_worker_files([ROOT / "tasks"])
    packed = time.perf_counter() - began
    local, cluster, alone = middle["local"], middle["ray"], middle["one"]
    what = f"Recording {options.task} with {CORES} workers of Ray, against {CORES} local processes"
    kept_rows.append(Row(what, cluster.rate, local.rate, "episodes/s", "more", "cluster.py"))
    yield (
        f"Measured on {date.today():%B %-d, %Y}: {CORES} cores, {options.task}, {options.episodes} episodes of 50 steps "
        f"without pictures, {options.num_envs} envs per worker, medians of {options.turns} runs (`tests/benchmarks/cluster.py`)."
    )
    yield ""
    yield "| | episodes per second | first episode after | with the start |"
    yield "| --- | ---: | ---: | ---: |"
    for name, run in (
        (f"{CORES} local processes", local),
        (f"{CORES} workers of Ray, same cores", cluster),
        ("1 local process", alone),
    ):
        yield f"| {name} | {run.rate:.1f} | {run.start:.1f} s | {run.whole:.1f} |"
    yield ""
    yield (
        f"Ray reaches {cluster.rate / local.rate:.0%} of the local rate; its daemons start in {started:.1f} s and use the same "
        f"cores."
    )
    yield ""
    print(
        f"{local.rate / alone.rate:.2f} times the rate of one core on {CORES}\n"
        f"{1000 * trip:.1f} ms: a request for a chunk through the broker, and its answer\n"
        f"{messages:,.0f} messages per second through the broker, from two senders on these cores\n"
        f"{1e6 * taken:.0f} µs: a result ({size} bytes) at the scheduler\n"
        f"{1000 * kept:.1f} ms: a result in the job file, on disk\n"
        f"{1000 * packed:.0f} ms: packing the files to send ({len(worker_files.data) / 1e6:.1f} MB, the examples in `tasks/`)"
    )
    yield from projection(cluster.rate / CORES, messages, taken, kept, options.num_envs)


def projection(rate: float, messages: float, taken: float, kept: float, envs: int) -> Iterator[str]:
    """Project the limits of the shared parts to many cores.

    Args:
        rate: episodes per second and core.
    """
    results = PROJECTED_CORES * rate
    parts = {
        # Each worker reports its results once a second.
        "the broker": messages * rate,
        "the scheduler": 1 / taken,
        "the job file": 1 / kept,
    }
    name, most = min(parts.items(), key=lambda pair: pair[1])
    yield (
        f"Computed for {PROJECTED_CORES:,} cores: {results:,.0f} such episodes per second. The broker carries {parts['the broker']:,.0f}, the "
        f"scheduler takes {parts['the scheduler']:,.0f}, the job file keeps {parts['the job file']:,.0f}. "
        f"The first limit is {name}, from {most / rate:,.0f} cores on. Beyond it use `--shard` with one driver per part, and "
        f"`merge`. Give each worker at least ten chunks of {envs} envs, because workers idle during the last chunk."
    )


def main(options: Options) -> None:
    kept: list[Row] = []
    print("\n".join(text(options, kept)))
    if options.write:
        keep(kept)


if __name__ == "__main__":
    main(tyro.cli(Options))
