"""``workbench rescore`` in a terminal: a bar while it works, then the table."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.measure import Measurement
from rich.padding import Padding
from rich.progress import MofNCompleteColumn, TimeElapsedColumn
from rich.table import Table

from workbench.core.backends import gpu_left_alone
from workbench.machine.atomic_files import replace_file
from workbench.machine.current_folder import CurrentFolder
from workbench.machine.terminal_text import plain_text
from workbench.recording.sources import Source
from workbench.session import rescore_words as words
from workbench.session.clearance import Clearances
from workbench.session.rescore_all import Progress, RescoreOptions, rescore_all
from workbench.session.verdict import Verdict
from workbench.terminal import Exit, out, print_finding, progress_bar, warn
from workbench.trust_prompt import TerminalPrompt, can_ask


def run_rescore(what: RescoreOptions, csv: Path | None, json: Path | None, trust: bool) -> int:
    """Judge, print, write the tables that are asked for; raises as `rescore_all`, and OSError for a table."""
    here = CurrentFolder()  # a task may go to another
    if (left_alone := gpu_left_alone(what.base.backend)) is not None:
        warn(left_alone)
    asks = can_ask()  # before the bar takes the terminal
    with progress_bar(MofNCompleteColumn(), TimeElapsedColumn()) as bar:
        row = bar.add_task("reading the recordings", total=None)

        def tell(now: Progress) -> None:
            bar.update(
                row, total=now.total, completed=now.episodes, description=f"judging, {now.steps} steps"
            )

        @contextmanager
        def without_bar() -> Iterator[None]:
            bar.stop()
            yield
            bar.start()

        ask = TerminalPrompt(out, without_bar).ask if asks else None
        verdicts, notes = rescore_all(
            what,
            lambda activity: bar.update(row, description=activity),
            tell,
            print_finding,
            Clearances(ask=ask, all_trusted=trust),
            warn,
        )
        bar.update(row, total=len(verdicts), completed=len(verdicts), description="judged")
    for path, text in ((csv, words.as_csv), (json, words.as_json)):
        if path is not None:
            with here.again():
                replace_file(path, text(verdicts).encode())
    print_verdicts(verdicts, out)
    for note in (*notes, *words.not_carried(verdicts)):
        warn(note)
    if words.is_doubtful(verdicts):
        warn(words.doubts(verdicts, words.PUT_IN))
    return Exit.DONE


def print_verdicts(verdicts: list[Verdict[Source]], out: Console) -> None:
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


def _cells(verdict: Verdict[Source]) -> list[str]:
    judged = not verdict.why_not
    cells = [
        verdict.of.name,
        str(verdict.seed) if verdict.seed >= 0 else "",
        str(verdict.length) if judged else "",
        words.returns(verdict) if judged else "",
        words.what_changed(verdict),
        words.drift(verdict) if judged else "",
    ]
    return [plain_text(cell) for cell in cells]


def _print_lines(verdict: Verdict[Source], out: Console) -> None:
    name, seed, steps, total, changed, drift = _cells(verdict)
    out.print(escape(name), style=_style(verdict), soft_wrap=True)
    named = (("seed", seed), ("steps", steps), ("return", total), ("drift", drift))
    facts = ", ".join(f"{what} {value}" for what, value in named if value)
    for line in (changed, facts):
        if line:
            out.print(Padding(escape(line), (0, 0, 0, 4)), style=_style(verdict))


def _style(verdict: Verdict[Source]) -> str:
    return "yellow" if verdict.why_not else "bold" if verdict.differs else "dim"
