"""Benchmarks the batched CPU core: speed, its shares, pictures, snapshots and memory, as markdown.

    python tests/benchmarks/core.py                       # everything, about 15 minutes on two cores
    python tests/benchmarks/core.py --parts speed shares  # some parts
    python tests/benchmarks/core.py --write               # also writes rows of the table of benchmarks, part by part

Both sides of every comparison run in one call, alternately, each turn in its own process. Compare the ratios; the
absolute numbers depend on the machine. Run it on an idle machine.
"""

from __future__ import annotations

import multiprocessing
import queue
import statistics
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import core_sides as sides
import tyro

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from tests.benchmarks.table import Row, keep

Part = Literal["speed", "one", "shares", "scaling", "pictures", "snapshots", "memory"]
PARTS: tuple[Part, ...] = ("speed", "one", "shares", "scaling", "pictures", "snapshots", "memory")
MB = 1 << 20


@dataclass(frozen=True)
class Options:
    parts: tuple[Part, ...] = PARTS
    env_ids: tuple[str, ...] = ("PickCube-v1", "PushCube-v1", "StackCube-v1")
    num_envs: int = 64
    seconds: float = 5.0
    """Stepping time per turn."""
    turns: int = 3
    most_envs: int = 960
    """The scaling table doubles from 1 to this number; a process can hold slightly more (`envs/cpu_scene.py`)."""
    resets: int = 1000
    rebuilds: int = 100
    write: bool = False
    """Also write rows of the table of benchmarks."""


def _answer(function: Callable[..., Any], args: tuple[Any, ...], results: Any) -> None:
    try:
        results.put((True, function(*args)))
    except BaseException as error:
        results.put((False, repr(error)))
        raise


def in_own_process(function: Callable[..., Any], *args: Any) -> Any:
    """Call the function in a new process, so that no side inherits threads, caches or memory."""
    context = multiprocessing.get_context("spawn")
    results = context.Queue()
    process = context.Process(target=_answer, args=(function, args, results))
    process.start()
    while True:
        try:
            good, answer = results.get(timeout=1.0)
            break
        except queue.Empty:
            if not process.is_alive() and results.empty():
                raise RuntimeError(f"{function.__name__}{args} ended with {process.exitcode}") from None
    process.join()
    if not good:
        raise RuntimeError(f"{function.__name__}{args}: {answer}")
    return answer


def table(head: list[str], rows: list[list[str]]) -> Iterator[str]:
    yield "| " + " | ".join(head) + " |"
    yield "|" + "---|" * len(head)
    for row in rows:
        yield "| " + " | ".join(row) + " |"
    yield ""


def more(what: str, ours: float, other: float) -> Row:
    return Row(what, ours, other, "env-steps/s", "more", "core.py")


def spread(values: list[float]) -> str:
    return f"{statistics.median(values):.0f} ({min(values):.0f} to {max(values):.0f})"


def speed(options: Options, kept: list[Row]) -> Iterator[str]:
    n, rows = options.num_envs, []
    for env_id in options.env_ids:
        batched, stock, asynchronous = [], [], []
        for _ in range(options.turns):
            batched.append(in_own_process(sides.batched_rate, env_id, n, None, options.seconds))
            stock.append(in_own_process(sides.stock_rate, env_id, options.seconds))
            asynchronous.append(in_own_process(sides.async_rate, env_id, n, options.seconds))
        middle, one_stock = statistics.median(batched), statistics.median(stock)
        vector = statistics.median(asynchronous)
        what = f"Stepping {n} envs of {env_id}, states"
        kept.append(more(f"{what}, against one stock env", middle, one_stock))
        kept.append(more(f"{what}, against AsyncVectorEnv of {n}", middle, vector))
        ratios = [f"{middle / one_stock:.1f}", f"{middle / vector:.1f}"]
        rows.append([env_id, spread(batched), spread(stock), spread(asynchronous), *ratios])
    yield f"## Stepping {n} envs, state observations, all cores"
    yield ""
    yield "Env-steps a second, median (lowest to highest) of the turns. The batched core in its default mode, which is exact."
    yield ""
    head = ["task", "batched core", "one stock env", f"AsyncVectorEnv of {n}", "x stock", "x AsyncVectorEnv"]
    yield from table(head, rows)


def one(options: Options, kept: list[Row]) -> Iterator[str]:
    rows = []
    for env_id in options.env_ids:
        batched, stock = [], []
        for _ in range(options.turns):
            batched.append(in_own_process(sides.batched_rate, env_id, 1, None, options.seconds))
            stock.append(in_own_process(sides.stock_rate, env_id, options.seconds))
        ours, other = statistics.median(batched), statistics.median(stock)
        if env_id == options.env_ids[0]:
            kept.append(more(f"Stepping one env of {env_id}, states, against one stock env", ours, other))
        rows.append([env_id, spread(batched), spread(stock), f"{ours / other:.2f}"])
    yield "## One env"
    yield ""
    yield from table(["task", "batched core, N = 1", "one stock env", "ratio"], rows)


def shares(options: Options, kept: list[Row]) -> Iterator[str]:
    rows = []
    for env_id in options.env_ids:
        share = in_own_process(sides.physics_share, env_id, options.num_envs)
        rows.append([env_id, f"{100 * share['wall']:.0f} %", f"{100 * share['cores']:.0f} %"])
    yield f"## What of a control step of {options.num_envs} envs is PhysX's own step()"
    yield ""
    yield "*Of the wall time*: at least one env is inside step(). *Of the cores*: time inside step(), summed over"
    yield "the threads, of what all of them could have spent."
    yield ""
    yield from table(["task", "of the wall time", "of the cores"], rows)


def scaling(options: Options, kept: list[Row]) -> Iterator[str]:
    from workbench.envs.simulation.stepping import usable_cores

    cores = usable_cores()
    threads = sorted({1, *(2**k for k in range(1, 12) if 2**k < cores), cores})
    counts = sorted({*(2**k for k in range(20) if 2**k <= options.most_envs), options.most_envs})
    rows = []
    for count in counts:
        rates = [
            in_own_process(sides.batched_rate, options.env_ids[0], count, t, options.seconds / 2)
            for t in threads
        ]
        rows.append([str(count), *(f"{rate:.0f}" for rate in rates), f"{rates[-1] / rates[0]:.2f}"])
    yield f"## {options.env_ids[0]} over envs and threads"
    yield ""
    yield "Env-steps a second."
    yield ""
    yield from table(["envs", *(f"{t} thread{'s' * (t > 1)}" for t in threads), "all / 1"], rows)


def pictures(options: Options, kept: list[Row]) -> Iterator[str]:
    took = in_own_process(sides.picture_seconds, options.env_ids[0], 16, 4 * options.seconds)
    yield "## A picture, rgb 128 x 128, of 16 envs"
    yield ""
    rows = [
        [name, f"{1e3 * took[side]:.1f} ms", f"{took[side] / took['bare']:.2f}"]
        for name, side in (
            ("batched observation", "batched"),
            ("one stock env's observation", "stock"),
            ("SAPIEN's take_picture and get_picture alone, all envs", "bare"),
        )
    ]
    yield from table(["", "a picture", "to bare"], rows)


def snapshots(options: Options, kept: list[Row]) -> Iterator[str]:
    took = in_own_process(sides.snapshot_seconds, options.env_ids[0], options.num_envs)
    rows = [
        [name, f"{1e3 * took[side]:.2f} ms", f"{100 * took[side] / took['step']:.1f} %"]
        for name, side in (
            ("control step", "step"),
            ("snapshot", "snapshot"),
            ("restore, exact (default)", "exact"),
            ("restore, `fresh_physics=False`", "quick"),
        )
    ]
    envs = f"{options.num_envs} envs of {options.env_ids[0]}"
    for what, ours, other in (
        (f"Snapshot of {envs}, against a control step", "snapshot", "step"),
        (f"Snapshot restored exactly (default), {envs}, against a control step", "exact", "step"),
        (f"Snapshot restored with `fresh_physics=False`, {envs}, against an exact restore", "quick", "exact"),
    ):
        kept.append(Row(what, 1e3 * took[ours], 1e3 * took[other], "ms", "less", "core.py"))
    yield f"## Snapshots of {envs}"
    yield ""
    yield "The exact restore gives every env a new PhysX scene, so that it goes on in the same way to the"
    yield "last bit each time. The quick one keeps the scene: contacts may then be solved in another order, and what"
    yield "is in contact differs, from the last bit on, after the first step."
    yield ""
    yield from table(["", "median", "of a control step"], rows)


def memory(options: Options, kept: list[Row]) -> Iterator[str]:
    env_id = options.env_ids[0]
    counts = [16, 64, 256]
    held = [in_own_process(sides.memory_of, env_id, count) for count in counts]
    yield f"## Memory, {env_id}"
    yield ""
    rows = [[str(count), f"{b / MB:.0f} MB"] for count, b in zip(counts, held, strict=True)]
    yield from table(["envs", "process holds"], rows)
    each = (held[-1] - held[0]) / (counts[-1] - counts[0]) / MB
    kept.append(Row(f"Memory of a further env of {env_id}", each, None, "MB", "less", "core.py"))
    yield f"A further env costs {each:.2f} MB (from {counts[0]} to {counts[-1]})."
    yield ""
    for name, values in (
        (
            f"{options.resets} resets of 16 envs",
            in_own_process(sides.memory_over_resets, env_id, 16, options.resets),
        ),
        (
            f"{options.rebuilds} rebuilds of 4 envs",
            in_own_process(sides.memory_over_rebuilds, env_id, 4, options.rebuilds),
        ),
    ):
        yield f"After each tenth of {name}: " + ", ".join(f"{v / MB:.0f}" for v in values) + " MB."
        yield ""


def main(options: Options) -> None:
    makers = {
        "speed": speed,
        "one": one,
        "shares": shares,
        "scaling": scaling,
        "pictures": pictures,
        "snapshots": snapshots,
        "memory": memory,
    }
    for part in options.parts:
        kept: list[Row] = []
        for line in makers[part](options, kept):
            print(line, flush=True)
        if options.write:
            # After each part, so that an interrupted call keeps its measurements.
            keep(kept)


if __name__ == "__main__":
    main(tyro.cli(Options))
