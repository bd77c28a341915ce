"""Rules that look at all seeds: what they see is data, so that parts of the seeds can be seen by several processes."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

from workbench.checks.evidence.checkup import Checkup, Found, NotApplicable, Note, NotKnown
from workbench.checks.results import Seen


@dataclass(frozen=True)
class OverSeeds:
    """A `Check` in two parts. What is decided over all seeds must not be decided for a part of them: a reward that is the
    same at all steps of 32 seeds may differ in the next ones."""

    see: Callable[[Checkup], Iterator[Seen]]
    """What is there, of the seeds of a checkup."""
    judge: Callable[[Sequence[Seen]], Iterator[Found | Note]]
    """What that comes to, of one or several of them in the order of their seeds. Raises as a `Check`."""

    def __call__(self, checkup: Checkup) -> Iterator[Found | Note]:
        return self.judge([*self.see(checkup)])

    def so_far(self, seen: Sequence[Seen]) -> Iterator[Found | Note]:
        """What can be said where the task raised before all was seen."""
        if not seen:
            return
        try:
            yield from self.judge(seen)
        except (NotApplicable, NotKnown):
            return


def together(seen: Iterable[Seen], worst: bool = False) -> list[Seen]:
    """One row for each thing with a name, in the order in which they come.

    Args:
        worst: take the texts, numbers and place of the row of the largest size, in place of the first row's that has them.
    """
    found: dict[tuple[str, ...], Seen] = {}
    for row in seen:
        if not row.names:
            continue
        if (known := found.get(row.names)) is None:
            found[row.names] = row
            continue
        later = row.size > known.size if worst else bool(row.texts) and not known.texts
        told, other = (row, known) if later else (known, row)
        found[row.names] = replace(
            told,
            place=told.place or other.place,
            tried=known.tried + row.tried,
            seeds=known.seeds + row.seeds,
            count=known.count + row.count,
            size=max(known.size, row.size),
        )
    return [*found.values()]


def tried(seen: Iterable[Seen], *names: str) -> int:
    """How many episodes were looked at, as the rows of these names say."""
    return sum(row.tried for row in seen if row.names == names)


def first_kind(seen: Iterable[Seen]) -> Seen | None:
    """Of rows whose name is a kind of episodes, the first one that has breaches."""
    return next((row for row in together(seen) if row.count), None)
