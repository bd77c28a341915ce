"""The line to one page: how many bytes may be unanswered, and whether messages are compressed."""

from __future__ import annotations

import asyncio
import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

from websockets.asyncio.server import ServerConnection
from websockets.extensions import Extension
from websockets.extensions.permessage_deflate import PerMessageDeflate, ServerPerMessageDeflateFactory
from websockets.frames import Frame
from websockets.typing import ExtensionParameter

FAR = 0.003
"""Minimum round trip in seconds of a page that is far away."""
QUEUED = 0.05
"""Seconds that a message may wait behind others on the line."""
LATE = 0.25
"""Timeout in seconds, beyond the quickest round trip, after which a missing answer stops all further messages: the
line has become slower."""
SAMPLES = 20
"""Number of the last answers from which the line's rate is computed."""


@dataclass(frozen=True)
class _Sent:
    at: float
    size: int
    answered_before: int


class PageConnection:
    """Sends messages of viser to one page, as fast as it answers.

    A socket takes megabytes before it makes a sender wait, and so does ``ssh -L``: seconds on a slow line, and the answer
    to a click waits behind them. So each message is followed by a ping, which a browser answers when it has read what came
    before. While `send` waits viser gathers what changes, and sends the newest of it.

    All on the event loop of the connection.
    """

    def __init__(self, connection: ServerConnection) -> None:
        self._ping, self._send = connection.ping, connection.send
        self._deflate = next((e for e in connection.protocol.extensions if isinstance(e, WhenFar)), None)
        self._loop = asyncio.get_running_loop()
        # viser sends from two tasks: what is for all pages, and what is for this one.
        self._turn = asyncio.Lock()
        self._freed = asyncio.Event()
        self._sent: deque[_Sent] = deque()
        self._answered = 0
        self._rates: deque[float] = deque(maxlen=SAMPLES)
        self._trip = math.inf
        self.unanswered = 0
        """Bytes that were sent and that the page has not acknowledged."""

    async def send(self, message: bytes) -> None:
        """Send a message, as soon as there is room for it; ends with `websockets`' error when the page has left."""
        async with self._turn:
            if math.isinf(self._trip):
                # Before the first message, which may be the largest.
                await self._probe()
            while not self._has_room():
                self._freed.clear()
                await self._freed.wait()
            sent = _Sent(self._loop.time(), len(message), self._answered)
            await self._send(message)
            self.unanswered += sent.size
            self._sent.append(sent)
            (await self._ping()).add_done_callback(partial(self._on_answer, sent))  # type: ignore[attr-defined]

    async def _probe(self) -> None:
        began = self._loop.time()
        await (await self._ping())
        self._trip = self._loop.time() - began
        self._decide()

    def _has_room(self) -> bool:
        if not self._sent:
            return True
        if self._loop.time() - self._sent[0].at > self._trip + LATE:
            return False
        # One more message than has room, or large ones would never be two on the way.
        return self.unanswered <= max(self._rates, default=0.0) * (self._trip + QUEUED)

    def _on_answer(self, sent: _Sent, pong: asyncio.Future[float]) -> None:
        self._sent.remove(sent)
        self.unanswered -= sent.size
        self._freed.set()
        if pong.cancelled() or pong.exception() is not None:
            return  # the page has left, and the next message says so
        took = max(self._loop.time() - sent.at, 1e-6)
        self._answered += sent.size
        self._rates.append((self._answered - sent.answered_before) / took)
        self._trip = min(self._trip, took)
        self._decide()

    def _decide(self) -> None:
        if self._deflate is not None:
            self._deflate.on = self._trip >= FAR


class WhenFar(PerMessageDeflate):
    """Compresses what is sent while `on`.

    Poses that did not change are found in the messages before, 32 kB back. On the same machine there is nothing to gain.
    """

    on = False

    def encode(self, frame: Frame) -> Frame:
        return super().encode(frame) if self.on else frame


class CompressWhenFar(ServerPerMessageDeflateFactory):
    """Negotiates `WhenFar`; for ``extensions`` of `websockets`."""

    def __init__(self) -> None:
        # Level 3: level 6 saves a sixth more for twice the time. The page's own messages are short.
        super().__init__(client_max_window_bits=10, compress_settings={"level": 3})

    def process_request_params(
        self, params: Sequence[ExtensionParameter], accepted_extensions: Sequence[Extension]
    ) -> tuple[list[ExtensionParameter], PerMessageDeflate]:
        answer, agreed = super().process_request_params(params, accepted_extensions)
        return answer, WhenFar(
            agreed.remote_no_context_takeover,
            agreed.local_no_context_takeover,
            agreed.remote_max_window_bits,
            agreed.local_max_window_bits,
            agreed.compress_settings,
        )
