"""The application: all pages of one server, and the objects that they share."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path

from workbench.app import help_pages
from workbench.app.go_live import GoLive, MakeSession
from workbench.app.open_task import Choices, OpenTask
from workbench.app.pages import ShownPage, Which
from workbench.app.recording_problems import RecordingProblems
from workbench.app.review_page import ReviewPage, ReviewTools
from workbench.app.session import Session
from workbench.app.shared import Shared
from workbench.app.start_page import StartPage
from workbench.machine.loop import begin, result_of
from workbench.page.command import Command, Refused
from workbench.page.commands import AnswerTrust, CloseDialog, OpenHelp, RenewToken
from workbench.page.door.gated_server import GatedServer
from workbench.page.widgets.visitors import Done, Visitor
from workbench.rescore.recording_jobs import Rescorer
from workbench.rescore.recordings_panel import RescoreChoices
from workbench.share.panel import Sharing
from workbench.start.catalogue import Catalogue
from workbench.start.panel import PICTURES, picture_route
from workbench.start.recents import RecentTasks
from workbench.start.registered import RegisteredTasks
from workbench.task.description import TaskOptions
from workbench.trust.clearance import Clearances
from workbench.trust.consent_dialog import TrustDialog


class App:
    """All pages on one server, and the objects that outlive them. Used by ``workbench``, ``open`` and ``review``.

    Args:
        gated_server: The server of the pages.
        recordings: The folder that is recorded to and reviewed.
        make_session: Opens a task that a recording names, with the given options.
        base: Options that all tasks named by recordings share.
        session: The live env, if there is one.
        tasks: Task files that may define the envs of foreign recordings.
        trust: Whether code that recordings name runs without a question.
        on_notice: Called, on any thread, with a message for the terminal.
        editor: URL template that opens a line in the author's editor, from `parse_editor`.
        choices: The recent tasks for the list of tasks, and how a chosen task is opened. With None, the list
            has no recent tasks, and `make_session` opens the chosen task.
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
        self.shared = shared = Shared(
            gated_server, recordings, self._page, session, tasks, base.imports, on_notice
        )
        self._editor = editor
        self.renew_token: Callable[[], None] | None = None
        """Makes a new token. Set before the first page is shown; None if the page needs no token."""
        shared.visitors.do = self._do
        self._dialog = TrustDialog(shared.server)
        clearances = Clearances(shared.task_files, self._dialog.ask, all_trusted=trust)
        self.go_live = GoLive(shared, make_session, clearances, base)
        self.review_tools = ReviewTools(
            self.go_live, Rescorer(clearances, base), RescoreChoices(), Sharing(gated_server)
        )
        gated_server.add_route(help_pages.ADDRESS, help_pages.reply, help_pages.HEADERS)
        self._problems = RecordingProblems(shared.server, lambda: shared.session, on_notice)
        if choices is None:
            open_session = lambda task, options, kept: make_session(task, options)  # noqa: E731
            choices = Choices(RecentTasks(), open_session, base)
        registered = RegisteredTasks(shared.is_idle)
        catalogue = Catalogue(Path.cwd(), recordings, choices.recents, registered, choices.options)
        gated_server.add_route(PICTURES, picture_route(catalogue), {"Cache-Control": "private, max-age=3600"})
        self.open_task = OpenTask(shared, self.go_live, choices.open_session, catalogue, clearances)

    @property
    def does(self) -> frozenset[type[Command]]:
        """Commands that work on every page."""
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
                self._dialog.answer(command)
            case CloseDialog() if self._dialog.say_no():
                pass
            case _:
                return self.shared.pages.do(command, visitor)
        return None

    def _page(self, which: Which, dark: bool) -> ShownPage:
        shared = self.shared
        if which == "start":
            return StartPage(shared, self.open_task, self.does, dark)
        if which == "review":
            shared.recordings.library.request_scan()
            first_tab, shared.looks_at = shared.looks_at, False
            return ReviewPage(shared, self.open_task, self.review_tools, self.does, dark, first_tab)
        # Imported late: a review alone does not need it.
        from workbench.app.live_page import Page

        assert shared.session is not None, "the live page is shown with its session"
        return Page(
            shared.server,
            shared.visitors,
            shared.session,
            dark,
            lambda: shared.pages.show("review"),
            shared.look_at,
            shared.stage,
            self.does,
            editor=self._editor,
            chooser=self.open_task,
        )

    def finish_saving(self, seconds: float) -> None:
        """Wait up to `seconds` until no session is saving episodes. Must not be called on the loop."""

        async def saved() -> None:
            await asyncio.wait([begin(one.saved()) for one in self.shared.sessions], timeout=seconds)

        if self.shared.sessions:
            result_of(saved())

    def close(self) -> None:
        """Stop the pages and their readers, and close the open session; episodes that are still being saved are lost.
        The caller closes the server."""
        for session in self.shared.sessions:
            session.give_up_saving()
        self.shared.pages.stop()
        self._problems.close()
        self.open_task.close()
        self.shared.close()
        tools = self.review_tools
        for part in (tools.sharing, self._dialog, tools.rescorer, self.go_live):
            part.close()
        if self.shared.home is not None:
            self.shared.home.close()
