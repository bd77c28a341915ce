"""Checks over all seeds, in two parts: several processes look at parts of the seeds, and one process judges
what all of them saw."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

from workbench.checks.evidence.collect import Checkup, Found, NotApplicable, Note, NotKnown
from workbench.checks.results import Seen


@dataclass(frozen=True)
class OverSeeds:
    """A `Check` in two steps, `see` and `judge`. No part of the seeds may decide the result alone: a reward
    that is constant over 32 seeds may vary in the next seeds."""

    see: Callable[[Checkup], Iterator[Seen]]
    """Looks at the seeds of a checkup, and gives what it saw as rows."""
    judge: Callable[[Sequence[Seen]], Iterator[Found | Note]]
    """Gives the breaches for the rows of one or several checkups; the rows are in the order of the seeds.
    Raises the errors of a `Check`."""

    def __call__(self, checkup: Checkup) -> Iterator[Found | Note]:
        return self.judge([*self.see(checkup)])

    def so_far(self, seen: Sequence[Seen]) -> Iterator[Found | Note]:
        """The breaches that are known if the task raised before all seeds were seen."""
        if not seen:
            return
        try:
            yield from self.judge(seen)
        except (NotApplicable, NotKnown):
            return


def together(seen: Iterable[Seen], worst: bool = False) -> list[Seen]:
    """One row for each name, in the order in which names first occur; rows without a name are left out.

    Args:
        worst: take texts, numbers and place from the row with the largest size. By default they come from
            the first row that has texts.
    """
    found: dict[tuple[str, ...], Seen] = {}
    for row in seen:
        if not row.names:
            continue
        if (known := found.get(row.names)) is None:
            found[row.names] = row
            continue
        later = row.size > known.size if worst else bool(row.texts) and not known.texts
        main, other = (row, known) if later else (known, row)
        found[row.names] = replace(
            main,
            place=main.place or other.place,
            tried=known.tried + row.tried,
            seeds=known.seeds + row.seeds,
            count=known.count + row.count,
            size=max(known.size, row.size),
        )
    return [*found.values()]


def tried(seen: Iterable[Seen], *names: str) -> int:
    """Number of episodes that were looked at, over the rows with these names."""
    return sum(row.tried for row in seen if row.names == names)


def first_kind(seen: Iterable[Seen]) -> Seen | None:
    """The first row with a breach, after `together`; None if there is none. Rows are named by the kind of
    their episodes."""
    return next((row for row in together(seen) if row.count), None)
