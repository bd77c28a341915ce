"""Writes the parts of the docs that are made from the code: the keys, the commands, and the rules.

    python -m tests.docs.generate          # `test_generated.py` fails where a page says something else

Keys are those of the list of commands, commands what ``--help`` prints, rules what `checks.rules` and `envs.gpu_rules`
list.
"""

from __future__ import annotations

import io
import os
import re
from collections.abc import Sequence
from contextlib import redirect_stdout
from pathlib import Path
from unittest.mock import patch

from tests.docs.pages import DOCS
from workbench.cameras import commands as cameras
from workbench.checks.rules import CHECK_RULES
from workbench.cli import main
from workbench.commands import COMMANDS
from workbench.envs.gpu_rules import RULES, Rule
from workbench.page.command import Command
from workbench.page.widgets.hotkeys import key_rows

KEYS = DOCS / "reference" / "keys.md"
CLI = DOCS / "reference" / "cli.md"
RULES_PAGE = DOCS / "batched_env.md"
ALL_RULES = DOCS / "reference" / "rules.md"
CLI_COMMANDS = (
    "start",
    "new",
    "open",
    "review",
    "record",
    "check",
    "solve",
    "sweep",
    "merge",
    "rescore",
    "share",
    "export",
    "view",
    "doctor",
    "help",
)
"""In the order in which a reader meets them; `test_generated.py` compares them with those that there are."""


# --- keys ---------------------------------------------------------------------------------------------


def keys_page() -> str:
    studio = [kind for kind in COMMANDS if kind.__module__ == cameras.__name__]
    live = [kind for kind in COMMANDS if kind.context in ("page", "live") and kind not in studio]
    review = [kind for kind in COMMANDS if kind.context in ("page", "review", "library")]
    return "\n".join(
        [
            "# Keys",
            "",
            "`?` on the page shows its keys. Ctrl+K opens a list of all commands by name, including those without a key,",
            "and of tabs, folds, envs, cameras and control modes: type `env 7`, `base_camera` or `pd_ee_delta_pose`, then Enter. Keys",
            "do not work while you type in a text or number field. This page is made from the code.",
            "",
            "## Live page",
            "",
            *table(live),
            "",
            "### The camera that is chosen in the Studio",
            "",
            *table(studio),
            "",
            "## Review and library",
            "",
            "The keys of the library work while it is open.",
            "",
            *table(review),
            "",
        ]
    )


def table(kinds: Sequence[type[Command]]) -> list[str]:
    rows = [f"| {key} | {what} |" for key, what in key_rows(COMMANDS, kinds)]
    return ["| key | what it does |", "| --- | --- |", *rows]


# --- commands -----------------------------------------------------------------------------------------


def cli_page() -> str:
    lines = [
        "# Commands",
        "",
        "What `workbench COMMAND --help` prints. This page is made from the code.",
        "",
    ]
    for name in CLI_COMMANDS:
        lines += [f"## {name}", "", "```text", help_of(name), "```", ""]
    return "\n".join(lines)


def help_of(command: str) -> str:
    """In a hundred columns, without colours."""
    plain = {"COLUMNS": "100", "NO_COLOR": "1"}
    said = io.StringIO()
    with patch.dict(os.environ, plain), redirect_stdout(said):
        for name in ("FORCE_COLOR", "TTY_COMPATIBLE"):
            os.environ.pop(name, None)
        try:
            main.main([command, "--help"])
        except SystemExit as ended:
            assert not ended.code, command
    return "\n".join(line.rstrip() for line in said.getvalue().strip().splitlines())


# --- rules --------------------------------------------------------------------------------------------


def rules_table() -> str:
    rows = [
        f"| {linked(rule.id, 'rules')} | {rule.degree} | {code(rule.asks)} | {code(rule.otherwise)} |"
        for rule in RULES.values()
    ]
    return "\n".join(
        [
            "| rule | degree | what the task does | what the GPU does otherwise |",
            "| --- | --- | --- | --- |",
            *rows,
        ]
    )


def all_rules_page() -> str:
    """A table for each hook; links to the pages that there are (`test_rule_pages.py` asks for all of them)."""
    by_hook: dict[str, list[Rule]] = {}
    for rule in (*CHECK_RULES.values(), *RULES.values()):
        by_hook.setdefault(rule.hook, []).append(rule)
    lines = [
        "# Rules",
        "",
        "What [`workbench check`](../checks.md) looks at, by the hook in which a mistake is mended. Where a rule with the degree",
        "*stop* is broken, the exit code is 1. `workbench help RULE` shows the page of one rule. Those of GPU simulation are also",
        "checked [while a task runs](../batched_env.md#what-goes-wrong-on-a-gpu-goes-wrong-here). This page is made from the code.",
        "",
    ]
    for hook, rules in by_hook.items():
        title = "The class and its file" if hook == "class" else f"`{hook}`"
        lines += [f"## {title}", "", "| rule | degree | what the task does |", "| --- | --- | --- |"]
        lines += [f"| {linked(rule.id)} | {rule.degree} | {code(rule.asks)} |" for rule in rules]
        lines += [""]
    return "\n".join(lines)


def linked(rule: str, folder: str = "../rules") -> str:
    page = DOCS / "rules" / f"{rule}.md"
    return f"[{rule}]({folder}/{rule}.md)" if page.is_file() else rule


def code(sentence: str) -> str:
    """Names of functions and attributes set as code."""
    name = r"@?(?:\w+\.)*\w*_\w+(?:\.\w+)*(?:\([\w, ]*\))?|\w+\.\w+\(\)|\w+\(\w*_\w+\)|evaluate\(\)"
    # What is code already stays.
    return re.sub(
        rf"`[^`]*`|(?<!\w)({name})", lambda found: f"`{found[1]}`" if found[1] else found[0], sentence
    )


def with_rules(text: str) -> str:
    """The page with the table between its marks."""
    before, begin, rest = text.partition("<!-- rules -->\n")
    _, end, after = rest.partition("<!-- /rules -->")
    assert begin and end
    return f"{before}{begin}{rules_table()}\n{end}{after}"


def pages() -> dict[Path, str]:
    """The text of every page that is made here."""
    return {
        KEYS: keys_page(),
        CLI: cli_page(),
        RULES_PAGE: with_rules(RULES_PAGE.read_text()),
        ALL_RULES: all_rules_page(),
    }


if __name__ == "__main__":
    for path, text in pages().items():
        if not path.exists() or path.read_text() != text:
            path.write_text(text)
            print(f"wrote {path}")
