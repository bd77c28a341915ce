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

from workbench.jobs.task import TaskOptions
from workbench.recording.library import Library
from workbench.recording.reading import mend, recovered_in_words
from workbench.session.clearance import Clearances
from workbench.session.recorded_scene import SceneProcess
from workbench.session.rescore import Rescorer
from workbench.session.review import Review
from workbench.session.session import Session
from workbench.ui.commands import Command
from workbench.ui.door import Door
from workbench.ui.pages import Pages, Which
from workbench.ui.rescore_panel import RescoreChoices
from workbench.ui.review_page import ReviewPage
from workbench.ui.share_panel import Sharing
from workbench.ui.step_in import MakeSession, StepIn
from workbench.ui.trust_dialog import TrustDialog
from workbench.ui.viewpoint import Stage

if TYPE_CHECKING:
    from workbench.ui.page import Page


@dataclass(frozen=True)
class Shelf:
    """The recordings of a folder, and those that are open."""

    library: Library
    review: Review


class Workplace:
    """Both pages behind one door, and what outlives them.

    Args:
        door: Of the pages.
        recordings: The folder that is recorded to and reviewed.
        make_session: Opens a task that a recording names; gets what `Session` gets.
        base: What is the same for all tasks that recordings name.
        session: The live env, if there is one.
        tasks: Task files in which envs of foreign recordings may be found.
        trust: Run what recordings name without asking.
        on_notice: Called, on any thread, with a sentence that is to be seen in the terminal too.
    """

    def __init__(
        self,
        door: Door,
        recordings: Path,
        make_session: MakeSession,
        base: TaskOptions,
        session: Session | None = None,
        tasks: tuple[Path, ...] = (),
        trust: bool = False,
        on_notice: Callable[[str], None] = lambda words: None,
    ) -> None:
        self.server, self._recordings, self._tasks = door.server, recordings, tasks
        self._imports, self._on_notice = base.imports, on_notice
        self._shelf: Shelf | None = None
        self._lock = threading.Lock()
        self._mending: threading.Thread | None = None
        self.commands: tuple[Command, ...] = ()
        """In the palette of both pages; set before the first is shown."""
        self.session = session
        """That the live page shows when it is next built."""
        self.dialog = TrustDialog(self.server)
        clearances = Clearances(self.task_files, self.dialog.ask, all_trusted=trust)
        self.step_in = StepIn(self, make_session, clearances, base)
        self.rescorer, self.rescore_choices = Rescorer(clearances, base), RescoreChoices()
        self.sharing = Sharing(door)
        self.stage = Stage(self.server)
        self.pages = Pages(self.server, self.stage, self._page)

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

    def task_files(self) -> tuple[Path, ...]:
        """The task files that this program was started with, or has open."""
        task = None if self.session is None else self.session.view().task
        live = () if task is None or task.file is None else (Path(task.file),)
        return tuple(file.absolute() for file in (*live, *self._tasks))

    def close(self) -> None:
        """Stop the pages and what they read from; the first session and the door are their owner's to close."""
        self.pages.stop()
        with self._lock:
            if self._shelf is not None:
                if self._mending is not None:
                    self._mending.join(timeout=10.0)
                self._shelf.review.close()
                self._shelf.library.close()
        for part in (self.sharing, self.dialog, self.rescorer.judging, self.step_in):
            part.close()

    def _page(self, which: Which, dark: bool) -> Page | ReviewPage:
        if which == "review":
            self.shelf.library.look_soon()
            return ReviewPage(self, dark)
        # What a live env needs is not needed for looking at recordings.
        from workbench.ui.page import Page

        assert self.session is not None, "the live page is shown with its session"
        return Page(
            self.server, self.session, dark, lambda: self.pages.show("review"), self.stage, self.commands
        )
