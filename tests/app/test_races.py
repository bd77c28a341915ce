"""Concurrent presses on the pages of one server all count."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from websockets.sync.connection import Connection

from tests.drive.session import wait_until
from tests.drive.tabs import open_channel, tabs_of
from tests.drive.waiting import TIMEOUT_SECONDS, until
from workbench.app.server import App
from workbench.app.session import Session
from workbench.live.commands import Step
from workbench.live.env_commands import SelectEnv
from workbench.live.timeline_commands import Seek
from workbench.page.command import Command
from workbench.page.door.gated_server import GatedServer
from workbench.task.description import TaskOptions


def no_session(task: object, options: object) -> Session:
    raise AssertionError("no test here goes live from a recording")


class Pressing:
    """A page that sends commands without waiting and reads the replies later."""

    def __init__(self, channel: Connection) -> None:
        self._channel, self._sent = channel, 0

    def press(self, *commands: Command) -> None:
        for command in commands:
            self._sent += 1
            name, fields = command.encode()
            self._channel.send(json.dumps({"n": self._sent, "do": [name, fields]}))

    def hears(self, count: int = 1) -> list[dict[str, Any]]:
        return [json.loads(self._channel.recv(TIMEOUT_SECONDS)) for _ in range(count)]


class Two:
    """The live page in two browsers."""

    def __init__(self, session: Session, one: Pressing, other: Pressing) -> None:
        self.session, self.one, self.other = session, one, other

    @property
    def steps(self) -> int:
        return self.session.view().timeline.last


@pytest.fixture
def two(
    child_process: None, tmp_path: Path, gated_server: GatedServer, scripted_session: Callable[..., Session]
) -> Iterator[Two]:
    session = scripted_session(2)
    app = App(gated_server, tmp_path, no_session, TaskOptions(), session)
    app.shared.pages.start("live")
    with tabs_of(gated_server.url) as tabs:
        opened = [tabs.open(), tabs.open()]
        until(lambda: all(tab.open for tab in opened) and len(app.shared.visitors.all()) == 2, "both pages")
        one, other = (open_channel(gated_server.url, visitor.name) for visitor in app.shared.visitors.all())
        with one, other:
            yield Two(session, Pressing(one), Pressing(other))
    app.close()


def test_concurrent_presses_on_two_pages_each_count_once_and_in_order(two: Two) -> None:
    before, count = two.steps, 20
    # One page alternately selects an env and a missing env: the refusals show the order of its commands.
    in_turns: list[Command] = [SelectEnv(env=0), SelectEnv(env=7)] * (count // 2)
    pages = [(two.one, [Step()] * count), (two.other, [Step(), *in_turns])]
    threads = [threading.Thread(target=page.press, args=presses) for page, presses in pages]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert two.one.hears(count) == [{"n": number} for number in range(1, count + 1)]
    replies = two.other.hears(count + 1)
    assert [reply["n"] for reply in replies] == list(range(1, count + 2))
    assert ["refused" in reply for reply in replies] == [False, *[False, True] * (count // 2)]
    wait_until(two.session, lambda view: view.timeline.last >= before + count + 1, "all steps")
    two.one.press(SelectEnv(env=1))
    two.one.hears()
    view = wait_until(two.session, lambda view: view.selected_env == 1, "the last press")
    assert view.timeline.last == before + count + 1, "no press counts twice"


def test_a_slider_dragged_by_one_user_does_not_swallow_keys_of_another(two: Two) -> None:
    two.one.press(*[Step()] * 5)
    two.one.hears(5)
    wait_until(two.session, lambda view: view.timeline.last == 5, "some past")
    for count in range(1, 4):
        two.one.press(*(Seek(step=step % 5) for step in range(8)))
        two.other.press(Step())
        assert two.other.hears() == [{"n": count}]
        assert two.one.hears(8) == [{"n": 5 + 8 * (count - 1) + number} for number in range(1, 9)]
        wait_until(two.session, lambda view, last=5 + count: view.timeline.last == last, "the step")
