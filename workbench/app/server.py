"""Owns the three pages and what they share: the list of tasks, recordings, dialogs, rescoring and the live session."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import psutil

from workbench.app import help_pages
from workbench.app.go_live import GoLive, MakeSession
from workbench.app.open_task import Choices, OpenTask
from workbench.app.pages import Pages, ShownPage, Which
from workbench.app.recording_problems import RecordingProblems
from workbench.app.review_page import ReviewPage
from workbench.app.session import Session
from workbench.app.start_page import StartPage
from workbench.episodes.reader.reading import recover_confined, recovered_text
from workbench.library.folder import Library
from workbench.machine.loop import Aside
from workbench.page.command import Command, Refused
from workbench.page.commands import AnswerTrust, CloseDialog, OpenHelp, RenewToken
from workbench.page.door.gated_server import GatedServer
from workbench.page.scene.viewpoint import Stage
from workbench.page.widgets.visitors import PATH, Done, Visitor, Visitors
from workbench.rescore.recording_jobs import Rescorer
from workbench.rescore.recordings_panel import RescoreChoices
from workbench.review.playback import Review
from workbench.review.recorded_scene import SceneProcess
from workbench.share.panel import Sharing
from workbench.start.catalogue import Catalogue
from workbench.start.panel import PICTURES, picture_route
from workbench.start.recents import RecentTasks
from workbench.start.registered import RegisteredTasks
from workbench.task.description import TaskOptions
from workbench.trust.clearance import Clearances
from workbench.trust.dialog import TrustDialog

if TYPE_CHECKING:
    pass

ENOUGH_MEMORY = 4 << 30
"""Minimum free memory in bytes for drawing pictures of tasks while a task is open."""

_RECOVERED_WITHIN = 10.0
"""Seconds that the end of the program waits for the recovery of episodes."""


@dataclass(frozen=True)
class Shelf:
    """The recordings of a folder, and the review of those that are open."""

    library: Library
    review: Review


class Workplace:
    """All pages on one server, and what outlives them. Used by ``workbench``, ``open`` and ``review``.

    Args:
        gated_server: The server of the pages.
        recordings: The folder that is recorded to and reviewed.
        make_session: Opens a task that a recording names; gets what `Session` gets.
        base: Options that all tasks named by recordings share.
        session: The live env, if there is one.
        tasks: Task files that may define the envs of foreign recordings.
        trust: Run code named by recordings without asking.
        on_notice: Called, on any thread, with a message for the terminal.
        editor: Address of a line in the author's editor, as `parse_editor` gives it.
        choices: What the list of tasks offers, and how a chosen one is opened; None for no recent ones and `make_session`.
    """

    def __init__(
        self,
        gated_server: GatedServer,
        recordings: Path,
        make_session: MakeSession,
        base: TaskOptions,
        session: Session | None = None,
        tasks: tuple[Path, ...] = (),
        trust: bool = False,
        on_notice: Callable[[str], None] = lambda words: None,
        editor: str = "",
        choices: Choices | None = None,
    ) -> None:
        self.server, self._recordings, self._tasks = gated_server.server, recordings, tasks
        self._imports, self._on_notice, self._editor = base.imports, on_notice, editor
        self._shelf: Shelf | None = None
        self._first: Path | Literal["newest"] = "newest"
        """Recording that the first review opens."""
        self._recovering = Aside("recover")
        self.renew_token: Callable[[], None] | None = None
        """Set before the first page is shown, where there is a token."""
        self.visitors = Visitors(self.server)
        self.visitors.do = self._do
        gated_server.add_channel(PATH, self.visitors.serve)
        self.session = session
        """Session that the live page shows when it is next built."""
        self.home = session
        """The session that a person opened, by command or from the list. `session` is another one while a recording of
        another task is continued."""
        self._looks_at = False
        """Whether the next review page is for a recording that a person chose on another page."""
        self.dialog = TrustDialog(self.server)
        clearances = Clearances(self.task_files, self.dialog.ask, all_trusted=trust)
        self.go_live = GoLive(self, make_session, clearances, base)
        self.rescorer, self.rescore_choices = Rescorer(clearances, base), RescoreChoices()
        self.sharing = Sharing(gated_server)
        gated_server.add_route(help_pages.ADDRESS, help_pages.reply, help_pages.HEADERS)
        self.stage = Stage(self.server)
        self.pages = Pages(self.server, self.stage, self._page)
        self._problems = RecordingProblems(self.server, lambda: self.session, on_notice)
        if choices is None:
            open_session = lambda task, options, kept: make_session(task, options)  # noqa: E731
            choices = Choices(RecentTasks(), open_session, base)
        registered = RegisteredTasks(self.is_idle)
        catalogue = Catalogue(Path.cwd(), recordings, choices.recents, registered, choices.options)
        gated_server.add_route(PICTURES, picture_route(catalogue), {"Cache-Control": "private, max-age=3600"})
        self.open_task = OpenTask(self, choices.open_session, catalogue, clearances)

    @property
    def shelf(self) -> Shelf:
        """The folder is read at the first access, by the first review page; it stays open until the program ends."""
        self._shelf = self._shelf or self._make_shelf()
        return self._shelf

    def _make_shelf(self) -> Shelf:
        library = Library(self._recordings)
        review = Review(library, make_scene=SceneProcess(self._tasks, self._imports))
        library.on_change.add(review.library_changed)
        review.open_first(self._first)
        library.watch()
        shelf = Shelf(library, review)
        if self.session is None:
            # With a live env its recorder has recovered them already, and is writing.
            self._recovering.begin(lambda: self._recover(shelf))
        return shelf

    @property
    def does(self) -> frozenset[type[Command]]:
        """Commands that are carried out whichever page is shown."""
        return frozenset({OpenHelp} if self.renew_token is None else {OpenHelp, RenewToken})

    def _do(self, command: Command, visitor: Visitor) -> Done:
        match command:
            case OpenHelp():
                pass  # The browser itself opens the page (``web_assets/panels.js``).
            case RenewToken():
                if self.renew_token is None:
                    raise Refused("This page asks for no token; there is none to renew.")
                self.renew_token()
            case AnswerTrust():
                self.dialog.answer(command)
            case CloseDialog() if self.dialog.say_no():
                pass
            case _:
                return self.pages.do(command, visitor)
        return None

    def _recover(self, shelf: Shelf) -> None:
        """Recover episodes of a writer that was killed."""
        try:
            recovered = [str(file) for file in recover_confined(self._recordings)]
        except OSError as error:
            shelf.review.add_problem(str(error))
            self._on_notice(str(error))
            return
        if recovered:
            what = "An episode" if len(recovered) == 1 else f"{len(recovered)} episodes"
            shelf.review.add_problem(f"{what} left half written by a killed program is back in the library.")
            self._on_notice(recovered_text(recovered))
            shelf.library.request_scan()

    def task_files(self) -> tuple[Path, ...]:
        """The task files that this program was started with or has open."""
        task = None if self.session is None else self.session.view().task
        live = () if task is None or task.file is None else (Path(task.file),)
        return tuple(file.absolute() for file in (*live, *self._tasks))

    def is_idle(self) -> bool:
        """Whether the machine is free for other work than an open task."""
        session = self.session
        if session is None:
            return True
        view = session.view()
        free = psutil.virtual_memory().available
        return view.state in ("paused", "error", "stopped") and view.busy is None and free > ENOUGH_MEMORY

    def close(self) -> None:
        """Stop the pages and their readers, and close the open session. The caller closes the server."""
        self.pages.stop()
        self._problems.close()
        self.open_task.close()
        self._recovering.close(_RECOVERED_WITHIN)
        if self._shelf is not None:
            self._shelf.review.close()
            self._shelf.library.close()
        for part in (self.sharing, self.dialog, self.rescorer, self.go_live):
            part.close()
        if self.home is not None:
            self.home.close()

    def look_at(self, recording: Path) -> None:
        """Open the recording with this file in the review."""
        self._first, self._looks_at = recording, True
        if self._shelf is not None:
            self._shelf.review.open_first(recording)
        self.pages.show("review")

    def _page(self, which: Which, dark: bool) -> ShownPage:
        if which == "start":
            return StartPage(self, dark)
        if which == "review":
            self.shelf.library.request_scan()
            anew, self._looks_at = self._looks_at, False
            return ReviewPage(self, dark, anew)
        # Imported late: a review alone does not need it.
        from workbench.app.live_page import Page

        assert self.session is not None, "the live page is shown with its session"
        return Page(
            self.server,
            self.visitors,
            self.session,
            dark,
            lambda: self.pages.show("review"),
            self.look_at,
            self.stage,
            self.does,
            editor=self._editor,
            chooser=self.open_task,
        )
