"""The table of benchmarks: rows in results.json, shown by web_assets/docs/reference/benchmarks.md.

    python -m tests.benchmarks.table          # writes the page from results.json

A script in this folder replaces its rows with ``--write``. ``test_generated.py`` fails if the page does not match.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import date
from pathlib import Path
from typing import Literal

ROOT = Path(__file__).resolve().parents[2]
RESULTS = Path(__file__).with_name("results.json")
PAGE = ROOT / "web_assets" / "docs" / "reference" / "benchmarks.md"
MAX_ROWS = 25
_TIMES = ("s", "ms", "µs")
"""First words of the units of time."""
_HEAD = """\
# How fast it is

Measured on a machine with two cores and no GPU. Both sides of a row come from one run of the script: take the ratio, because the
figures themselves depend on the machine. A row without another side has no ratio. The scripts are in `tests/benchmarks/`;
with `--write` a script puts its rows into this table.

| what | workbench | other side | ratio | script | measured |
| --- | ---: | ---: | --- | --- | --- |
"""


@dataclass(frozen=True)
class Row:
    what: str
    """What is measured, its subject first, and after "against" the other side."""
    ours: float
    other: float | None
    """The other side; None without one."""
    unit: str
    better: Literal["more", "less"]
    script: str
    """File name in this folder."""
    measured: str = ""
    """Date as YYYY-MM-DD; empty for today."""

    @property
    def ratio(self) -> str:
        """The other side compared with the workbench in words; empty without another side."""
        if self.other is None:
            return ""
        if self.better == "more":
            return f"{_short(self.ours / self.other)} times as many"
        if self.unit.split()[0] in _TIMES:
            return f"{_short(self.other / self.ours)} times as fast"
        return f"{_short(self.ours / self.other)} times as much"


def _short(ratio: float) -> str:
    """Two significant digits, or two decimals below 2."""
    if ratio < 2:
        return f"{ratio:.2f}"
    return f"{ratio:.1f}" if ratio < 10 else f"{float(f'{ratio:.2g}'):.0f}"


def read() -> list[Row]:
    return [Row(**row) for row in json.loads(RESULTS.read_text())]


def keep(rows: Sequence[Row]) -> None:
    """Replace the rows with the same `what`, or add them, and write the page.

    Raises:
        ValueError: the table would have more than `MAX_ROWS` rows.
    """
    kept = {row.what: row for row in read()}
    for row in rows:
        other = None if row.other is None else _rounded(row.other)
        measured = row.measured or date.today().isoformat()
        kept[row.what] = Row(row.what, _rounded(row.ours), other, row.unit, row.better, row.script, measured)
    if len(kept) > MAX_ROWS:
        raise ValueError(f"{len(kept)} rows: remove {len(kept) - MAX_ROWS} from {RESULTS}")
    ordered = [asdict(kept[what]) for what in sorted(kept)]
    RESULTS.write_text(json.dumps(ordered, indent=1, ensure_ascii=False) + "\n")
    PAGE.write_text(page(read()))


def _rounded(value: float) -> float:
    """Four significant digits."""
    return float(f"{value:.4g}")


def page(rows: Sequence[Row]) -> str:
    lines = [
        f"| {row.what} | {_figure(row.ours, row.unit)} | {_figure(row.other, row.unit)} | {row.ratio} | `{row.script}` "
        f"| {row.measured} |\n"
        for row in sorted(rows, key=lambda row: row.what)
    ]
    return _HEAD + "".join(lines)


def _figure(value: float | None, unit: str) -> str:
    return "" if value is None else f"{value:,.6g} {unit}"


if __name__ == "__main__":
    PAGE.write_text(page(read()))
