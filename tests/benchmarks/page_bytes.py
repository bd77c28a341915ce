"""Bytes per update of the page while the task plays: python tests/benchmarks/page_bytes.py [--num-envs 16 64 256] [--write]

The whole live page of the example task runs on its real server in this process. The envs make random steps; at 30 Hz and
four times real time an update shows every 2.67th step. The page's clock advances by 1/30 s per update, so the numbers do
not depend on the machine's speed. A client without a browser reads the data behind a relay that counts the bytes.

Both sides play the same steps. *Exact*: a client without compression, whose field of view is so narrow that it sees every
motion and gets every pose in full. *As sent*: a view of 1280 x 720 over a slow connection. Prints the kilobytes per update,
the panels' and poses' part of them before compression, the rate per second at 30 Hz, and the server's CPU time per update:
for drawing panels and poses, and in viser's thread, which encodes, compresses and sends.
"""

from __future__ import annotations

import asyncio
import queue
import sys
import tempfile
import threading
import time
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from websockets.asyncio.client import connect

sys.path.append(str(Path(__file__).parents[2]))
from tests.benchmarks.table import Row, keep
from tests.drive.far_line import FarLine, line_to
from tests.drive.page import TASK
from tests.drive.panels import Clock
from tests.drive.scripted import ScriptedWorker, no_success
from tests.drive.session import wait_until
from tests.drive.tabs import camera_message, handshake, messages_in
from workbench.app.live_page import Page
from workbench.app.session import Session
from workbench.commands import COMMANDS
from workbench.envs import action_vector as actions
from workbench.envs.step_result import StepResult
from workbench.live.messages import Status
from workbench.page.door.gated_server import ServerOptions, open_server
from workbench.page.scene.viewpoint import FOV_RADIANS, View3D
from workbench.page.widgets.visitors import Visitors
from workbench.task.description import Stepped, TaskDescription, TaskOptions
from workbench.task.open import open_task

HERTZ, SPEED, EPISODE = 30, 4.0, 50
DELAY_SECONDS = 0.01
"""One-way delay of the connection."""
KEPT_ENVS = 64


@dataclass
class Options:
    num_envs: tuple[int, ...] = (16, 64, 256)
    updates: int = 90
    settle: int = 15
    """Updates before the measured ones, during which the page's charts fill."""
    write: bool = False
    """Write a row of the table of benchmarks, for `KEPT_ENVS` envs."""


@dataclass
class Played:
    task: TaskDescription
    first: StepResult
    steps: list[tuple[StepResult, bool]]
    """Each step, and whether it is a reset of all envs."""


def play(num_envs: int, count: int) -> Played:
    opened = open_task(str(TASK), TaskOptions(num_envs=num_envs, env_kwargs={"render_backend": "none"}))
    rng = np.random.default_rng(0)
    steps: list[tuple[StepResult, bool]] = []
    while len(steps) < count:
        for _ in range(EPISODE):
            steps.append((opened.env.step(actions.random_action(opened.env.parts, num_envs, rng)), False))
        steps.append((opened.env.reset(), True))
    played = Played(opened.description, opened.first, steps)
    opened.env.close()
    return played


class Player(ScriptedWorker):
    """A worker that sends one of the played steps on each call of `show`."""

    def __init__(self, played: Played, made: list[Player], *arguments: Any, **named: Any) -> None:
        super().__init__(played.task, played.first.poses, no_success, *arguments, **named)
        self._played = played
        made.append(self)

    def show(self, number: int) -> None:
        step, begins = self._played.steps[number]
        count = self._played.task.num_envs
        self.tell(
            Stepped(
                step,
                np.full(count, begins),
                seeds=np.arange(count) if begins else None,
                snapshot=b"a moment",
                part_keys=(),
                number=number + 10,
            )
        )
        if number % 20 == 0:
            self.tell(Status(True, 80.0, SPEED))

    def _at(self, poses: np.ndarray, elapsed: np.ndarray) -> StepResult:
        return self._played.first


@dataclass
class Client:
    """A page without a browser."""

    metadata: int = 0
    """Bytes of message metadata as packed by viser."""
    arrays: int = 0
    has: queue.Queue[str] = field(default_factory=queue.Queue)
    """The marks received so far."""

    async def read(self, address: str, options: dict[str, Any], greeting: bytes) -> None:
        async with connect(address, **options) as connection:
            await connection.send(greeting)
            async for frame in connection:
                assert isinstance(frame, bytes)
                packed = 16 + int.from_bytes(frame[8:16], "little")
                self.metadata += packed
                self.arrays += len(frame) - packed
                for message in messages_in(frame):
                    if message["type"] == "GuiUpdateMessage":
                        value = message["updates"].get("value")
                        if isinstance(value, str) and value.startswith("mark "):
                            self.has.put(value)


@dataclass(frozen=True)
class Update:
    """Means per update, in bytes unless noted."""

    wire: float
    metadata: float
    arrays: float
    rest: float
    """Bytes on the wire with nothing new to show."""
    draw: float
    """CPU seconds to draw panels and poses."""
    send: float
    """CPU seconds of viser's thread."""


def measure(played: Played, options: Options, exact: bool) -> Update:
    clock, made, client = Clock(), [], Client()
    others = set(threading.enumerate())
    gated = open_server(ServerOptions(port=0))
    (sender,) = set(threading.enumerate()) - others
    stage = View3D(gated.server, clock)
    with tempfile.TemporaryDirectory() as folder:
        session = Session(
            str(Path(folder) / "push.py"),
            TaskOptions(num_envs=played.task.num_envs),
            recordings=Path(folder) / "kept",
            make_worker=partial(Player, played, made),  # type: ignore[arg-type]
        )
        page = Page(gated.server, Visitors(gated.server, COMMANDS), session, stage=stage, clock=clock)
        mark = gated.server.gui.add_text("mark", "")
        wait_until(session, lambda view: view.timeline.moments == 1, "the first moment")
        page.redraw()
        with line_to(gated.url, delay=0.0 if exact else DELAY_SECONDS) as line:
            address, how = handshake(line.address(gated.url))
            how["compression"] = None if exact else "deflate"
            eye = gated.server.initial_camera.position
            greeting = camera_message(tuple(eye), width=1280, fov=1e-6 if exact else FOV_RADIANS)
            thread = threading.Thread(target=_run, args=(client, address, how, greeting), daemon=True)
            thread.start()
            while not gated.server.get_clients():
                time.sleep(0.01)
            update = _updates(page, session, made[0], clock, mark, client, line, sender, options)
    session.close()
    gated.close()
    thread.join(10.0)
    return update


def _run(client: Client, address: str, how: dict[str, Any], greeting: bytes) -> None:
    try:
        asyncio.run(client.read(address, how, greeting))
    except Exception as error:  # the server has closed
        client.has.put(f"closed: {error}")


def _updates(
    page: Page,
    session: Session,
    player: Player,
    clock: Clock,
    mark: Any,
    client: Client,
    line: FarLine,
    sender: threading.Thread,
    options: Options,
) -> Update:
    shown, updates, begun, drew = 0, 0, session.view().step_serial, 0.0

    def update(plays: bool) -> None:
        nonlocal shown, updates, drew
        updates += 1
        clock.passes(1 / HERTZ)
        while plays and shown < updates * SPEED / HERTZ / played_dt:
            player.show(shown)
            shown += 1
        if plays:
            wait_until(session, lambda view: view.step_serial >= begun + shown, "the step")
        drawing = time.thread_time()
        page.redraw()
        drew += time.thread_time() - drawing
        mark.value = f"mark {updates}"
        while client.has.get(timeout=60.0) != f"mark {updates}":
            pass

    played_dt = player._played.task.control_dt
    for _ in range(options.settle):
        update(plays=True)
    counts = lambda: (line.down, client.metadata, client.arrays, drew, processor_of(sender))  # noqa: E731
    before = counts()
    for _ in range(options.updates):
        update(plays=True)
    wire, metadata, arrays, draw, send = (
        (b - a) / options.updates for a, b in zip(before, counts(), strict=True)
    )
    for _ in range(HERTZ):
        update(plays=False)
    at_rest = line.down
    for _ in range(HERTZ):
        update(plays=False)
    return Update(wire, metadata, arrays, (line.down - at_rest) / HERTZ, draw, send)


def processor_of(thread: threading.Thread) -> float:
    """CPU seconds of the thread so far."""
    assert thread.ident is not None
    return time.clock_gettime(time.pthread_getcpuclockid(thread.ident))


def main(options: Options) -> None:
    torch.set_num_threads(1)
    print(
        "| envs | | kB per update | panels, kB | poses, kB | at 30 Hz, MB per second | paused, kB per update "
        "| CPU ms per update: drawing | viser's thread |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    count = int((options.updates + options.settle) * SPEED / HERTZ / 0.05) + 2
    for num_envs in options.num_envs:
        played = play(num_envs, count)
        rates = []
        for what, exact in (("exact", True), ("as sent", False)):
            found = measure(played, options, exact)
            rates.append(HERTZ * found.wire / 1e6)
            parts = found.wire, found.metadata, found.arrays
            print(
                f"| {num_envs} | {what} | {' | '.join(f'{part / 1e3:.1f}' for part in parts)} "
                f"| {HERTZ * found.wire / 1e6:.3f} | {found.rest / 1e3:.2f} "
                f"| {1e3 * found.draw:.1f} | {1e3 * found.send:.1f} |",
                flush=True,
            )
        if options.write and num_envs == KEPT_ENVS:
            what = f"Page through `ssh -L`: data while {num_envs} envs play at four times real time, against every pose in full"
            keep([Row(what, rates[1], rates[0], "MB/s", "less", "page_bytes.py")])


if __name__ == "__main__":
    main(tyro.cli(Options))
