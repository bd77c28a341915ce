"""Which episode is made next, and which are kept: the same whoever makes them, in whatever order they end.

Episodes are numbered; episode k begins with seed + k. Who wants K of them gets 0 to K - 1. Who wants K successes gets
the K successes with the lowest numbers, and that is where order matters: with many envs, or several processes, a
later episode may end in success before an earlier one has ended at all. It then waits, on the disk, until it is known
how many before it succeeded. So a recording holds the same episodes on one env as on sixty-four in four processes.
"""

from __future__ import annotations


class Dealer:
    """Not thread-safe."""

    def __init__(self, wanted: int, only_successes: bool = False, most: int | None = None) -> None:
        """
        Args:
            wanted: how many episodes are kept.
            only_successes: of these only; without, every one counts.
            most: how many are tried at most.
        """
        self._wanted, self._only_successes = wanted, only_successes
        self._most = wanted if not only_successes else most
        self._next = 0
        self._open: set[int] = set()
        self._good: set[int] = set()
        """Of those that ended, what is or may be kept."""
        self._kept: set[int] = set()
        self._decided: list[tuple[int, bool]] = []

    def next(self) -> int | None:
        """The number of an episode to be made; None for none any more."""
        if len(self._good) >= self._wanted or (self._most is not None and self._next >= self._most):
            return None
        self._open.add(self._next)
        self._next += 1
        return self._next - 1

    def ended(self, index: int, success: bool) -> None:
        """An episode is over; one that cannot be kept for another reason is none that succeeded."""
        if index not in self._open:
            return
        self._open.discard(index)
        if success or not self._only_successes:
            self._good.add(index)
        else:
            self._decided.append((index, False))
        self._decide()

    def decided(self) -> list[tuple[int, bool]]:
        """What was decided since this was last asked: number, and whether it is kept.

        An episode that is under way and cannot be among those that are kept any more is told too.
        """
        told, self._decided = self._decided, []
        return told

    @property
    def kept(self) -> int:
        return len(self._kept)

    @property
    def tried(self) -> int:
        """Episodes up to the last one that is kept, if there are as many as are wanted; else all that were begun."""
        if len(self._kept) >= self._wanted:
            return max(self._kept) + 1
        return self._next

    def _decide(self) -> None:
        ordered = sorted(self._good)
        for place, index in enumerate(ordered):
            if index in self._kept:
                continue
            may_come_before = sum(other < index for other in self._open)
            if place >= self._wanted:
                self._good.discard(index)
                self._decided.append((index, False))
            elif place + may_come_before < self._wanted:
                self._kept.add(index)
                self._decided.append((index, True))
        if len(ordered) >= self._wanted:
            last = ordered[self._wanted - 1]
            for index in sorted(self._open):
                if index > last:
                    self._open.discard(index)
                    self._decided.append((index, False))
