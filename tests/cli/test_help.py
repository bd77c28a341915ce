"""``workbench help``: the list of topics, one topic in the terminal, and the answer to an unknown topic."""

from __future__ import annotations

import fcntl
import os
import pty
import signal
import struct
import subprocess
import termios

import pytest

from tests.drive.commands import exit_code
from workbench.app.help_pages import Topic, topics
from workbench.cli.output import Exit
from workbench.machine.processes.child_environment import python_command

pytestmark = pytest.mark.thorough


def help_output(capsys: pytest.CaptureFixture[str], *call: str) -> tuple[int, str]:
    code = exit_code("help", *call)
    return code, "".join(capsys.readouterr())


@pytest.mark.parametrize("topic", topics(), ids=lambda topic: topic.name)
def test_a_topic_is_shown(topic: Topic, capsys: pytest.CaptureFixture[str]) -> None:
    code, text = help_output(capsys, topic.name)
    assert code == Exit.DONE
    title = topic.text.partition("\n")[0].removeprefix("# ")
    assert title in " ".join(text.split()) and "\x1b" not in text
    assert "<picture" not in text and "<source" not in text and "](" not in text


@pytest.mark.parametrize(
    ("name", "advice"),
    [
        ("camera", "Did you mean 'cameras'?"),
        ("planner horizon", "These mention it: solve"),
        ("zzz", "no topic mentions it"),
        ("\x1b[2J", "no topic"),
    ],
)
def test_an_unknown_topic_is_answered_with_advice(
    name: str, advice: str, capsys: pytest.CaptureFixture[str]
) -> None:
    code, text = help_output(capsys, name)
    assert code == Exit.REFUSED and advice in text and "\x1b" not in text


def test_in_a_terminal_a_topic_is_shown_in_a_pager(child_process: None) -> None:
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))
    env = {**os.environ, "TERM": "xterm", "PAGER": "sed -e 's/^/PAGED /'", "MANPAGER": ""}
    env.pop("COLUMNS", None)
    command = [*python_command("-m", "workbench.cli.main"), "help", "limits"]
    process = subprocess.Popen(command, stdin=theirs, stdout=theirs, stderr=theirs, env=env, close_fds=True)
    os.close(theirs)
    shown = b""
    try:
        while chunk := os.read(ours, 65536):
            shown += chunk
    except OSError:  # the other end was closed
        pass
    finally:
        os.close(ours)
    assert process.wait(60) == 0
    lines = shown.decode().splitlines()
    assert len(lines) > 24 and all(line.startswith("PAGED ") for line in lines)


def test_a_closed_pipe_ends_a_command_without_a_message(child_process: None) -> None:
    """This happens with ``workbench open --help | head``."""
    reader, writer = os.pipe()
    os.close(reader)
    command = python_command("-m", "workbench.cli.main", "open", "--help")
    ended = subprocess.run(command, stdout=writer, stderr=subprocess.PIPE, text=True, timeout=60, check=False)
    os.close(writer)
    assert (ended.returncode, ended.stderr) == (128 + signal.SIGPIPE, "")
