"""What the commands that serve a page do with a task's events, signals and an end; page and worker are replaced."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from tests.drive.scenes import description, step_of, table_scene
from workbench.cli import page as module
from workbench.cli.page import open_in_terminal, review_in_terminal, start_in_terminal
from workbench.live.messages import Loaded, TaskFailed
from workbench.live.process.supervisor import WorkerOptions
from workbench.machine.preferences import Preferences
from workbench.page.door.gated_server import ServerOptions
from workbench.task.description import TaskOptions
from workbench.task.problem import Problem

PROBLEM = Problem("step", "it broke", "task.py", 3, "1 / 0", "")
GEOMETRY, POSES = table_scene(2)
LOADED = Loaded(description(GEOMETRY), step_of(POSES), {"build": 1.0})
OPTIONS = TaskOptions(4, rules="stop", imports=("ids",), env_kwargs={"size": 1, "render_backend": "none"})
WORKER = WorkerOptions(1 << 30, True, 5678, True)


class Machine:
    """The server, the pages and the sessions of a command; `script` runs once the pages have begun."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, **server: Any) -> None:
        self.script: Callable[[], object] = lambda: self.signal(signal.SIGINT)
        self.did: list[str] = []
        self.sessions: list[Any] = []
        self.app: Any = None
        self.first = ""
        self.recent: list[tuple[str, TaskOptions]] = []
        self.writes = 0
        """Number of episodes that are still to be written; closing hangs until they are."""
        self.written = 0
        self.hangs: threading.Event | None = None
        self._handlers: dict[int, Callable[[], object]] = {}
        self.server = SimpleNamespace(
            options=ServerOptions(**server),
            warning="anyone can open it",
            notice=None,
            url="http://page",
            ssh_hint="ssh -L",
            addresses=lambda: ["http://page", "http://elsewhere"],
            renew_token=lambda: self.did.append("renewed"),
            close=lambda: self.did.append("server closed"),
        )
        recents = SimpleNamespace(add=lambda reference, options: self.recent.append((reference, options)))
        for name, value in {
            "open_server": lambda at, label: self.server,
            "App": self.make_app,
            "Session": self.make_session,
            "RecentTasks": lambda: recents,
            "on_signal": self._handlers.__setitem__,
            "use_private_driver": lambda: None,
            "start_reading": lambda: self.did.append("readers"),
            "preferences": lambda: Preferences(check_after_save=False),
        }.items():
            monkeypatch.setattr(module, name, value)

        def leave(code: int) -> None:
            raise SystemExit(code)

        monkeypatch.setattr(module.os, "_exit", leave)
        monkeypatch.setattr(module, "CLOSING_SECONDS", 0.05)

    def signal(self, number: signal.Signals) -> None:
        self._handlers[number]()

    def make_app(self, *given: Any) -> Any:
        pages = SimpleNamespace(start=self.start)
        self.app = SimpleNamespace(
            given=given, shared=SimpleNamespace(pages=pages, sessions=[self]), renew_token=None
        )
        self.app.finish_saving = lambda seconds: self.did.append("saved")
        self.app.close = self.close
        return self.app

    @property
    def episodes_written(self) -> int:
        if self.writes:
            self.writes, self.written = self.writes - 1, self.written + 1
            if not self.writes and self.hangs is not None:
                self.hangs.set()
        return self.written

    def close(self) -> None:
        if self.hangs is not None:
            self.hangs.wait(60)
        self.did.append("app closed")

    def start(self, first: str) -> None:
        self.first = first
        self.script()

    def make_session(self, task: Any, options: TaskOptions, **given: Any) -> Any:
        session = SimpleNamespace(task=task, options=options, given=given, changed={})
        session.change = lambda **changes: session.changed.update(changes)
        self.sessions.append(session)
        return session

    def event(self, event: Any) -> None:
        self.sessions[0].given["on_event"](event)

    def run(self, command: Any, *given: Any, **named: Any) -> int:
        with pytest.raises(SystemExit) as ended:
            command.__wrapped__(*given, **named)
        return int(ended.value.code or 0)

    def open(self, task: str, **named: Any) -> int:
        return self.run(
            open_in_terminal, task, OPTIONS, ServerOptions(), WORKER, Path("rec"), 99, True, "my://", **named
        )


def test_a_files_page_opens_before_the_file_loads_and_outlives_its_failures(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    machine = Machine(monkeypatch)
    other = replace(OPTIONS, num_envs=9, seed=3)

    def script() -> None:
        for event in (
            TaskFailed(PROBLEM, kept=False),
            replace(LOADED, options=replace(OPTIONS, seed=5)),
            LOADED,
            replace(LOADED, options=other),
        ):
            machine.event(event)
        machine.signal(signal.SIGTERM)

    machine.script = script
    assert machine.open("/w/task.py", pictures="fast") == 0 and machine.first == "live"
    out, err = capsys.readouterr()
    assert (
        out.count("http://page") == 1 and out.count("http://elsewhere") == 1 and "anyone can open it" in err
    )
    assert machine.recent == [
        ("/w/task.py", OPTIONS), ("/w/task.py", OPTIONS), ("/w/task.py", replace(other, seed=0)),
    ]  # fmt: skip
    assert machine.did == ["readers"] * 3 + ["saved", "app closed", "server closed"]
    (session,) = machine.sessions
    assert (session.task, session.options, session.changed) == ("/w/task.py", OPTIONS, {"pictures": "fast"})
    assert session.given["recordings"] == Path("rec") and session.given["history_bytes"] == 99
    assert session.given["worker"] == WORKER and session.given["check"] is False
    server, recordings, for_recording, base, first, tasks, trust, _, editor, choices = machine.app.given
    assert (server, recordings, first, tasks, trust, editor) == (
        machine.server,
        Path("rec"),
        session,
        (),
        True,
        "my://",
    )
    assert base == TaskOptions(rules="stop", imports=("ids",))
    assert choices.options == replace(OPTIONS, env_kwargs={"render_backend": "none"})
    # A recording's task gets no debugger and no spare, and does not become a recent task.
    of_recording = for_recording("Push-v1", TaskOptions(1))
    assert of_recording.given["worker"] == WorkerOptions(1 << 30)
    of_recording.given["on_event"](LOADED)
    assert len(machine.recent) == 3
    kept: Any = object()
    again = choices.open_session("/w/other.py", TaskOptions(2), kept)
    assert again.given["kept"] is kept and again.changed == {}, "it keeps how pictures are drawn"
    again.given["on_event"](LOADED)
    assert machine.recent[-1] == ("/w/other.py", TaskOptions(2))


def test_an_ids_page_opens_when_it_is_loaded_and_a_failure_before_ends_the_command(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    machine = Machine(monkeypatch)

    def script() -> None:
        machine.event(TaskFailed(PROBLEM, kept=True))
        assert "http://page" not in capsys.readouterr().out
        machine.event(LOADED)
        machine.event(LOADED)
        machine.signal(signal.SIGINT)

    machine.script = script
    assert machine.open("Push-v1") == 0
    assert capsys.readouterr().out.count("http://page") == 1
    assert [reference for reference, _ in machine.recent] == ["Push-v1"], "only what could be loaded"
    machine = Machine(monkeypatch)
    machine.script = lambda: machine.event(TaskFailed(PROBLEM, kept=False))
    assert machine.open("Push-v1") == 1 and machine.recent == []
    assert "http://page" not in capsys.readouterr().out
    assert machine.did == ["saved", "app closed", "server closed"]


def test_the_other_pages_begin_without_a_task(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    machine = Machine(monkeypatch)
    given = OPTIONS, ServerOptions(), WORKER, Path("rec"), 99, True, "my://"
    assert machine.run(start_in_terminal, *given) == 0 and machine.first == "start"
    assert machine.app.given[9].options == OPTIONS and machine.app.given[4] is None and machine.sessions == []
    assert (machine.app.given[1], machine.app.given[6], machine.app.given[8]) == (Path("rec"), True, "my://")
    machine = Machine(monkeypatch)
    tasks = (Path("a.py"),)
    base = TaskOptions(rules="off")
    assert (
        machine.run(review_in_terminal, Path("made"), tasks, ServerOptions(), WORKER, base, False, "e") == 0
    )
    assert (
        machine.first == "review" and machine.app.given[1] == Path("made") and machine.app.given[5] == tasks
    )
    assert machine.app.given[3].rules == "off" and machine.app.given[6] is False
    assert capsys.readouterr().out.count("http://page") == 2


@pytest.mark.parametrize("token", [True, False])
def test_the_token_is_renewed_on_request(
    token: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    machine = Machine(monkeypatch, token=token)

    def script() -> None:
        machine.signal(signal.SIGUSR1)
        if machine.app.renew_token is not None:
            machine.app.renew_token()
        machine.signal(signal.SIGINT)

    machine.script = script
    assert machine.open("/w/task.py") == 0
    assert machine.did.count("renewed") == (2 if token else 0)
    assert capsys.readouterr().out.count("http://page") == (3 if token else 1)


def test_a_socket_is_printed_with_the_command_that_reaches_it(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    machine = Machine(monkeypatch, socket=tmp_path / "s")
    assert machine.open("/w/task.py") == 0
    out = capsys.readouterr().out
    assert (
        all(one in out for one in (str(tmp_path / "s"), "ssh -L", "http://page")) and "elsewhere" not in out
    )


def test_a_server_that_cannot_start_is_refused(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    machine = Machine(monkeypatch)

    def fail(at: ServerOptions, label: str) -> None:
        raise module.ServerError("the port is taken")

    monkeypatch.setattr(module, "open_server", fail)
    given = ServerOptions(), WORKER
    for command, call in (
        (open_in_terminal, ("task.py", OPTIONS, *given, Path("rec"), 99)),
        (start_in_terminal, (OPTIONS, *given, Path("rec"), 99)),
        (review_in_terminal, (Path("made"), (), *given, OPTIONS)),
    ):
        assert command.__wrapped__(*call) == 2  # type: ignore[attr-defined]
    assert capsys.readouterr().err.count("the port is taken") == 3 and machine.app is None


@pytest.mark.parametrize("writes", [0, 5])
def test_a_hanging_disk_does_not_keep_the_command_but_episodes_being_written_do(
    writes: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    machine = Machine(monkeypatch)
    machine.hangs, machine.writes = threading.Event(), writes
    assert machine.open("/w/task.py") == 0
    assert ("app closed" in machine.did) == bool(writes) and machine.did[-1] == "server closed"
    assert ("recovered" in capsys.readouterr().err) != bool(writes)
    machine.hangs.set()
