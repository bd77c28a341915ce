"""Notices of refusals."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Literal

import viser


def notify_all(
    server: viser.ViserServer,
    title: str,
    text: str,
    color: Literal["orange", "red"] | None = "orange",
    seconds: float | None = None,
) -> None:
    """Notify every open page: a key event does not tell on which page the key was pressed."""
    for client in server.get_clients().values():
        client.add_notification(title, text, color=color, auto_close_seconds=seconds)


@contextmanager
def refusals_shown(
    client: viser.ClientHandle | None,
    title: str = "Not possible",
    then: Callable[[], None] = lambda: None,
) -> Iterator[None]:
    """Catch a ValueError of the block and show it on the page that sent the command."""
    try:
        yield
    except ValueError as error:
        then()
        if client is not None:
            client.add_notification(title, str(error), color="orange", auto_close_seconds=8.0)
