"""Recordings, and a review of them, for tests of the review."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from types import SimpleNamespace

from tests.drive.episodes import made
from tests.drive.waiting import until
from workbench.episodes.episode import Episode
from workbench.live.effects import Asked
from workbench.page.command import Command
from workbench.review.commands import CloseRecording, SelectRecording
from workbench.review.playback import Review
from workbench.review.state import FileStamp, ReadingEnded, RecordingRead, ReviewState, apply
from workbench.review.view import Opened, ReviewView, find_events


@dataclass(frozen=True)
class Row:
    id: str
    paths: tuple[Path, ...] = ()
    kind: str = "workbench"
    trajectory: str | None = None
    date: datetime | None = None

    @property
    def name(self) -> str:
        return f"file {self.id}"


@dataclass
class FakeLibrary:
    """In-memory recordings by id; an exception is raised when it is read."""

    episodes: dict[str, Episode | Exception]
    now: float = 0.0
    extra: dict[str, tuple[Path, ...]] = field(default_factory=dict)

    def view(self) -> SimpleNamespace:
        rows = [Row(id, self.extra.get(id, ()), date=_date(e)) for id, e in self.episodes.items()]
        return SimpleNamespace(rows=rows)

    def read(self, row: Row, *_: object) -> Episode:
        found = self.episodes[row.id]
        if isinstance(found, Exception):
            raise found
        return found

    def clock(self) -> float:
        return self.now


def _date(episode: Episode | Exception) -> datetime | None:
    written = "" if isinstance(episode, Exception) else episode.info.written_at
    return datetime.fromisoformat(written) if written else None


def review_of(**episodes: Episode | Exception) -> tuple[Review, FakeLibrary]:
    library = FakeLibrary(episodes)
    return Review(library, library.read, clock=library.clock), library  # type: ignore[arg-type]


def reach(review: Review, reached: Callable[[ReviewView], bool], what: str) -> ReviewView:
    until(lambda: reached(review.view()), what, seen=review.view)
    return review.view()


def opened(review: Review, *ids: str) -> ReviewView:
    review.open(ids)
    return reach(
        review, lambda view: [o.id for o in view.opened] == list(ids) and not view.loading, "opening"
    )


def select(review: Review, index: int) -> None:
    review.do(SelectRecording(id=review.view().opened[index].id))


def close_one(review: Review, index: int) -> None:
    review.do(CloseRecording(id=review.view().opened[index].id))


def aligned(*recordings: tuple[int, int], selected: int = 0, position: int = 0) -> ReviewView:
    """A view of recordings, each (number of steps, state at position 0)."""
    episodes = [made(steps) for steps, _ in recordings]
    anchors = tuple(anchor for _, anchor in recordings)
    return ReviewView(
        opened=tuple(Opened(str(i), f"{i}.rrd", e, find_events(e)) for i, e in enumerate(episodes)),
        opened_serial=1,
        selected=selected,
        anchors=anchors,
        position=position,
        first=-max(anchors),
        last=max(steps - anchor for steps, anchor in recordings),
    )


def recording(name: str, steps: int, success_from: int | None = None, minute: int = 0) -> Opened:
    """The reset, and the first success, are its events."""
    written = f"2024-01-01T00:{minute:02}:00+00:00"
    episode = made(steps, success_from=success_from, written_at=written)
    return Opened(name, f"{name}.rrd", episode, find_events(episode))


def with_opened(*opened: Opened) -> ReviewState:
    state = ReviewState()
    for one in opened:
        state, _ = apply(state, RecordingRead(0, one, {Path(one.name): FileStamp(one.name, (1, 2))}), 0.0)
    return apply(state, ReadingEnded(0), 0.0)[0]


def three() -> ReviewState:
    """Recordings of 10, 12 and 6 steps, successful from state 4, from state 7 and never."""
    return with_opened(recording("a", 10, 4, 0), recording("b", 12, 7, 1), recording("c", 6, None, 2))


def after(state: ReviewState, *commands: Command, now: float = 0.0) -> ReviewState:
    for command in commands:
        state, _ = apply(state, Asked(command), now)
    return state
