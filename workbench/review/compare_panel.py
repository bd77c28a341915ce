"""The Compare tab: the first difference between two recordings, entry by entry."""

from __future__ import annotations

import viser

from workbench.envs.step_result import TERM_PREFIX
from workbench.episodes.episode import NO_SEED
from workbench.live.timeline_commands import Seek
from workbench.machine.text import length
from workbench.page.command import Command, Refused
from workbench.page.widgets.fields import choice
from workbench.page.widgets.parts import PagePart
from workbench.page.widgets.templates import letter, render
from workbench.page.widgets.tools import Tool, tools_html
from workbench.page.widgets.visitors import Visitor
from workbench.review.commands import ChooseTolerance, CompareWith, SwapWithFirst
from workbench.review.differences import (
    DEFAULT_TOLERANCE_METRES,
    TOLERANCES_METRES,
    Difference,
    FirstDifference,
    difference,
)
from workbench.review.playback import Review
from workbench.review.view import Opened, ReviewView

TOLERANCE_NAMES = {length(metres): metres for metres in TOLERANCES_METRES}
MAX_ROWS = 30


class ReviewComparePanel(PagePart[ReviewView]):
    """Compares the first recording with another. Each row is an entry; a press on it goes to the first state
    at which the entry differs."""

    does = (CompareWith, SwapWithFirst, ChooseTolerance)

    def __init__(self, server: viser.ViserServer, review: Review) -> None:
        self._review = review
        self._wish, self._metres = 1, DEFAULT_TOLERANCE_METRES
        """(index of the recording that the user chose last, tolerance in metres). The index is kept even
        while too few recordings are open for it."""
        self._other = choice(server, "A against", CompareWith, "index", {"B": 1}, 1)
        self._swap = server.gui.add_html("")
        self._tolerance = choice(
            server,
            "Tolerance",
            ChooseTolerance,
            "metres",
            TOLERANCE_NAMES,
            DEFAULT_TOLERANCE_METRES,
            hint="A body counts as different if its poses in the two recordings are further apart than this.",
        )
        self._html = server.gui.add_html("")
        self._differing: list[FirstDifference] = []
        """First difference of each row of the table."""

    def key(self, view: ReviewView) -> object:
        return view.opened_serial, len(view.opened), view.anchors, self._wish, self._metres

    def draw(self, view: ReviewView) -> None:
        several = len(view.opened) > 1
        other = self._wish if self._wish < len(view.opened) else 1
        self._other.visible = len(view.opened) > 2
        self._other.show(other, options={letter(index): index for index in range(1, len(view.opened))})
        self._tolerance.visible = several
        self._tolerance.show(self._metres)
        swap = Tool(f"Swap A and {letter(other)}", SwapWithFirst(index=other), "Makes the other recording A")
        self._swap.content = tools_html([swap] if several else [])
        if not several:
            self._html.content = render("note", text="Open two recordings to see where they diverge.")
            return
        a, b = view.opened[0], view.opened[other]
        found = difference(a.episode, b.episode, (view.anchors[0], view.anchors[other]), self._metres)
        self._html.content = self._content(a, b, other, found, view)

    def _content(self, a: Opened, b: Opened, other: int, found: Difference, view: ReviewView) -> str:
        differences = [*([found.bodies] if found.bodies else []), *found.numbers]
        self._differing = [p for p in differences if p.position is not None]
        presses = [Seek(step=p.position) for p in self._differing[:MAX_ROWS] if p.position is not None]
        one_sided = [f"{p.name} ({p.values})" for p in differences if p.position is None and p.values]
        return render(
            "review_compare",
            a=a,
            b=b,
            other=other,
            view=view,
            found=found,
            headline=headline(found),
            notes=notes(a, b, found),
            totals=next((p.totals for p in found.numbers if p.name == "reward"), ""),
            rows=list(zip(self._differing, presses, strict=False)),
            more=len(self._differing) - len(presses),
            same=", ".join(
                p.name.removeprefix(TERM_PREFIX) for p in differences if p.position is None and not p.values
            ),
            one_sided=", ".join((*one_sided, *found.not_in_both)),
            prefix=TERM_PREFIX,
        )

    def do(self, command: Command, visitor: Visitor) -> None:
        match command:
            case CompareWith(index=index) if index >= len(self._review.view().opened):
                raise Refused("This recording is not open any more.")
            case CompareWith(index=index):
                self._wish = index
            case ChooseTolerance(metres=metres):
                self._metres = metres
            case _:
                self._review.do(command, visitor.name)


def headline(found: Difference) -> str:
    if found.bodies is None:
        return "One of them has no scene; only numbers are compared."
    if found.bodies.position is None:
        apart = "" if found.bodies.largest == "0" else f", at most {found.bodies.largest} apart"
        return f"All bodies move alike{apart}."
    return (
        f"They diverge at step {found.bodies.position} ({found.bodies.values}), up to {found.bodies.largest}."
    )


def notes(a: Opened, b: Opened, found: Difference) -> list[str]:
    texts = []
    if a.episode.info.task != b.episode.info.task:
        texts.append("They are from different tasks.")
    elif without := [name for name, one in (("A", a), ("B", b)) if one.episode.info.seed <= NO_SEED]:
        texts.append(f"{' and '.join(without)} {'has' if len(without) == 1 else 'have'} no seed.")
    elif not found.same_seed:
        texts.append("They have different seeds.")
    if a.length != b.length:
        texts.append(f"{a.length} and {b.length} steps; {found.compared} states are compared.")
    of_batch = dict.fromkeys(name for each in (a, b) for name in (*each.episode.batch, *each.episode.texts))
    if of_batch:
        texts.append(f"Not compared, because they are not per env: {', '.join(of_batch)}.")
    if abs(a.episode.info.control_dt - b.episode.info.control_dt) > 1e-9:
        texts.append("Their control steps differ in duration.")
    return texts
