"""Parses and runs the commands of a documentation fence."""

from __future__ import annotations

import re
import shlex
import urllib.request
from collections.abc import Iterator
from http.cookiejar import CookieJar
from pathlib import Path

from tests.docs.pages import Fence
from tests.drive.page import open_workbench

OPENS_A_PAGE = ("open", "review")


def commands(fence: Fence) -> Iterator[list[str]]:
    """The commands of a fence, split into words, without comments and redirections."""
    for line in re.sub(r"\\\n", "", fence.text).splitlines():
        words = shlex.split(line, comments=True)
        if words:
            yield words


def opens(words: list[str], desk: Path) -> None:
    """Run a command that opens a page: assert that it prints an address, answers there, and ends on Ctrl-C."""
    with open_workbench(*words[2:], cwd=desk, what=words[1]) as opened:
        browser = urllib.request.build_opener(urllib.request.HTTPCookieProcessor(CookieJar()))
        with browser.open(opened.url, timeout=60) as answer:
            assert answer.status == 200 and b"workbench/" in answer.read()
        if words[1] == "open":
            opened.wait_for_line("^loaded ", 120)
