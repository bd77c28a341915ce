"""The command channel: numbered commands, in order, one reply each; an invalid message closes it."""

from __future__ import annotations

import asyncio
import json
import re
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from html import unescape
from typing import Any

import pytest
from websockets.exceptions import ConnectionClosed, InvalidHandshake
from websockets.sync.connection import Connection

from tests.drive.panels import Panels
from tests.drive.tabs import Tab, Tabs, open_channel, tabs_of
from tests.drive.waiting import TIMEOUT_SECONDS, until
from workbench.commands import COMMANDS
from workbench.live.commands import SetSeed, Step, TogglePlay
from workbench.live.env_commands import NextEnv, SelectEnv
from workbench.page.command import Command, Refused
from workbench.page.commands import ShowTab, ToggleTable
from workbench.page.door.gated_server import GatedServer
from workbench.page.widgets.keys_and_palette import register
from workbench.page.widgets.visitors import PATH, Done, Visitor, Visitors


@dataclass
class House:
    """Two open pages, and the commands that they sent."""

    gated_server: GatedServer
    visitors: Visitors
    tabs: Tabs
    opened: list[Tab]
    came: list[tuple[str, Command]] = field(default_factory=list)
    go_on: threading.Event = field(default_factory=threading.Event)

    def do(self, command: Command, visitor: Visitor) -> Done:
        match command:
            case NextEnv():
                return self._wait(command, visitor)
            case SelectEnv(env=env) if env > 3:
                raise Refused(f"There is no env {env}.")
            case TogglePlay():
                raise LookupError("of a test")
        self.came.append((visitor.name, command))
        return None

    async def _wait(self, command: Command, visitor: Visitor) -> None:
        async with asyncio.timeout(TIMEOUT_SECONDS):
            while not self.go_on.is_set():
                await asyncio.sleep(0.01)
        self.came.append((visitor.name, command))

    def names(self) -> list[str]:
        return [visitor.name for visitor in self.visitors.all()]

    def open(self, page: str, more: str = "") -> Connection:
        return open_channel(self.gated_server.url, page, more)


@pytest.fixture
def house(gated_server: GatedServer) -> Iterator[House]:
    visitors = Visitors(gated_server.server, COMMANDS)
    gated_server.add_channel(PATH, visitors.serve)
    with tabs_of(gated_server.url) as tabs:
        house = House(gated_server, visitors, tabs, [tabs.open(), tabs.open()])
        visitors.do = house.do
        until(lambda: len(house.names()) == 2, "both pages")
        yield house
        house.go_on.set()


def say(channel: Connection, number: int, name: str, **fields: Any) -> None:
    channel.send(json.dumps({"n": number, "do": [name, fields]}))


def reply(channel: Connection) -> dict[str, Any]:
    return json.loads(channel.recv(TIMEOUT_SECONDS))


def test_commands_run_in_order_and_each_is_answered(house: House) -> None:
    one, other = house.names()
    with house.open(one) as channel, house.open(other) as beside:
        for number in range(1, 21):
            say(channel, number, "select_env", env=number % 3)
        say(beside, 1, "step")
        assert [reply(channel) for _ in range(20)] == [{"n": number} for number in range(1, 21)]
        assert reply(beside) == {"n": 1}
    assert [command for who, command in house.came if who == one] == [
        SelectEnv(env=n % 3) for n in range(1, 21)
    ]
    assert (other, Step()) in house.came


def test_a_page_that_waits_does_not_block_another(house: House) -> None:
    one, other = house.names()
    with house.open(one) as channel, house.open(other) as beside:
        say(channel, 1, "next_env")
        say(channel, 2, "step")
        say(beside, 1, "step")
        assert reply(beside) == {"n": 1} and house.came == [(other, Step())]
        house.go_on.set()
        assert [reply(channel)["n"] for _ in range(2)] == [1, 2]


@pytest.mark.parametrize(
    ("name", "fields"),
    [
        ("select_env", {"env": 4}),
        ("select_env", {"env": "three"}),
        ("select_env", {}),
        ("select_env", {"env": 1, "more": 1}),
        ("set_seed", {"seed": 5_000_000_000}),
        ("set_seed", {"seed": 1.5}),
        ("set_seed", {"seed": -1}),
        ("set_seed", {"seed": "NaN"}),
        ("set_seed", {"seed": True}),
    ],
)
def test_invalid_fields_are_refused_with_a_reason_and_the_next_command_runs(
    house: House, name: str, fields: dict[str, Any]
) -> None:
    with house.open(house.names()[0]) as channel:
        say(channel, 1, name, **fields)
        say(channel, 2, "set_seed", seed=12)
        first, second = reply(channel), reply(channel)
    assert first["n"] == 1 and first["refused"].endswith(".") and second == {"n": 2}
    assert [command for _, command in house.came] == [SetSeed(seed=12)]


def test_a_failing_command_affects_nothing_else_and_its_page_is_told(
    house: House, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[str] = []
    monkeypatch.setattr(Visitor, "notify", lambda visitor, *words: told.append(visitor.name))
    with house.open(house.names()[0]) as channel:
        say(channel, 1, "toggle_play")
        say(channel, 2, "step")
        assert reply(channel)["refused"] and reply(channel) == {"n": 2}
        say(channel, 3, "select_env", env=4)
        assert reply(channel)["refused"]
    assert "of a test" in caplog.text and told == 2 * house.names()[:1]


@pytest.mark.parametrize(
    "raw",
    [
        "",
        "no json",
        "[]",
        '{"n": 1}',
        '{"n": "1", "do": ["step", {}]}',
        '{"n": 1, "do": ["step", {}], "also": 1}',
        '{"n": 1, "do": ["rm_rf", {}]}',
        '{"n": 1, "do": ["__class__", {}]}',
        "[" * 100_000,
        b"\xff\xfe",
    ],
)
def test_an_invalid_message_closes_only_its_own_connection(house: House, raw: str | bytes) -> None:
    one, other = house.names()
    with house.open(one) as channel, house.open(other) as beside:
        channel.send(raw)
        with pytest.raises(ConnectionClosed) as closed:
            channel.recv(TIMEOUT_SECONDS)
        assert closed.value.rcvd is not None and closed.value.rcvd.code == 1008
        say(beside, 1, "step")
        assert reply(beside) == {"n": 1}
    assert [command for _, command in house.came] == [Step()]


def test_a_client_that_is_not_an_open_page_is_refused(house: House) -> None:
    for name in ("", "made-up", house.names()[0][:-1]):
        with house.open(name) as channel, pytest.raises(ConnectionClosed):
            channel.recv(TIMEOUT_SECONDS)
    with pytest.raises(InvalidHandshake):
        open_channel(house.gated_server.url.replace("token=", "token=x"), house.names()[0])


def test_a_page_tells_its_width_and_is_gone_once_it_has_closed(house: House) -> None:
    one, other = house.visitors.all()
    for more, width in (
        ("&width=1234", 1234),
        ("&width=", 0),
        ("&width=99999", 99999),
        ("&width=999999", 0),
        ("&width=-5", 0),
    ):
        with house.open(one.name, more) as channel:
            say(channel, 1, "step")
            assert reply(channel) == {"n": 1} and (one.page_width, other.page_width) == (width, 0)
    house.tabs.close(house.opened[0])
    until(lambda: len(house.names()) == 1, "the end of one page")
    (left,) = house.names()
    gone = one.name if left == other.name else other.name
    with house.open(gone) as channel, pytest.raises(ConnectionClosed):
        channel.recv(TIMEOUT_SECONDS)
    with house.open(left) as channel:
        say(channel, 1, "step")
        assert reply(channel) == {"n": 1}


def test_the_palette_sends_the_commands_of_its_page_and_opens_its_tabs(panels: Panels) -> None:
    came: list[Command] = []
    panels.visitors.do = lambda command, visitor: came.append(command)
    group = panels.server.gui.add_tab_group()
    with group.add_tab("Run"), panels.server.gui.add_folder("Speed"):
        pass
    register(panels.server, panels.visitors, {Step, SelectEnv, ToggleTable}, "live", tabs=("Envs",))
    assert set(panels.commands()) == {Step.help(), ToggleTable.help(), "Envs tab", "Run tab", "Speed"}
    for label, command in (
        (Step.help(), Step()),
        ("Envs tab", ShowTab(tab="Envs")),
        ("Run tab", ShowTab(tab="Run")),
        ("Speed", ShowTab(tab="Run", fold="Speed")),
    ):
        panels.command(label)
        until(lambda: came, "the command")
        assert came.pop() == command
    keys = json.loads(unescape(re.findall("data-keys=[\"']([^\"']+)[\"']", panels.html("data-keys"))[0]))
    assert sorted(keys) == sorted([[Step.key, "live", "step", True], ["b", "page", "toggle_table", False]])


def test_each_command_has_a_description_and_a_unique_key() -> None:
    helps = [kind.help() for kind in COMMANDS]
    assert all(helps) and len(set(helps)) == len(helps)
    for kind, key in COMMANDS.keys().items():
        assert isinstance(kind(), Command) and key.command in COMMANDS, "a key sends default values"
