"""The Review tab: playback, the open recordings, their alignment, and facts about the selected one."""

from __future__ import annotations

import datetime
import shlex
from collections.abc import Callable

import viser

from workbench.core.camera_data import moved_cameras_text
from workbench.jobs.from_recording import ChangesOnDisk, recorded_version
from workbench.recording.episode.episode import acted_by_text
from workbench.session.review.review import MOST_COMPARED, SPEEDS, Review
from workbench.session.review.view import Opened, ReviewView, outcome_text
from workbench.ui.widgets.click_targets import Presses
from workbench.ui.widgets.inputs import Control
from workbench.ui.widgets.parts import PagePart
from workbench.ui.widgets.templates import letter, render

MOST_OF_CODE = 200_000
"""Characters of one file."""
SPEED_NAMES = {f"{speed:g} ×": speed for speed in SPEEDS}
GHOSTS, GRID = "overlaid", "side by side"
TRY_AGAIN = "Try again"
GO_LIVE, STAY = "Continue live from here", "Stay here"


class ReviewPanel(PagePart[ReviewView]):
    """The controls in the present container; those for comparing only while several recordings are open.

    Args:
        server: The page.
        review: Of the page.
        on_go_live: Called with the id of the selected recording and the state that is shown, when a person wants to
            continue from there live, and again to stay in the review instead.
        going: What is waited for on the way to the live env.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        review: Review,
        on_go_live: Callable[[str, int], None],
        going: Callable[[], str],
    ) -> None:
        self._review, self._on_go_live, self._going = review, on_go_live, going
        gui = server.gui
        self._play = gui.add_button("Play", icon=viser.Icon.PLAYER_PLAY, visible=False)
        self._play.on_click(lambda _: review.toggle_play())
        self._live = gui.add_button(
            GO_LIVE,
            icon=viser.Icon.PLAYER_TRACK_NEXT,
            color="gray",
            visible=False,
            hint="Restores the shown state in the live env, with the current code (Shift+G).",
        )
        self._live.on_click(lambda _: self.enter_recording())
        self._speed = Control(
            gui.add_dropdown("Speed", tuple(SPEED_NAMES), initial_value="1 ×", visible=False),
            read=lambda value: SPEED_NAMES[value],
            send=review.set_speed,
            shown=lambda speed: next((n for n, known in SPEED_NAMES.items() if known == speed), "1 ×"),
        )
        self._loop = Control(
            gui.add_checkbox("Loop", False, visible=False),
            send=review.set_loop,
        )
        self._problems = gui.add_html("")
        self._again = gui.add_button(
            TRY_AGAIN,
            icon=viser.Icon.REFRESH,
            color="gray",
            visible=False,
            hint="Reads once more what could not be opened: it may only have taken too long",
        )
        self._again.on_click(lambda _: review.open_again())
        self._list = gui.add_html("")
        self._arrange = gui.add_dropdown(
            "Layout", (GHOSTS, GRID), initial_value=GHOSTS, visible=False, hint="The O key switches."
        )
        align: viser.GuiDropdownHandle = gui.add_dropdown(
            "Align at", ("start",), initial_value="start", visible=False
        )
        self._align = Control(align, send=review.align)
        self._unaligned_note = gui.add_html("")
        self._facts = gui.add_html("")
        self._changes = ChangesOnDisk()
        self._presses = Presses(server)
        self._listed: object = None
        """What the list was drawn for."""
        self._facts_of: tuple[Opened, str] | None = None
        """What the facts were drawn for."""

    @property
    def ghosts(self) -> bool:
        """Whether the recordings are drawn over each other: chosen, and few enough."""
        return self._arrange.value == GHOSTS and len(self._review.view().opened) <= MOST_COMPARED

    def toggle_arrangement(self) -> None:
        self._arrange.value = GRID if self._arrange.value == GHOSTS else GHOSTS

    def lay_side_by_side(self) -> None:
        self._arrange.value = GRID

    def enter_recording(self) -> None:
        view = self._review.view()
        if view.chosen is not None:
            self._on_go_live(view.chosen.id, view.states[view.selected])

    def select_neighbour(self, step: int) -> None:
        """Select the next (1) or previous (-1) open recording, wrapping around."""
        view = self._review.view()
        if view.opened:
            self._review.select((view.selected + step) % len(view.opened))

    def draw(self, view: ReviewView) -> None:
        there = bool(view.opened)
        for handle in (self._play, self._live, self._speed.handle, self._loop.handle):
            handle.visible = there
        live = GO_LIVE if len(view.opened) < 2 else f"{GO_LIVE} ({letter(view.selected)})"
        live = STAY if self._going() else live
        self._live.label = live
        label = "Pause" if view.playing else "Play"
        self._play.label = label
        self._play.icon = viser.Icon.PLAYER_PAUSE if view.playing else viser.Icon.PLAYER_PLAY
        self._speed.show(view.speed)
        self._loop.show(view.loop)
        self._problems.content = render("review_problems", problems=view.problems, loading=view.loading)
        self._again.visible = bool(view.not_opened) and not view.loading
        listed = (view.opened, view.selected, bool(view.loading))
        if self._listed != listed:
            # Not at every position: with many recordings it would be most of a frame's cost.
            self._listed = listed
            self._list.content = self._list_html(view)
        self._arrange.visible = 1 < len(view.opened) <= MOST_COMPARED
        self._align.handle.visible = len(view.opened) > 1 and len(view.alignments) > 1
        if self._align.handle.options != view.alignments:
            self._align.handle.options = view.alignments
        self._align.show(view.align)
        unaligned = unaligned_text(view)
        self._unaligned_note.content = render("note", text=unaligned) if unaligned else ""
        facts_of = view.chosen and (view.chosen, self._changes.of(view.chosen.episode.info))
        if self._facts_of != facts_of:
            self._facts_of = facts_of
            self._facts.content = facts_html(*facts_of) if facts_of else ""

    def _list_html(self, view: ReviewView) -> str:
        if not view.opened and view.loading:
            return ""
        presses = [
            (
                self._presses.id_of(("select", index), lambda _, index=index: self._review.select(index)),
                self._presses.id_of(("close", index), lambda _, index=index: self._review.close_one(index)),
            )
            for index in range(len(view.opened))
        ]
        return render("review_opened", view=view, presses=presses, outcome_text=outcome_text)


def unaligned_text(view: ReviewView) -> str:
    """The note on recordings without the event that they are aligned at."""
    name = view.align.removeprefix("first ")
    without = [letter(i) for i, one in enumerate(view.opened) if one.first(name) is None]
    if view.align == "start" or not without:
        return ""
    verb = "has" if len(without) == 1 else "have"
    return f"{', '.join(without)} {verb} no {name}, and {'is' if len(without) == 1 else 'are'} aligned at the start."


def facts_html(chosen: Opened, changed: str) -> str:
    """Facts about a recording, as HTML.

    Args:
        changed: which symbols of its task changed since the recording.
    """
    info = chosen.episode.info
    return render(
        "review_facts",
        of=chosen,
        info=info,
        version=recorded_version(info) or info.source_hash,
        changed=changed,
        most=MOST_OF_CODE,
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
