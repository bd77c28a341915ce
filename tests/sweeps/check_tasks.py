"""All rules of `workbench check` over every id in ManiSkill's registry that needs no download.

    python -m tests.sweeps.check_tasks                  all ids, into check_tasks.json
    python -m tests.sweeps.check_tasks PickCube-v1 ...  some ids
    python -m tests.sweeps.check_tasks --select RULE    one rule, e.g. after it changed

Each id runs in its own process, so a crash or a hang is one row. The process has no standard input and no network, and
its ManiSkill download folder is empty. A person reads the findings and reports them in
web_assets/docs/reference/checked_tasks.md.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

from tests.sweeps.task_ids import refuse_the_network, registered_ids

FILE = Path("check_tasks.json")
NUM_ENVS = 4
SEEDS = 8
LIMIT_SECONDS = 900.0
"""Timeout for one id: the slowest needs 60 s on an idle core, and a busy machine gives it a tenth of a core."""
CRASHES = ("crashed", "hung")


def sweep(
    ids: Sequence[str], workers: int, limit: float = LIMIT_SECONDS, select: tuple[str, ...] = ()
) -> Iterator[dict[str, Any]]:
    """Yield a row for each id as it finishes.

    Args:
        select: only these rules; empty for all.
    """
    with tempfile.TemporaryDirectory() as nothing_downloaded, ThreadPoolExecutor(workers) as pool:
        os.environ["MS_ASSET_DIR"] = nothing_downloaded
        # Fork from a server that has imported everything (10 s) and holds no other state.
        context = multiprocessing.get_context("forkserver")
        context.set_forkserver_preload(["mani_skill.envs", "workbench.checks.job"])
        for done in as_completed([pool.submit(_row, context, env_id, limit, select) for env_id in ids]):
            yield done.result()


def _row(context: Any, env_id: str, limit: float, select: tuple[str, ...]) -> dict[str, Any]:
    receiver, sender = context.Pipe(duplex=False)
    child = context.Process(target=check_here, args=(env_id, select, sender))
    begun = time.monotonic()
    child.start()
    sender.close()
    try:
        row = (
            receiver.recv()
            if receiver.poll(limit)
            else {"outcome": "hung", "why": f"nothing in {limit:.0f} s"}
        )
    except EOFError:
        child.join()
        row = {"outcome": "crashed", "why": f"the process ended with status {child.exitcode}"}
    child.kill()
    child.join()
    return {"env_id": env_id, "wall": round(time.monotonic() - begun, 1), **row}


# --- in the child ------------------------------------------------------------------------------------


def check_here(env_id: str, select: tuple[str, ...], sender: Any) -> None:
    """Check one id and send its row."""
    # Discard the task's output and give it no standard input.
    nothing = os.open(os.devnull, os.O_RDWR)
    for stream in range(3):
        os.dup2(nothing, stream)
    refuse_the_network()
    try:
        row = _needs(env_id) or _checked(env_id, select)
    except Exception:
        row = {"outcome": "crashed", "why": traceback.format_exc()}
    sender.send(row)


def _needs(env_id: str) -> dict[str, Any] | None:
    """Return a row if the id needs a download or another package, else None."""
    import mani_skill.envs  # noqa: F401  registers the ids
    from mani_skill.utils.registration import REGISTERED_ENVS

    from workbench.envs.assets import MissingAssets
    from workbench.envs.task_env import EnvOptions, make_env

    spec = REGISTERED_ENVS[env_id]
    options = EnvOptions(1, "cpu", render=False, rules="off")
    with suppress(Exception):  # other errors are left to the checks
        try:
            make_env(
                spec.cls, options, asset_ids=spec.asset_download_ids or (), default_kwargs=spec.default_kwargs
            ).close()
        except MissingAssets as missing:
            return {"outcome": "download", "why": ", ".join(missing.names) or str(missing)}
        except ImportError as missing:
            return {"outcome": "package", "why": str(missing)}
    return None


def _checked(env_id: str, select: tuple[str, ...]) -> dict[str, Any]:
    from workbench.checks.job import check
    from workbench.checks.job_items import CheckOptions
    from workbench.task.description import TaskOptions

    what = CheckOptions(env_id, TaskOptions(num_envs=NUM_ENVS), seeds=SEEDS, select=select, workers=1)
    report = check(what)
    return {
        "outcome": "checked",
        "seconds": round(report.seconds - report.start_seconds, 1),
        "states": dict(Counter(result.state for result in report.results)),
        "findings": [asdict(finding) for finding in report.findings],
        "silenced": [asdict(one) for result in report.results for one in result.silenced],
        "notes": {result.rule: list(result.notes) for result in report.results if result.notes},
        "failed": {result.rule: result.why for result in report.of_state("failed")},
        "not_known": {result.rule: result.why for result in report.of_state("not_known")},
        "slowest": {
            result.rule: round(result.seconds, 1)
            for result in sorted(report.results, key=lambda result: -result.seconds)[:5]
        },
    }


# --- the report --------------------------------------------------------------------------------------


def line_of(row: dict[str, Any]) -> str:
    """Return one id's result as a line for the terminal."""
    if row["outcome"] != "checked":
        return f"{row['env_id']}: {row['outcome']}: {row['why']}"
    rules = Counter(finding["rule"] for finding in row["findings"])
    found = ", ".join(f"{rule} ({count})" for rule, count in rules.items()) or "nothing"
    failed = f"; failed: {', '.join(row['failed'])}" if row["failed"] else ""
    return f"{row['env_id']}: {found}{failed}; {row['seconds']} s"


def main(arguments: Sequence[str]) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m tests.sweeps.check_tasks",
        description="All rules over every id that needs no download.",
    )
    parser.add_argument("ids", nargs="*")
    parser.add_argument("--json", type=Path, default=FILE)
    parser.add_argument("--workers", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--select", action="append", default=[], help="only this rule; repeatable")
    parser.add_argument("--limit", type=float, default=LIMIT_SECONDS, help="timeout for one id in seconds")
    given = parser.parse_args(arguments)
    rows: list[dict[str, Any]] = []
    for row in sweep(given.ids or registered_ids(), given.workers, given.limit, tuple(given.select)):
        print(line_of(row), flush=True)
        rows.append(row)
        given.json.write_text(json.dumps(rows, indent=1))
    outcomes = Counter(row["outcome"] for row in rows)
    findings = sum(len(row.get("findings", ())) for row in rows)
    print(f"{dict(outcomes)}, {findings} findings. Written to {given.json}.")
    return int(any(outcomes[crash] for crash in CRASHES))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
