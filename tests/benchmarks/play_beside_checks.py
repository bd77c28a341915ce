"""Slowdown of playing while the Checks tab runs its checks: python tests/benchmarks/play_beside_checks.py [--num-envs 16]

A session with a worker on the example task plays without a page, at unlimited speed or (--speed 1) in real time. Windows
with and without a check of all rules in the background process alternate in one run. Prints the control steps per second
of both (median of the windows), their ratio, and the duration of a whole check while playing and while paused.
"""

from __future__ import annotations

import math
import statistics
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import tyro

sys.path.insert(0, str(Path(__file__).parents[2]))
from tests.drive.session import TASKS, live_session, wait_until
from workbench.app.session import Session
from workbench.checks.commands import CheckNow, StopChecks
from workbench.checks.state import RUNNING, ChecksView
from workbench.live.commands import PlayRun


@dataclass(frozen=True)
class Options:
    num_envs: int = 16
    seconds: float = 4.0
    """Length of one window."""
    windows: int = 5
    """Number of windows of each kind."""
    speed: float = math.inf
    """Speed relative to real time."""
    task: str = str(TASKS / "push_cube.py")


def steps_a_second(session: Session, seconds: float, checking: bool) -> float:
    """Control steps per second, where a step of all envs counts as one; with `checking` it ends with the last rule."""
    first, begun = session.view().timeline.last, time.perf_counter()
    while time.perf_counter() - begun < seconds:
        if checking and session.view().of(ChecksView).state != "checking":
            break
        time.sleep(0.02)
    return (session.view().timeline.last - first) / (time.perf_counter() - begun)


def begin_check(session: Session) -> None:
    session.do(CheckNow())
    wait_until(session, lambda view: view.of(ChecksView).state != "loading", "the start of the checks")


def whole_check(session: Session) -> float:
    """Seconds of a check of all rules, after the version was loaded in the background process."""
    begin_check(session)
    wait_until(session, lambda view: view.of(ChecksView).state not in RUNNING, "the end of the checks")
    return session.view().of(ChecksView).seconds


def main(options: Options) -> None:
    with (
        tempfile.TemporaryDirectory() as folder,
        live_session(options.task, Path(folder), options.num_envs, draw=True) as session,
    ):
        session.change(speed=options.speed)
        whole_check(session)  # compiles the shaders
        alone = whole_check(session)
        session.do(PlayRun())
        without, beside = [], []
        for _ in range(options.windows):
            session.do(StopChecks())
            without.append(steps_a_second(session, options.seconds, checking=False))
            begin_check(session)
            beside.append(steps_a_second(session, options.seconds, checking=True))
        took = whole_check(session)
        rules = len(session.view().of(ChecksView).results)
    one, other = statistics.median(without), statistics.median(beside)
    print(
        f"{Path(options.task).name}, {options.num_envs} envs, speed {options.speed:g}, {options.windows} windows of each kind"
    )
    print(
        f"control steps per second: {one:.1f} without checks, {other:.1f} during checks, ratio {other / one:.2f}"
    )
    print(f"{rules} rules: {took:.1f} s while playing, {alone:.1f} s while paused")


if __name__ == "__main__":
    main(tyro.cli(Options))
