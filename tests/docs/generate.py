"""Generates the parts of the docs that come from the code: keys, commands and rules.

    python -m tests.docs.generate          # `test_generated.py` fails if a page differs

Keys come from the list of commands, command pages from ``--help``. Rules come from their declarations: the decorators and
docstrings of `checks.rules`, `envs.gpu_rules` and `envs.outliers`. The rule pages and the table that the package reads
(`checks.rule_table`) are generated from these.
"""

from __future__ import annotations

import io
import json
import os
import re
import textwrap
from collections.abc import Sequence
from contextlib import redirect_stdout
from dataclasses import fields
from pathlib import Path
from unittest.mock import patch

from tests.docs.pages import DOCS
from workbench.cameras import commands as cameras
from workbench.checks.rule_table import RULES_FILE
from workbench.checks.run_rules import DECLARED
from workbench.cli import main
from workbench.commands import COMMANDS
from workbench.envs.gpu_rules import GPU_RULES, DeclaredRule, Rule
from workbench.page.command import Command
from workbench.page.widgets.keys_and_palette import key_rows

KEYS = DOCS / "reference" / "keys.md"
CLI = DOCS / "reference" / "cli.md"
GPU_RULES_PAGE = DOCS / "batched_env.md"
ALL_RULES = DOCS / "reference" / "rules.md"
RULE_PAGES = DOCS / "rules"
CLI_COMMANDS = tuple(
    "start new open review record check solve sweep merge rescore share export view doctor help".split()
)
"""Commands in reading order; `test_generated.py` compares them with the existing commands."""


# --- keys ---------------------------------------------------------------------------------------------


def keys_page() -> str:
    studio = [kind for kind in COMMANDS if kind.__module__ == cameras.__name__]
    driving = [kind for kind in COMMANDS if kind.context == "driving"]
    live = [kind for kind in COMMANDS if kind.context in ("page", "live") and kind not in studio]
    review = [kind for kind in COMMANDS if kind.context in ("page", "review", "library")]
    return "\n".join(
        [
            "# Keys",
            "",
            "`?` on the page shows its keys. Ctrl+K opens a list of all commands by name, including those without a key,",
            "and of tabs, folds, envs, cameras, control modes, files and documents: type `env 7`, `base_camera` or `help`, then Enter. Keys",
            "do not work while you type in a text or number field. 1 to 6 open the tabs of the panel at the right. This page is made",
            "from the code.",
            "",
            "## Live page",
            "",
            *table(live),
            "",
            "### The camera that is chosen in the Studio",
            "",
            *table(studio),
            "",
            "### While you drive the robot",
            "",
            *table(driving),
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
    lines = ["| key | what it does |", "| --- | --- |"]
    for rows in key_rows(COMMANDS, kinds).values():
        lines += [f"| {key} | {what} |" for key, what in rows]
    return lines


# --- commands -----------------------------------------------------------------------------------------


def cli_page() -> str:
    lines = [
        "# Commands",
        "",
        "What `workbench COMMAND --help` prints. This page is generated from the code.",
        "",
    ]
    for name in CLI_COMMANDS:
        lines += [f"## {name}", "", "```text", help_of(name), "```", ""]
    return "\n".join(lines)


def help_of(command: str) -> str:
    """The help text of a command, 100 columns wide, without colours."""
    plain = {"COLUMNS": "100", "NO_COLOR": "1"}
    printed = io.StringIO()
    with patch.dict(os.environ, plain), redirect_stdout(printed):
        for name in ("FORCE_COLOR", "TTY_COMPATIBLE"):
            os.environ.pop(name, None)
        try:
            main.main([command, "--help"])
        except SystemExit as ended:
            assert not ended.code, command
    return "\n".join(line.rstrip() for line in printed.getvalue().strip().splitlines())


# --- rules --------------------------------------------------------------------------------------------


HOOKS = (
    "class",
    "_load_agent",
    "_load_scene",
    "_default_sim_config",
    "_initialize_episode",
    "evaluate",
    "compute_dense_reward",
    "compute_normalized_dense_reward",
    "_get_obs_extra",
    "get_state_dict",
    "step",
    "_default_sensor_configs",
    "_default_human_render_camera_configs",
)
"""Hooks in their order on the page of all rules, roughly the order in which an author writes them."""


def declared_rules() -> list[DeclaredRule]:
    """All rules in the order of `checks.rule_table.RULES`."""
    return [*GPU_RULES.values(), *(each.rule for checks in DECLARED.values() for each in checks)]


def rules_json() -> str:
    """All rules without their pages."""
    names = [field.name for field in fields(Rule)]
    rows = [{name: getattr(rule, name) for name in names} for rule in declared_rules()]
    return json.dumps(rows, indent=1, ensure_ascii=False) + "\n"


def rule_page(rule: DeclaredRule) -> str:
    parts = [
        f"# {rule.id}",
        wrapped(code(rule.asks)),
        wrapped(f"If broken: {code(rule.otherwise)}"),
        f"*{rule.degree}* · `{rule.hook}`",
        rule.page,
    ]
    return "\n\n".join(parts) + "\n"


def wrapped(sentence: str) -> str:
    """Wrap a sentence at 110 characters."""
    return textwrap.fill(sentence, 110, break_long_words=False, break_on_hyphens=False)


def gpu_rules_table() -> str:
    rows = [
        f"| {linked(rule.id, 'rules')} | {rule.degree} | {code(rule.asks)} | {code(rule.otherwise)} |"
        for rule in GPU_RULES.values()
    ]
    return "\n".join(
        [
            "| rule | degree | what the task does | what the GPU does if it is broken |",
            "| --- | --- | --- | --- |",
            *rows,
        ]
    )


def all_rules_page() -> str:
    """The page of all rules, with a table per hook."""
    by_hook: dict[str, list[Rule]] = {hook: [] for hook in HOOKS}
    # Rules of GPU simulation come last.
    for rule in sorted(declared_rules(), key=lambda rule: rule.id in GPU_RULES):
        by_hook[rule.hook].append(rule)
    lines = [
        "# Rules",
        "",
        "The rules of [`workbench check`](../checks.md), grouped by the hook that a fix changes. A broken rule of degree *stop* gives",
        "the exit code 1. `workbench help RULE` shows the page of one rule. Rules of GPU simulation are also checked",
        "[while a task runs](../batched_env.md#what-goes-wrong-on-a-gpu-goes-wrong-here). This page is generated from the code.",
        "",
    ]
    for hook, rules in by_hook.items():
        title = "The class and its file" if hook == "class" else f"`{hook}`"
        lines += [f"## {title}", "", "| rule | degree | what the task does |", "| --- | --- | --- |"]
        lines += [f"| {linked(rule.id)} | {rule.degree} | {code(rule.asks)} |" for rule in rules]
        lines += [""]
    return "\n".join(lines)


def linked(rule: str, folder: str = "../rules") -> str:
    return f"[{rule}]({folder}/{rule}.md)"


def code(sentence: str) -> str:
    """Put names of functions and attributes in backticks."""
    name = r"@?(?:\w+\.)*\w*_\w+(?:\.\w+)*(?:\([\w, ]*\))?|(?:\w+\.)+\w+\(\)|\w+\(\w*_\w+\)|evaluate\(\)"
    # Text in backticks stays unchanged.
    return re.sub(
        rf"`[^`]*`|(?<!\w)({name})", lambda found: f"`{found[1]}`" if found[1] else found[0], sentence
    )


def with_rules(text: str) -> str:
    """Replace the table between the page's marks."""
    before, begin, rest = text.partition("<!-- rules -->\n")
    _, end, after = rest.partition("<!-- /rules -->")
    assert begin and end
    return f"{before}{begin}{gpu_rules_table()}\n{end}{after}"


def pages() -> dict[Path, str]:
    """The text of every generated file."""
    return {
        KEYS: keys_page(),
        CLI: cli_page(),
        GPU_RULES_PAGE: with_rules(GPU_RULES_PAGE.read_text()),
        ALL_RULES: all_rules_page(),
        RULES_FILE: rules_json(),
        **{RULE_PAGES / f"{rule.id}.md": rule_page(rule) for rule in declared_rules()},
    }


if __name__ == "__main__":
    made = pages()
    for path, text in made.items():
        if not path.exists() or path.read_text() != text:
            path.write_text(text)
            print(f"wrote {path}")
    for path in RULE_PAGES.iterdir():
        if path not in made:
            path.unlink()
            print(f"removed {path}")
