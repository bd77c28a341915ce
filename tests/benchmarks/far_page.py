"""Response time of a page behind a slow connection: python tests/benchmarks/far_page.py [--num-envs 16 64] [--against CHECKOUT]

The live page of the example task plays on its real server in this process, behind a relay with 2 Mbit/s, a round trip
of 80 ms and a buffer of 2 MB (like ``ssh -L``). A client without a browser answers pings as a browser does, presses Play
or Pause, and waits for the button's new label. The largest backlog of the relay is printed in seconds of transmission.

``--against`` first measures another checkout (an older version), in the same run.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import queue
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import torch
import tyro
import viser._messages
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed

# Appended last, because the measured checkout may be another one.
sys.path.append(str(Path(__file__).parents[2]))
from tests.benchmarks.page_bytes import Played, Player, play
from tests.drive.far_line import FarLine, line_to
from tests.drive.session import wait_until
from tests.drive.tabs import camera_message, handshake, messages_in
from workbench.app.live_page import Page
from workbench.app.pages import Pages
from workbench.app.session import Session
from workbench.commands import COMMANDS
from workbench.page.door.gated_server import ServerOptions, open_server
from workbench.page.scene.viewpoint import FOV_RADIANS, View3D
from workbench.page.widgets.visitors import Visitors
from workbench.task.description import TaskOptions

BITS_PER_SECOND, DELAY_SECONDS = 2e6, 0.04
COMMAND = "Play or pause"


@dataclass
class Options:
    num_envs: tuple[int, ...] = (16, 64, 256)
    against: Path | None = None
    presses: int = 12
    side: str = "now"
    """Label of the rows."""


class Playing(Player):
    """A worker that plays its steps in a loop."""

    shown = 0

    def _step(self) -> None:
        self.show(self.shown % len(self._played.steps))
        self.shown += 1


@dataclass
class Client:
    commands: dict[str, str] = field(default_factory=dict)
    labels: queue.Queue[str] = field(default_factory=queue.Queue)
    counts: Counter[str] = field(default_factory=Counter)
    connection: ClientConnection | None = None
    loop: asyncio.AbstractEventLoop | None = None

    async def read(self, address: str, options: dict[str, Any], greeting: bytes) -> None:
        self.loop = asyncio.get_running_loop()
        async with connect(address, **options) as self.connection:
            await self.connection.send(greeting)
            # The loop ends when the server closes, even without a closing handshake.
            with contextlib.suppress(ConnectionClosed):
                await self._take_all(self.connection)

    async def _take_all(self, connection: ClientConnection) -> None:
        async for frame in connection:
            assert isinstance(frame, bytes)
            for message in messages_in(frame):
                kind = message["type"]
                if kind == "RegisterCommandMessage":
                    self.commands[message["props"]["label"]] = message["uuid"]
                elif kind == "GuiUpdateMessage" and message["updates"].get("label") in ("Play", "Pause"):
                    self.labels.put(message["updates"]["label"])
                elif "panda_hand" in str(message.get("name")):
                    self.counts["poses"] += 1

    def press(self, expected: str) -> float:
        """Press the button; returns the seconds until it has the expected label."""
        message = viser._messages.CommandTriggerMessage(self.commands[COMMAND])
        began = time.perf_counter()
        assert self.connection is not None and self.loop is not None
        sending = self.connection.send(msgspec.msgpack.encode(message.as_serializable_dict()))
        asyncio.run_coroutine_threadsafe(sending, self.loop)
        while self.labels.get(timeout=60.0) != expected:
            pass
        return time.perf_counter() - began


def watched(line: FarLine, seconds: float) -> int:
    """The largest number of bytes that waited in the line during these seconds."""
    most, end = 0, time.monotonic() + seconds
    while time.monotonic() < end:
        most = max(most, line.waiting)
        time.sleep(0.01)
    return most


def measure(played: Played, options: Options) -> str:
    made: list[Player] = []
    client = Client()
    gated = open_server(ServerOptions(port=0))
    with tempfile.TemporaryDirectory() as folder:
        session = Session(
            str(Path(folder) / "push.py"),
            TaskOptions(num_envs=played.task.num_envs),
            recordings=Path(folder) / "kept",
            make_worker=partial(Playing, played, made),  # type: ignore[arg-type]
        )
        stage = View3D(gated.server)
        page = Page(gated.server, Visitors(gated.server, COMMANDS), session, stage=stage)
        pages = Pages(gated.server, stage, lambda which, dark: page)
        wait_until(session, lambda view: view.timeline.moments == 1, "the first moment")
        page.redraw()
        pages.start("live")
        with line_to(gated.url, BITS_PER_SECOND, DELAY_SECONDS) as line:
            address, how = handshake(line.address(gated.url))
            how["compression"] = "deflate"
            greeting = camera_message(
                tuple(gated.server.initial_camera.position), width=1280, fov=FOV_RADIANS
            )
            coming = client.read(address, how, greeting)
            thread = threading.Thread(target=lambda: asyncio.run(coming), daemon=True)
            thread.start()
            while COMMAND not in client.commands or line.waiting:
                time.sleep(0.1)
            time.sleep(2.0)
            times, most = [client.press("Pause")], 0
            time.sleep(3.0)
            poses, began = client.counts["poses"], time.monotonic()
            for _ in range(options.presses // 2):
                most = max(most, watched(line, 1.5))
                times.append(client.press("Play"))
                most = max(most, watched(line, 0.3))
                times.append(client.press("Pause"))
            # Each update has two messages: positions and rotations.
            rate = (client.counts["poses"] - poses) / 2 / (time.monotonic() - began)
            pages.stop()
            session.close()
            gated.close()
            thread.join(20.0)
    return (
        f"| {played.task.num_envs} | {options.side} | {1000 * statistics.median(times):.0f} "
        f"| {1000 * max(times):.0f} | {8 * most / BITS_PER_SECOND:.2f} | {rate:.1f} |"
    )


def _measure_other(checkout: Path, num_envs: int, presses: int) -> None:
    with tempfile.TemporaryDirectory() as folder:
        # Without its tests: this script needs the tests of its own checkout.
        for name in ("workbench", "web_assets"):
            (Path(folder) / name).symlink_to(checkout / name)
        arguments = ["--num-envs", str(num_envs), "--side", "before", "--presses", str(presses)]
        subprocess.run(
            [sys.executable, __file__, *arguments], env={**os.environ, "PYTHONPATH": folder}, check=True
        )


def main(options: Options) -> None:
    torch.set_num_threads(1)
    if options.side == "now":
        print(
            "| envs | | Play or Pause, ms: median | worst | largest backlog, s of the line | updates per second |"
        )
        print("|---|---|---|---|---|---|", flush=True)
    for num_envs in options.num_envs:
        if options.against is not None:
            _measure_other(options.against.resolve(), num_envs, options.presses)
        print(measure(play(num_envs, 102), options), flush=True)


if __name__ == "__main__":
    main(tyro.cli(Options))
