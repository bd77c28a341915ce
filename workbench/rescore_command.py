"""``workbench rescore`` in a terminal: a bar while it works, then the table."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn
from rich.progress import Progress as Bar
from rich.table import Table

from workbench.session import rescore_words as words
from workbench.session.rescore_all import Progress, RescoreOptions, rescore_all
from workbench.session.rescore_messages import Verdict


def run_rescore(what: RescoreOptions, out: Console, err: Console, csv: Path | None, json: Path | None) -> int:
    """Judge, print, write the tables that are asked for; raises as `rescore_all`, and OSError for a table."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Bar(*columns, console=err) as bar:
        row = bar.add_task("reading the recordings", total=None)

        def tell(now: Progress) -> None:
            bar.update(
                row, total=now.total, completed=now.episodes, description=f"judging, {now.steps} steps"
            )

        verdicts, notes = rescore_all(what, lambda activity: bar.update(row, description=activity), tell)
        bar.update(row, total=len(verdicts), completed=len(verdicts), description="judged")
    for path, text in ((csv, words.as_csv), (json, words.as_json)):
        if path is not None:
            words.write_table(path, text(verdicts))
    print_verdicts(verdicts, out)
    for note in (*notes, *words.not_carried(verdicts)):
        err.print(f"[yellow]{escape(note)}[/]", soft_wrap=True)
    if doubt := words.doubts(verdicts):
        err.print(f"[yellow]{escape(doubt)}[/]", soft_wrap=True)
    return 0


def print_verdicts(verdicts: list[Verdict], out: Console) -> None:
    """The table, and a sentence over all of it."""
    table = Table(box=None, pad_edge=False)
    for name in ("episode", "seed", "steps", "return", "what changed", "drift"):
        table.add_column(name, justify="right" if name in ("seed", "steps") else "left", overflow="fold")
    for verdict in verdicts:
        cells = [
            verdict.file.name,
            str(verdict.seed) if verdict.seed >= 0 else "",
            str(verdict.length) if not verdict.why_not else "",
            words.returns(verdict) if not verdict.why_not else "",
            words.what_changed(verdict),
            words.drift(verdict) if not verdict.why_not else "",
        ]
        style = "yellow" if verdict.why_not else "bold" if verdict.differs else "dim"
        table.add_row(*map(escape, cells), style=style)
    out.print(table)
    out.print(escape(words.summary(verdicts)), soft_wrap=True)
