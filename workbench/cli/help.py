"""Runs ``workbench help``: lists the topics, or shows one."""

from __future__ import annotations

import difflib
import os
import re
import shutil

from rich.markdown import Markdown
from rich.markup import escape
from rich.table import Table

from workbench.app.help_pages import GROUPS, RULE_PAGES, Topic, by_path, find_topic, topics, topics_about
from workbench.cli.output import Exit, out, refuse
from workbench.machine.text import plain_text

MAX_COLUMNS = 100
"""Maximum width of the text: longer lines are hard to read."""
_HIDDEN = re.compile(r"^<picture>.*?^</picture>\n|^!\[.*?\]\(.*?\)\n|^<!--.*?-->\n", re.DOTALL | re.MULTILINE)
_LINK = re.compile(r"\[([^]]+)\]\(([^)]+)\)")


def show_help(name: str) -> int:
    """Show a topic, or the list of topics if the name is empty; returns the exit code."""
    if not name.strip():
        _list_topics()
        return Exit.DONE
    topic = find_topic(name)
    if topic is None:
        return refuse(_not_found(name))
    page = Markdown(for_terminal(topic), hyperlinks=False)
    width = min(out.width, MAX_COLUMNS)
    if not out.is_terminal:
        out.print(page, width=width)
        return Exit.DONE
    # With these options, less exits at once if the text fits the window, and keeps colours. A LESS variable
    # that the user has set takes precedence.
    os.environ.setdefault("LESS", "FRX")
    with out.pager(styles=shutil.which("less") is not None):
        out.print(page, width=width)
    return Exit.DONE


def _list_topics() -> None:
    longest = max(len(topic.name) for topic in topics() if topic.group != RULE_PAGES)
    for _, group in GROUPS:
        table = Table(box=None, show_header=False, padding=(0, 2, 0, 2))
        table.add_column(style="cyan", no_wrap=True, min_width=longest)
        table.add_column()
        for topic in topics():
            if topic.group == group:
                table.add_row(topic.name, escape(topic.title))
        out.print(f"[bold]{escape(group)}[/]")
        out.print(table)
    out.print(
        "Type [cyan]workbench help TOPIC[/], or press [cyan]Help[/] on the page to read them in the browser."
    )


def _not_found(name: str) -> str:
    wanted = plain_text(name.strip())
    names = [topic.name for topic in topics()]
    about = [topic.name for topic in topics_about(wanted)]
    # Several words are a search, not a mistyped name.
    close = (
        difflib.get_close_matches(wanted.lower(), names, 1) if len(wanted.split()) == 1 or not about else []
    )
    if close:
        return f"There is no topic {wanted!r}. Did you mean {close[0]!r}? workbench help lists all topics."
    if about:
        return f"There is no topic {wanted!r}. These mention it: {', '.join(about)}"
    return f"There is no topic {wanted!r}, and no topic mentions it. workbench help lists all topics."


def for_terminal(topic: Topic) -> str:
    """Text of the topic without pictures. Each link to another topic is followed by the command that shows
    that topic."""

    def link(match: re.Match[str]) -> str:
        path, _ = topic.link(match[2])
        to = by_path(path)
        return match[1] if to is None or to is topic else f"{match[1]} (`workbench help {to.name}`)"

    return _LINK.sub(link, _HIDDEN.sub("", topic.text))
