"""The connection to one page: flow control by unacknowledged bytes, and compression on slow connections."""

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

REMOTE_TRIP_SECONDS = 0.003
"""Minimum round trip of a page that counts as remote."""
MAX_QUEUE_SECONDS = 0.05
"""Longest time that a message may wait behind others in the connection."""
ANSWER_TIMEOUT_SECONDS = 0.25
"""Timeout for an answer, in addition to the shortest round trip. An answer that takes longer shows that the
connection has become slower: no message is sent until it arrives."""
SAMPLES = 20
"""Number of the last answers from which the connection's rate is computed."""


@dataclass(frozen=True)
class _Sent:
    at: float
    """Seconds of the event loop's clock."""
    size: int
    """Bytes."""
    answered_before: int
    """Bytes that the page had acknowledged when this message was sent."""


class PageConnection:
    """Sends viser's messages to one page as fast as it acknowledges them.

    A socket buffers megabytes before a sender has to wait, and so does ``ssh -L``. On a slow connection these
    megabytes take seconds, and the reply to a click waits behind them. So each message is followed by a ping,
    which a browser answers when it has read everything before the ping. While `send` waits, viser collects
    changes and later sends only the newest.

    Used on the event loop of the connection.
    """

    def __init__(self, connection: ServerConnection) -> None:
        self._ping, self._send = connection.ping, connection.send
        self._deflate = next((e for e in connection.protocol.extensions if isinstance(e, WhenFar)), None)
        self._loop = asyncio.get_running_loop()
        # viser sends from two tasks: messages for all pages, and messages for this one.
        self._turn = asyncio.Lock()
        self._freed = asyncio.Event()
        self._sent: deque[_Sent] = deque()
        self._answered = 0
        self._rates: deque[float] = deque(maxlen=SAMPLES)
        self._trip = math.inf
        self.unanswered = 0
        """Bytes that were sent but not acknowledged by the page."""

    async def send(self, message: bytes) -> None:
        """Send a message as soon as there is room; raises the error of `websockets` if the page has left."""
        async with self._turn:
            if math.isinf(self._trip):
                # Measure the round trip before the first message, which may be the largest.
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
        if self._loop.time() - self._sent[0].at > self._trip + ANSWER_TIMEOUT_SECONDS:
            return False
        # Allow one message beyond the limit: otherwise, two large messages would never be in transit at once.
        return self.unanswered <= max(self._rates, default=0.0) * (self._trip + MAX_QUEUE_SECONDS)

    def _on_answer(self, sent: _Sent, pong: asyncio.Future[float]) -> None:
        self._sent.remove(sent)
        self.unanswered -= sent.size
        self._freed.set()
        if pong.cancelled() or pong.exception() is not None:
            return  # the page has left; the next `send` raises
        took = max(self._loop.time() - sent.at, 1e-6)
        self._answered += sent.size
        self._rates.append((self._answered - sent.answered_before) / took)
        self._trip = min(self._trip, took)
        self._decide()

    def _decide(self) -> None:
        if self._deflate is not None:
            self._deflate.on = self._trip >= REMOTE_TRIP_SECONDS


class WhenFar(PerMessageDeflate):
    """Compresses sent messages while `on`.

    deflate finds unchanged poses in previous messages, up to 32 kB back. On the same machine compression
    gains nothing.
    """

    on = False

    def encode(self, frame: Frame) -> Frame:
        return super().encode(frame) if self.on else frame


class CompressWhenFar(ServerPerMessageDeflateFactory):
    """Negotiates `WhenFar`; for ``extensions`` of `websockets`."""

    def __init__(self) -> None:
        # Level 3: level 6 saves one sixth more for twice the time. A small window: messages from the page are
        # short.
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
