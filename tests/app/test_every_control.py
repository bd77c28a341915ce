"""Every command, with any values that a page can send, on the start page, the live page and the review."""

from __future__ import annotations

import functools
import random
from collections.abc import Iterator
from typing import Any

import msgspec
import pytest

from tests.drive.episodes import made, write
from tests.drive.knocking import client
from tests.drive.panels import inputs_of
from tests.drive.scripted import scripted
from tests.drive.session import wait_until
from workbench.app.server import App
from workbench.app.session import Session
from workbench.commands import COMMANDS
from workbench.library.commands import OpenRow
from workbench.page.command import Command, Refused, name_of
from workbench.page.commands import ShowLive, ShowRecordings
from workbench.page.door.gated_server import ServerOptions, open_server
from workbench.review.commands import ContinueLive
from workbench.start.commands import CreateTask, OpenFoundTask, OpenListedTask
from workbench.task.description import TaskOptions

NASTY = (
    *(None, False, True, 0, 1, 2, 0.5, -1, 1e30, 2**63, -(2**63), 1e308, float("nan"), float("inf")),
    *("", "x", "x" * 20_000, "a\nb", "\x1b[31m\0", "../../etc/passwd", "99999999999999999999999"),
    *([], [1.0], ["a", "b", "c"], [0] * 1000, [[[]]], {}, {"value": 1}),
)
LEAVES = (ShowRecordings, ShowLive, ContinueLive, OpenRow, OpenListedTask, OpenFoundTask, CreateTask)
"""Commands that may show another page."""


@pytest.fixture(scope="module")
def app(child_process: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[App]:
    folder = tmp_path_factory.mktemp("recordings")
    write(folder, made(5))
    gated_server = open_server(ServerOptions(port=0))
    make_session = functools.partial(Session, recordings=folder, make_worker=scripted(2))
    session = make_session(str(folder / "push.py"), TaskOptions(num_envs=2))
    app = App(gated_server, folder, make_session, TaskOptions(), session)
    # Otherwise a process would list ManiSkill's tasks.
    app.open_task.catalogue.registered.close()
    app.shared.pages.start("live")
    wait_until(session, lambda view: view.task is not None, "the task")
    with client(gated_server):
        yield app
    app.close()
    session.close()
    gated_server.close()


def with_values(kind: type[Command], seed: int) -> Iterator[Command]:
    """Instances of this command with values from `NASTY` for each field type."""
    choose = random.Random(seed)
    taken: dict[str, list[Any]] = {}
    for field in msgspec.structs.fields(kind):
        literal = getattr(msgspec.inspect.type_info(field.type), "values", ())
        taken[field.encode_name] = []
        for value in (*NASTY, *literal):
            try:
                taken[field.encode_name].append(msgspec.convert(value, field.type))
            except msgspec.ValidationError:
                continue
    for _ in range(4):
        fields = {name: choose.choice(values) for name, values in taken.items() if values}
        try:
            yield COMMANDS.decode(name_of(kind), fields)
        except Refused:
            continue


@pytest.mark.parametrize("which", ["start", "live", "review"])
def test_a_command_succeeds_or_is_refused_with_a_reason(app: App, which: Any) -> None:
    app.shared.pages.show(which).result(60)
    assert inputs_of(app.shared.server.gui) == [], "viser's own inputs are not ordered relative to commands"
    (visitor,), done = app.shared.visitors.all(), 0
    for kind in COMMANDS:
        if kind in LEAVES:
            continue
        for command in with_values(kind, seed=1):  # the same values each time
            try:
                app.shared.visitors.do(command, visitor)
                done += 1
            except Refused as reason:
                assert str(reason).strip()
    assert done > {"start": 3, "live": 60, "review": 30}[which]
    assert app.shared.pages.shown == which
