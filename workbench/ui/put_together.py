"""The two pages of the program and what they need, put together: ``workbench open`` and ``workbench review`` share it.

A folder of recordings is looked through only when somebody wants to see it: the library and the review begin with
the first review page, and live until the program ends, so that what is open there is still open after a while at the
live env.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import viser

from workbench.recording.library import Library
from workbench.recording.mend import mend
from workbench.session.record_live import recovered_in_words
from workbench.session.recorded_scene import SceneProcess
from workbench.session.review import Review
from workbench.ui.commands import Command
from workbench.ui.pages import Pages
from workbench.ui.review_page import ReviewOffers, ReviewPage
from workbench.ui.viewpoint import Stage

if TYPE_CHECKING:
    # What a live env needs is not needed for looking at recordings.
    from workbench.session.session import Session
    from workbench.ui.page import Page


@dataclass(frozen=True)
class Shelf:
    """The recordings of a folder, and those that are open."""

    library: Library
    review: Review


class Workplace:
    """Both pages over one server.

    Args:
        server: Of viser, already behind its door.
        recordings: The folder that is recorded to and reviewed.
        session: The live env, if there is one.
        tasks: Task files in which envs of foreign recordings may be found.
        imports: Modules that register such envs.
        on_notice: Called, on any thread, with a sentence that is to be seen in the terminal too.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        recordings: Path,
        session: Session | None = None,
        tasks: tuple[Path, ...] = (),
        imports: tuple[str, ...] = (),
        on_notice: Callable[[str], None] = lambda words: None,
    ) -> None:
        self._server, self._recordings, self._tasks = server, recordings, tasks
        self._imports = imports
        self._on_notice = on_notice
        self._shelf: Shelf | None = None
        self._lock = threading.Lock()
        self._mending: threading.Thread | None = None
        self._offers: Callable[[Workplace, ReviewOffers], ReviewOffers] = lambda _, offers: offers
        self.commands: tuple[Command, ...] = ()
        """In the palette of both pages; set before the first is shown."""
        self.session = session
        self._stage = Stage(server)
        self.pages = Pages(server, self._stage, {"review": self._review_page})
        if session is not None:
            self.go_live_with(session)

    @property
    def server(self) -> viser.ViserServer:
        return self._server

    @property
    def shelf(self) -> Shelf:
        """Looks into the folder when it is first asked for."""
        with self._lock:
            if self._shelf is None:
                library = Library(self._recordings)
                library.watch()
                scenes = SceneProcess(self._tasks, self._imports)
                self._shelf = Shelf(library, Review(library, make_scene=scenes))
                if self.session is None:
                    # A live env's recorder has done it, and is writing.
                    self._mending = threading.Thread(
                        target=self._mend, args=(self._shelf,), name="mend", daemon=True
                    )
                    self._mending.start()
            return self._shelf

    def _mend(self, shelf: Shelf) -> None:
        """Make episodes of what a writer left that was killed."""
        try:
            mended = [str(file) for file in mend(self._recordings)]
        except OSError as error:
            shelf.review.say(str(error))
            self._on_notice(str(error))
            return
        if mended:
            what = "An episode that was" if len(mended) == 1 else f"{len(mended)} episodes that were"
            shelf.review.say(f"{what} left half written by a program that was killed can be seen again.")
            self._on_notice(recovered_in_words(mended))
            shelf.library.look_soon()

    def go_live_with(self, session: Session) -> None:
        """From now on there is a live page, of this session. It is not shown yet."""
        self.session = session
        self.pages.offer("live", self._live_page)

    def task_files(self) -> tuple[Path, ...]:
        """The task files that this program was started with, or has open."""
        task = None if self.session is None else self.session.view().task
        live = () if task is None or task.file is None else (Path(task.file),)
        return tuple(file.absolute() for file in (*live, *self._tasks))

    def offer(self, add: Callable[[Workplace, ReviewOffers], ReviewOffers]) -> None:
        """Let `add` put more into what the review page offers; it is asked whenever that page is built."""
        before = self._offers
        self._offers = lambda place, offers: add(place, before(place, offers))

    def close(self) -> None:
        """Stop the pages and what they read from; the session is its owner's to close."""
        self.pages.stop()
        with self._lock:
            if self._shelf is not None:
                if self._mending is not None:
                    self._mending.join(timeout=10.0)
                self._shelf.review.close()
                self._shelf.library.close()

    def _live_page(self, dark: bool) -> Page:
        from workbench.ui.page import Page

        assert self.session is not None, "a live page is offered with its session"
        return Page(
            self._server, self.session, dark, lambda: self.pages.show("review"), self._stage, self.commands
        )

    def _review_page(self, dark: bool) -> ReviewPage:
        shelf = self.shelf
        shelf.library.look_soon()
        offers = ReviewOffers(
            on_back=(lambda: self.pages.show("live")) if self.pages.can_show("live") else None,
            commands=self.commands,
        )
        return ReviewPage(
            self._server, shelf.review, shelf.library, self._offers(self, offers), dark, self._stage
        )
