"""``workbench rescore`` in a terminal: a bar while it works, then the table."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.measure import Measurement
from rich.padding import Padding
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn
from rich.progress import Progress as Bar
from rich.table import Table

from workbench.core.rules import Finding
from workbench.session import rescore_words as words
from workbench.session.rescore_all import Progress, RescoreOptions, rescore_all
from workbench.session.rescore_messages import Verdict


def run_rescore(
    what: RescoreOptions,
    out: Console,
    err: Console,
    csv: Path | None,
    json: Path | None,
    say_finding: Callable[[Finding], None],
) -> int:
    """Judge, print, write the tables that are asked for; raises as `rescore_all`, and OSError for a table."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Bar(*columns, console=err) as bar:
        row = bar.add_task("reading the recordings", total=None)

        def tell(now: Progress) -> None:
            bar.update(
                row, total=now.total, completed=now.episodes, description=f"judging, {now.steps} steps"
            )

        verdicts, notes = rescore_all(
            what, lambda activity: bar.update(row, description=activity), tell, say_finding
        )
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
    """The table, and a sentence over all of it.

    Names of recordings take 55 characters. Where that leaves no room for the rest, as in a terminal of 80 columns, a
    name has a line of its own, whole, so that it can be taken from there.
    """
    table = Table(box=None, pad_edge=False)
    for name in ("episode", "seed", "steps", "return", "what changed", "drift"):
        table.add_column(name, justify="right" if name in ("seed", "steps") else "left", overflow="fold")
    for verdict in verdicts:
        table.add_row(*map(escape, _cells(verdict)), style=_style(verdict))
    if Measurement.get(out, out.options.update(max_width=10**6), table).maximum <= out.width:
        out.print(table)
    else:
        for verdict in verdicts:
            _print_lines(verdict, out)
    out.print(escape(words.summary(verdicts)), soft_wrap=True)


def _cells(verdict: Verdict) -> list[str]:
    judged = not verdict.why_not
    return [
        verdict.file.name,
        str(verdict.seed) if verdict.seed >= 0 else "",
        str(verdict.length) if judged else "",
        words.returns(verdict) if judged else "",
        words.what_changed(verdict),
        words.drift(verdict) if judged else "",
    ]


def _print_lines(verdict: Verdict, out: Console) -> None:
    name, seed, steps, total, changed, drift = _cells(verdict)
    out.print(escape(name), style=_style(verdict), soft_wrap=True)
    named = (("seed", seed), ("steps", steps), ("return", total), ("drift", drift))
    facts = ", ".join(f"{what} {value}" for what, value in named if value)
    for line in (changed, facts):
        if line:
            out.print(Padding(escape(line), (0, 0, 0, 4)), style=_style(verdict))


def _style(verdict: Verdict) -> str:
    return "yellow" if verdict.why_not else "bold" if verdict.differs else "dim"
