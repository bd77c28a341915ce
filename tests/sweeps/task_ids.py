"""Exercise every id in ManiSkill's registry, and write the docs page with the results.

    python tests/sweeps/task_ids.py                  all ids, and the page web_assets/docs/reference/task_ids.md
    python tests/sweeps/task_ids.py PickCube-v1 ...  some ids, printed

A task may crash or hang, so the ids run in a child process: a crash or a hang is one row, and the next id gets a new
child. One child runs many ids, because the first picture of a process compiles SAPIEN's shaders. The child has no
standard input, raises on network access, and has an empty ManiSkill download folder, so that the page does not depend on
earlier downloads.
"""

from __future__ import annotations

import json
import os
import queue
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

REPOSITORY = Path(__file__).parents[2]
PAGE = REPOSITORY / "web_assets" / "docs" / "reference" / "task_ids.md"
ROW_PREFIX = "task_ids row: "
LIMIT_SECONDS = 900.0
"""Timeout for one id: the slowest needs 60 s on two idle cores, and the first also compiles shaders."""


def sweep(ids: Sequence[str], limit: float = LIMIT_SECONDS) -> Iterator[dict]:
    """Yield a row for each id in the given order; see `exercise_task.Row` and `_tried`."""
    remaining = list(ids)
    with tempfile.TemporaryDirectory() as nothing_downloaded:
        while remaining:
            child = _child(remaining, nothing_downloaded)
            lines = _lines_of(child)
            try:
                while remaining:
                    row = _next_row(child, lines, remaining[0], limit)
                    remaining.pop(0)
                    yield row
                    if row["outcome"] in ("crashed", "hung"):
                        break
            finally:
                child.kill()
                child.wait()


def _child(ids: Sequence[str], assets: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, __file__, "--in-this-process", *ids],
        cwd=REPOSITORY,
        env={**os.environ, "MS_ASSET_DIR": assets, "PYTHONUNBUFFERED": "1"},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )


def _lines_of(child: subprocess.Popen[str]) -> queue.Queue[str | None]:
    lines: queue.Queue[str | None] = queue.Queue()

    def read() -> None:
        assert child.stdout is not None
        for line in child.stdout:
            lines.put(line)
        lines.put(None)

    threading.Thread(target=read, daemon=True).start()
    return lines


def _next_row(
    child: subprocess.Popen[str], lines: queue.Queue[str | None], env_id: str, limit: float
) -> dict:
    """Return the row of `env_id`, or a substitute if the child ended or sent nothing for `limit` seconds."""
    end = time.monotonic() + limit
    while True:
        try:
            line = lines.get(timeout=max(0.0, end - time.monotonic()))
        except queue.Empty:
            return _no_row(env_id, "hung", f"no result within {limit:.0f} s")
        if line is None:
            return _no_row(env_id, "crashed", f"the process ended with status {child.wait()}")
        if line.startswith(ROW_PREFIX):
            return json.loads(line.removeprefix(ROW_PREFIX))


def _no_row(env_id: str, outcome: str, note: str) -> dict:
    return {
        "env_id": env_id,
        "robot": "",
        "outcome": outcome,
        "seconds": 0.0,
        "cameras": [],
        "notes": [note],
        "after_restore": [],
        "like_stock": "",
        "follows": False,
    }


# --- in the child ------------------------------------------------------------------------------------


def try_here(ids: Sequence[str]) -> None:
    """Exercise each id and print its row."""
    refuse_the_network()
    import torch

    # With four rows, torch's threads cost more than they save.
    torch.set_num_threads(1)
    for env_id in ids:
        print(ROW_PREFIX + json.dumps(_tried(env_id)), flush=True)


def _tried(env_id: str) -> dict:
    from tests.sweeps.exercise_task import exercise
    from tests.sweeps.follow_stock import MOVED_BY_THE_TASK, compare

    row = exercise(env_id).as_dict() | {"like_stock": "", "follows": False}
    if row["outcome"] in ("passed", "upstream"):
        comparison = compare(env_id)
        row |= {"like_stock": comparison.in_words(), "follows": comparison.follows}
        if comparison.ignored is not None:
            row["notes"].append("not compared: {}, {}".format(*MOVED_BY_THE_TASK[env_id]))
        if comparison.unbatched:
            row["notes"].append(f"one value for all envs, not compared: {', '.join(comparison.unbatched)}")
    return row


def refuse_the_network() -> None:
    """Raise on any network access from now on."""

    def hook(event: str, details: tuple) -> None:
        if event in ("socket.connect", "socket.getaddrinfo") and "AF_UNIX" not in repr(details[0]):
            raise RuntimeError(f"network access refused: {event} {details[1:]}")

    sys.addaudithook(hook)


# --- the page ----------------------------------------------------------------------------------------

_HEAD = """# Every task of ManiSkill, batched on the CPU

Made by `python tests/sweeps/task_ids.py` with mani_skill {mani_skill} and sapien {sapien}; do not edit.

All {count} ids that mani_skill registers, each with {num_envs} envs and its cameras on: two seeded resets with equal
bits, {actions} random actions with pictures as the observation, a reset of envs 1 and 3 that must not change a bit of
envs 0 and 2, a snapshot and two restores, and pictures that are not blank. The process has no network and no
standard input.

{totals}

* **outcome**: *passed*; *its own fault*: passed, except for a fault of the task in any batched
  simulation, including the GPU's, given under *note* with the line that fails (the test checks that the
  traceback contains that line); *download*: needs assets that are not in mani_skill's wheel.
* **like stock**: env {place} of the {num_envs} compared with ManiSkill's own single CPU env, from the same state under the same
  actions, for {steps} control steps. *Bit for bit*: not a byte of PhysX's packed state differed after any step, and rewards
  and `evaluate()` were equal to the last digit.
* **restored**: the largest difference of any number of the state {again} control steps after a restore, from the uninterrupted
  run, and in brackets from the run after a second restore. PhysX does not expose its contact caches, so bodies in
  contact continue slightly differently; see the docstring of `workbench/envs/snapshots/snapshot.py`.
* **seconds**: the whole row except *like stock*, on {cores} CPU cores that also rendered the pictures in software; only for
  comparing rows.

| id | robot | outcome | like stock | restored | seconds | note |
|---|---|---|---|---|---:|---|
"""

_WORDS = {"passed": "passed", "upstream": "its own fault", "download": "download"}


def page(rows: Sequence[dict]) -> str:
    """Return the docs page in Markdown."""
    from importlib.metadata import version

    from tests.sweeps.exercise_task import ACTIONS, NUM_ENVS, STEPS_AGAIN
    from tests.sweeps.follow_stock import PLACE, STEPS

    head = _HEAD.format(
        mani_skill=version("mani_skill"),
        sapien=version("sapien"),
        count=len(rows),
        num_envs=NUM_ENVS,
        actions=ACTIONS,
        place=PLACE,
        steps=STEPS,
        again=STEPS_AGAIN,
        cores=len(os.sched_getaffinity(0)),
        totals=_totals(rows),
    )
    return head + "\n".join(_line(row) for row in sorted(rows, key=lambda row: row["env_id"])) + "\n"


def _totals(rows: Sequence[dict]) -> str:
    ships = [row for row in rows if row["outcome"] != "download"]
    works = [row for row in ships if row["outcome"] in ("passed", "upstream")]
    own = sum(row["outcome"] == "upstream" for row in rows)
    bits = sum(row["like_stock"].startswith("bit for bit") for row in rows)
    return (
        f"{len(ships)} ids ship in the wheel. {len(works)} of them work, {own} of these except for a fault of the "
        f"task itself. {bits} equal stock bit for bit. {len(rows) - len(ships)} need a download."
    )


def _line(row: dict) -> str:
    outcome = _WORDS.get(row["outcome"], f"**{row['outcome']}**")
    notes = row["notes"]
    if row["outcome"] == "download":
        notes = [f"`python -m mani_skill.utils.download_asset {name}`" for name in notes]
    seconds = "" if row["outcome"] == "download" else f"{row['seconds']:.0f}"
    cells = [
        row["env_id"],
        row["robot"],
        outcome,
        row["like_stock"],
        _restored(row),
        seconds,
        "; ".join(notes),
    ]
    return "| " + " | ".join(cell.replace("|", "\\|").replace("\n", " ") for cell in cells) + " |"


def _restored(row: dict) -> str:
    return "" if not row["after_restore"] else "{:.0e} ({:.0e})".format(*row["after_restore"])


def registered_ids() -> list[str]:
    import mani_skill.envs  # noqa: F401  registers the ids
    from mani_skill.utils.registration import REGISTERED_ENVS

    return sorted(
        env_id for env_id, spec in REGISTERED_ENVS.items() if spec.cls.__module__.startswith("mani_skill.")
    )


def main(arguments: Sequence[str]) -> int:
    if arguments[:1] == ["--in-this-process"]:
        try_here(arguments[1:])
        return 0
    rows = []
    for row in sweep(arguments or registered_ids()):
        print(_line(row), flush=True)
        rows.append(row)
    if not arguments:
        PAGE.parent.mkdir(exist_ok=True)
        PAGE.write_text(page(rows))
        print(f"{_totals(rows)} Written to {PAGE.relative_to(REPOSITORY)}.")
    return int(any(row["outcome"] not in _WORDS for row in rows))


if __name__ == "__main__":
    sys.path.insert(0, str(REPOSITORY))
    sys.exit(main(sys.argv[1:]))
