"""Foreign text only shows as text and colours in a terminal: real commands in a pseudo-terminal."""

from __future__ import annotations

import datetime
import http.client
import io
import logging
import os
import pty
import re
import select
import signal
import subprocess
import sys
import threading
import unicodedata
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.progress import BarColumn, Progress, TextColumn
from rich.style import Style
from rich.table import Table
from rich.text import Text

from tests.drive.episodes import made, write
from tests.drive.tabs import handshake
from tests.drive.waiting import until
from workbench.cli.output import SafeConsole, print_line, print_problem, print_text, refuse, warn
from workbench.library.folder import Library
from workbench.library.rows import cells
from workbench.live.process.captured_output import PrintedLine, StyledText
from workbench.machine.text import guard_terminal
from workbench.task.problem import Problem

TITLE = "\x1b]0;owned\x07"
CLIPBOARD = "\x1b]52;c;aGk=\x1b\\"
LINK = "\x1b]8;;http://127.0.0.1/\x1b\\press me\x1b]8;;\x1b\\"
EVIL = f"{TITLE}{CLIPBOARD}{LINK}\x1b[2J\x1b[H\x1b[10A\x9b2J\x90q\x9c\x1bc\x07\x08\u202eback"
BARS = re.compile("\x1b\\[(\\?25[lh]|1A|2K)|\r")
"""Cursor movements of our progress bars."""
COLOURS = re.compile("\x1b\\[[0-9;:]*m")


def harmful(text: str) -> set[str]:
    """Control characters in `text` except line ends and colours."""
    return {c for c in COLOURS.sub("", text) if unicodedata.category(c) == "Cc" and c not in "\n\t"}


class Terminal:
    """A command in a pseudo-terminal, and all of its output."""

    def __init__(self, folder: Path, *arguments: str) -> None:
        ours, theirs = pty.openpty()
        environment = {**os.environ, "TERM": "xterm-256color", "COLUMNS": "200", "PYTHONUNBUFFERED": "1"}
        environment.pop("NO_COLOR", None)
        self.process = subprocess.Popen(
            [sys.executable, "-m", "workbench.cli.main", *arguments],
            cwd=folder, env=environment, stdin=subprocess.DEVNULL, stdout=theirs, stderr=theirs, start_new_session=True,
        )  # fmt: skip
        os.close(theirs)
        self._ours = ours
        self._got = b""
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self) -> None:
        while True:
            if not select.select([self._ours], [], [], 1.0)[0]:
                continue
            try:
                piece = os.read(self._ours, 65536)
            except OSError:  # the other end was closed
                return
            self._got += piece

    @property
    def text(self) -> str:
        # The terminal driver writes line ends as \r\n.
        return self._got.decode(errors="replace").replace("\r\n", "\n")

    def wait_for(self, pattern: str, seconds: float = 90.0) -> re.Match[str]:
        return until(lambda: re.search(pattern, self.text), f"{pattern!r}", seconds, seen=lambda: self.text)

    def close(self) -> None:
        self.process.send_signal(signal.SIGINT)
        try:
            self.process.wait(timeout=30)
        finally:
            self.process.kill()
            self._thread.join(timeout=5)
            os.close(self._ours)


@contextmanager
def on_terminal(folder: Path, *arguments: str) -> Iterator[Terminal]:
    terminal = Terminal(folder, *arguments)
    try:
        yield terminal
    finally:
        terminal.close()


@pytest.mark.slow
def test_a_task_and_a_request_full_of_escapes_do_nothing_to_the_terminal(
    child_process: None, tmp_path: Path
) -> None:
    file = tmp_path / f"mine{TITLE}.py"
    file.write_text(
        f"import sys, warnings\nprint({EVIL!r} + 'printed')\nprint({EVIL!r} + 'said', file=sys.stderr)\n"
        "print('\\x1b[1;32mgreen\\x1b[0m and \\x1b[8mhidden\\x1b[0m')\n"
        f"warnings.warn({EVIL!r} + 'warned')\nraise RuntimeError({EVIL!r} + 'raised')\n"
    )
    with on_terminal(tmp_path, "open", file.name, "--port", "0", "--no-spare", "--num-envs", "1") as terminal:
        url = terminal.wait_for(r"page +(http\S+)")[1]
        known = handshake(url)[1]["additional_headers"]
        for path in ("/%1b%5d0;owned%07", "/docs/%1b%5d0;owned%07", "/%9b2J%0aFAKE"):
            for headers in ({}, known):
                connection = http.client.HTTPConnection(urlsplit(url).netloc, timeout=30)
                connection.request("GET", path, headers={"User-Agent": "owned\x9b2J", **headers})
                assert connection.getresponse().status >= 400
                connection.close()
        terminal.wait_for("last good|import failed")
        terminal.wait_for("raised")
        terminal.wait_for(r"printed")
        terminal.wait_for(r"green")
    text = terminal.text
    assert harmful(text) == set(), text
    assert "\\x1b]0;owned\\x07" in text and "\\x1b]52;c;" in text and "\\u202eback" in text
    assert "\x1b[1;32mgreen\x1b[0m and hidden" in text, "colours are kept, and no text is hidden"


@pytest.mark.slow
@pytest.mark.parametrize("workers", ["1", "2"])
def test_a_recorded_task_does_nothing_to_the_terminal(
    child_process: None, workers: str, tmp_path: Path
) -> None:
    """The task's code runs in the command's own process, or in subprocesses that write to the terminal themselves."""
    (tmp_path / "mine.py").write_text(
        f"import sys\nprint({EVIL!r} + 'printed')\nprint({EVIL!r} + 'said', file=sys.stderr)\n"
        f"print('\\x1b[1;32mgreen\\x1b[0m')\nraise RuntimeError({EVIL!r} + 'raised')\n"
    )
    with on_terminal(tmp_path, "record", "mine.py", "--workers", workers, "--num-envs", "1") as terminal:
        terminal.process.wait(timeout=120)
    text = BARS.sub("", terminal.text)
    assert harmful(text) == set(), text
    assert all(word in text for word in ("printed", "said", "green", "raised"))


@pytest.mark.slow
def test_a_recording_full_of_escapes_is_printed_as_text(child_process: None, tmp_path: Path) -> None:
    info: dict[str, Any] = {"task": f"Push{EVIL}-v1", "source_file": f"{EVIL}.py"}
    first = write(tmp_path, made(3, **info), pictures=False)
    for file in sorted(tmp_path.glob(f"{first.stem}.*")):
        file.rename(file.with_name(f"a\u202e{TITLE}\nb{file.suffix}"))
    with on_terminal(tmp_path, "rescore", ".") as terminal:
        terminal.process.wait(timeout=120)
    text = BARS.sub("", terminal.text)
    assert harmful(text) == set(), text
    assert "\\x1b]0;owned\\x07" in text and "\\u202e" in text


def test_a_row_of_the_library_is_printed_as_text(child_process: None, tmp_path: Path) -> None:
    first = write(tmp_path, made(3, task=f"Push{EVIL}-v1"), pictures=False)
    for file in sorted(tmp_path.glob(f"{first.stem}.*")):
        file.rename(file.with_name(f"a\u202e{TITLE}b{file.suffix}"))
    library = Library(tmp_path)
    try:
        library.refresh()
        (row,) = library.view().rows
    finally:
        library.close()
    shown = cells(row, None, datetime.datetime.now(datetime.timezone.utc))
    text = "".join((shown["task"], shown["about"], row.name, row.problem or "", row.note, *row.tags))
    assert harmful(text) == set() and "\u202e" not in text and "]0;owned" in text


# --- what each way to print something lets through ----------------------------------------------------


@contextmanager
def both_streams() -> Iterator[io.StringIO]:
    output = io.StringIO()
    with redirect_stdout(output), redirect_stderr(output):
        yield output


def test_all_output_of_the_commands_is_text() -> None:
    with both_streams() as streams:
        print_text(EVIL)
        refuse(f"there is no file {EVIL}")
        warn(EVIL)
        print_problem(Problem("import", EVIL, f"/{EVIL}.py", 3, EVIL, f"Traceback\n  {EVIL}\n"))
        print_line(PrintedLine("stdout", "plain", (StyledText("plain", Style(color="color(1)")),)))
    output = streams.getvalue()
    assert harmful(output) == set() and "\\x1b]0;owned\\x07" in output
    assert "  | plain\n" in output, "no colours without a terminal"
    assert output.count("there is no file") == 1 and "/[" not in output


def test_a_loggers_record_is_one_line_and_its_traceback_is_text(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(logging, "lastResort", logging._StderrHandler(logging.WARNING))  # type: ignore[attr-defined]
    logger = logging.Logger("alone")
    with both_streams() as streams:
        guard_terminal()
        try:
            raise ValueError(EVIL)
        except ValueError:
            logger.exception("The route %s failed on %s.", "/docs", f"/{EVIL}\nFAKE a line of ours")
        print(EVIL, file=sys.stderr)
        sys.stderr.writelines([EVIL, "\x1b[31mred\x1b[0m\n"])
    output = streams.getvalue()
    assert harmful(output) == set()
    assert "\nFAKE" not in output and "\\nFAKE" in output
    assert "Traceback" in output and "ValueError" in output and "\x1b[31mred\x1b[0m" in output


def test_progress_bars_still_move_and_their_labels_are_text() -> None:
    output = io.StringIO()
    console = SafeConsole(file=output, force_terminal=True, width=100)
    columns = (TextColumn("{task.description}", markup=False), BarColumn())
    with Progress(*columns, console=console) as bar:
        bar.update(bar.add_task("opening", total=2), description=f"importing [/b]{EVIL}")
        bar.refresh()
    text = output.getvalue()
    assert "\x1b[2K" in text or "\x1b[?25l" in text, "rich's own controls"
    assert harmful(BARS.sub("", text)) == set()
    assert "[/b]" in text and "\\x1b]0;owned" in text


@given(
    st.lists(
        st.sampled_from(
            [EVIL, "\x1b", "[31m", "\x1b[31m", "text", "\n", "\r", "[link=http://x]l[/link]", "\x9b"]
        )
    )
)
def test_no_renderable_brings_a_control_through_our_console(parts: list[str]) -> None:
    output = io.StringIO()
    console = SafeConsole(file=output, force_terminal=True, width=80, highlight=False)
    text = "".join(parts)
    table = Table(title="t")
    table.add_column("c", overflow="fold")
    table.add_row(Text(text))
    console.print(table)
    console.print(Text(text))
    console.print(Text.from_ansi(text))
    console.print(text.replace("[/", "(/"))
    assert harmful(output.getvalue()) == set()
