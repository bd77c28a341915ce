"""The Review tab: playback, the open recordings, their alignment, and facts about the selected one."""

from __future__ import annotations

import datetime
import shlex
from collections.abc import Callable

import viser

from workbench.envs.camera_data import moved_cameras_text
from workbench.episodes.episode import acted_by_text
from workbench.episodes.recorded_source import recorded_version
from workbench.page.command import Command
from workbench.page.widgets.fields import by_name, choice, tick
from workbench.page.widgets.keys_and_palette import with_key
from workbench.page.widgets.parts import PagePart
from workbench.page.widgets.templates import letter, render
from workbench.page.widgets.tools import Tool, tool, tools_html
from workbench.page.widgets.visitors import Visitor
from workbench.review.commands import (
    AlignRecordings,
    ArrangeRecordings,
    CloseRecording,
    ContinueLive,
    LoopPlayback,
    NextRecording,
    OpenAgain,
    PreviousRecording,
    SelectRecording,
    ToggleOverlaid,
)
from workbench.review.playback import Review
from workbench.review.state import MAX_OVERLAID
from workbench.review.view import Opened, ReviewView, outcome_text

MAX_CODE_CHARACTERS = 200_000
"""Maximum length of one file's text."""
GHOSTS, GRID = "overlaid", "side by side"
TRY_AGAIN = "Try again"
GO_LIVE, STAY = "Continue live from here", "Stay here"
GO_LIVE_HINT = "Restores the shown state in the live env, with the current code"


class ReviewPanel(PagePart[ReviewView]):
    """The controls in the current container; those for comparisons are shown only while several recordings
    are open.

    Args:
        server: The page.
        review: The review of the page.
        on_go_live: Called with the id of the selected recording and the shown state, when the user continues live from
            there, and again to cancel the transition.
        going: Returns a text: what the transition to the live env waits for; empty if there is no transition.
    """

    does = (
        NextRecording,
        PreviousRecording,
        SelectRecording,
        CloseRecording,
        LoopPlayback,
        OpenAgain,
        ArrangeRecordings,
        ToggleOverlaid,
        AlignRecordings,
        ContinueLive,
    )

    def __init__(
        self,
        server: viser.ViserServer,
        review: Review,
        on_go_live: Callable[[str, int], None],
        going: Callable[[], str],
    ) -> None:
        self._review, self._on_go_live, self._going = review, on_go_live, going
        gui = server.gui
        self._arranged = GHOSTS
        self._tools = gui.add_html("")
        self._loop = tick(server, "Loop", LoopPlayback, "on", False)
        self._problems = gui.add_html("")
        self._again = gui.add_html("")
        self._list = gui.add_html("")
        self._arrange = choice(
            server, "Layout", ArrangeRecordings, "layout", (GHOSTS, GRID), GHOSTS, hint="Press O to switch."
        )
        self._align = choice(server, "Align at", AlignRecordings, "at", ("start",), "start")
        self._unaligned_note = gui.add_html("")
        self._facts = gui.add_html("")
        self._listed: object = None
        """Key of the data that the list was drawn for."""
        self._facts_of: tuple[Opened, str] | None = None
        """Key of the data that the facts were drawn for."""

    @property
    def ghosts(self) -> bool:
        """Whether the recordings are drawn overlaid: the user chose it, and they are few enough."""
        return self._arranged == GHOSTS and len(self._review.view().opened) <= MAX_OVERLAID

    def do(self, command: Command, visitor: Visitor) -> None:
        match command:
            case ArrangeRecordings(layout=layout):
                self._arranged = layout
            case ToggleOverlaid():
                self._arranged = GRID if self._arranged == GHOSTS else GHOSTS
            case ContinueLive():
                self._enter_recording()
            case _:
                self._review.do(command, visitor.name)

    def lay_side_by_side(self) -> None:
        self._arranged = GRID

    def _enter_recording(self) -> None:
        view = self._review.view()
        if view.chosen is not None:
            self._on_go_live(view.chosen.id, view.states[view.selected])

    def draw(self, view: ReviewView) -> None:
        there = bool(view.opened)
        self._loop.visible = there
        live = GO_LIVE if len(view.opened) < 2 else f"{GO_LIVE} ({letter(view.selected)})"
        live = STAY if self._going() else live
        go_live = Tool(live, ContinueLive(), with_key(ContinueLive, GO_LIVE_HINT))
        self._tools.content = tools_html([go_live]) if there else ""
        self._loop.show(view.loop)
        self._problems.content = render("review_problems", problems=view.problems, loading=view.loading)
        again = bool(view.not_opened) and not view.loading
        self._again.content = tools_html([tool(TRY_AGAIN, OpenAgain())] if again else [])
        listed = (view.opened, view.selected, bool(view.loading))
        if self._listed != listed:
            # Do not redraw the list at every position: with many recordings that takes most of a frame's
            # time.
            self._listed = listed
            self._list.content = self._list_html(view)
        self._arrange.visible = 1 < len(view.opened) <= MAX_OVERLAID
        self._arrange.show(self._arranged)
        self._align.visible = len(view.opened) > 1 and len(view.alignments) > 1
        self._align.show(view.align, options=by_name(view.alignments))
        unaligned = unaligned_text(view)
        self._unaligned_note.content = render("note", text=unaligned) if unaligned else ""
        facts_of = view.chosen and (view.chosen, view.changed_symbols)
        if self._facts_of != facts_of:
            self._facts_of = facts_of
            self._facts.content = facts_html(*facts_of) if facts_of else ""

    def _list_html(self, view: ReviewView) -> str:
        if not view.opened and view.loading:
            return ""
        presses = [(SelectRecording(id=one.id), CloseRecording(id=one.id)) for one in view.opened]
        return render("review_opened", view=view, presses=presses, outcome_text=outcome_text)


def unaligned_text(view: ReviewView) -> str:
    """The note on open recordings that lack the event at which all are aligned; empty if none lacks it."""
    name = view.align.removeprefix("first ")
    without = [letter(i) for i, one in enumerate(view.opened) if one.first(name) is None]
    if view.align == "start" or not without:
        return ""
    verb = "has" if len(without) == 1 else "have"
    return f"{', '.join(without)} {verb} no {name}, and {'is' if len(without) == 1 else 'are'} aligned at the start."


def facts_html(chosen: Opened, changed: str) -> str:
    """Facts about a recording, as HTML.

    Args:
        changed: symbols of the recording's task that changed since the recording, as text.
    """
    info = chosen.episode.info
    return render(
        "review_facts",
        of=chosen,
        info=info,
        version=recorded_version(info) or info.source_hash,
        changed=changed,
        most=MAX_CODE_CHARACTERS,
        acted_by=acted_by_text(info.acted_by),
        observed_by=info.observed_by,
        moved=moved_cameras_text(info.moved_cameras),
        assignments=assignments,
        local_time=local_time,
    )


def assignments(values: dict[str, object]) -> str:
    return ", ".join(f"{name}={shlex.quote(str(value))}" for name, value in values.items())


def local_time(written: str) -> str:
    try:
        return datetime.datetime.fromisoformat(written).astimezone().strftime("%Y-%m-%d %H:%M:%S")
    except (ValueError, OverflowError):
        return written
