"""Opens a listed task in place of the open one: asks for consent, and replaces the session."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import dataclass

from workbench.app.go_live import GoLive
from workbench.app.session import KeptWork, Session
from workbench.app.shared import Shared
from workbench.live.commands import PauseRun
from workbench.machine.folders import example_tasks
from workbench.machine.loop import BlockingPool, begin, result_of
from workbench.machine.processes.watched_thread import report_failure
from workbench.page.widgets.notices import notify_all
from workbench.page.widgets.templates import sentence
from workbench.start.catalogue import Catalogue, Entry, Section
from workbench.start.commands import TemplateName
from workbench.start.recents import RecentTasks
from workbench.task.description import TaskOptions
from workbench.task.find import is_below
from workbench.task.new_task import write_new_task
from workbench.task.reference import TaskName, file_and_class, lasting
from workbench.trust.clearance import Clearances, NotCleared

OpenSession = Callable[[TaskName, TaskOptions, KeptWork | None], Session]
"""Opens a task, with the work kept from its last session."""


@dataclass(frozen=True)
class Choices:
    """The recent tasks, which the list shows in addition to those that it finds, and how to open a task."""

    recents: RecentTasks
    open_session: OpenSession
    options: TaskOptions
    """Options of tasks without options of their own."""


_SHOW_TIMEOUT_SECONDS = 10.0
"""Maximum time for which the old session stays open while the page of the new session is built."""


class OpenTask:
    """Opens the task that the user chooses from the list.

    It opens one task at a time, which may take minutes: it waits until the user allows the code, and until
    the old session has saved and written its recordings. A newer request withdraws the question that an older request
    still asks. The page of the new session is shown first, then the old session is closed as at the end of
    the program. Call all methods on the loop, except `close`.

    Args:
        shared: The pages and the open session.
        go_live: Ends the session that it opened for a recording, if there is one.
        open_session: Opens a task.
        catalogue: The tasks that may be chosen.
        clearances: Decide whether a file may run.
    """

    def __init__(
        self,
        shared: Shared,
        go_live: GoLive,
        open_session: OpenSession,
        catalogue: Catalogue,
        clearances: Clearances,
    ) -> None:
        self._shared, self._go_live, self._open_session = shared, go_live, open_session
        self.catalogue, self._clearances = catalogue, clearances
        home = shared.home
        self._open_reference = "" if home is None else lasting(str(home.reference))
        """Reference of the task that the user opened, in the form of `Entry.lasting`."""
        self._wish: Entry | None = None
        self._opening: asyncio.Task[None] | None = None
        self._aside = BlockingPool("open-task")
        self._doing = ""
        self._closing = False
        self._ran: set[str] = set()
        """References of tasks that were open in this run; these open again without a question."""
        self._kept: dict[str, KeptWork] = {}
        """Work kept from sessions of this run, by `lasting` reference."""

    def choose(self, number: int) -> None:
        """Open the row with this number; returns at once. Raises `Refused` for a number that is not listed."""
        entry = self.catalogue.entry(number)
        if entry is not None:
            self._want(entry)

    def _want(self, entry: Entry) -> None:
        self._wish = entry
        if self._opening is None or self._opening.done():
            self._opening = begin(self._open_wishes())

    async def create(self, name: str, template: TemplateName) -> None:
        """Write a new task into the folder of the list, and open it; see `Chooser.create`."""
        made = await self._aside.run(lambda: write_new_task(name, template, self.catalogue.folder))
        # The row is passed on, not its number: a search that began before the file was written may end now,
        # and its list lacks the file.
        self._want(self.catalogue.add_file(made.file, made.env_id))

    def doing(self) -> str:
        """Text for the page: the work in progress; empty if there is none."""
        return " ".join(filter(None, (self._doing, self._shared.saving_text())))

    def is_open(self, entry: Entry) -> bool:
        """Whether this is the open task."""
        return self._shared.home is not None and self._open_reference == entry.lasting

    def close(self) -> None:
        """Withdraw a question and end the thread; waits for a session that is being closed."""
        self._closing = True
        if self._opening is not None:
            result_of(asyncio.wait([self._opening]))
        self._aside.close()
        self.catalogue.close()

    async def _open_wishes(self) -> None:
        while (entry := self._wish) is not None and not self._closing:
            self._wish = None
            try:
                await self._open(entry)
            except Exception as error:
                report_failure(f"{entry.name} was not opened", error)
            finally:
                self._doing = ""

    def _withdrawn(self) -> bool:
        return self._closing or self._wish is not None

    async def _open(self, entry: Entry) -> None:
        if entry.section is Section.RECORDINGS:
            self._shared.pages.show("review")
            return
        file = entry.file
        if file is not None and not await self._aside.run(file.is_file):
            self._notify(f"{entry.name} is gone", f"There is no file {entry.file} any more.")
            self.catalogue.refresh()
            return
        home = self._shared.home
        if home is not None and self.is_open(entry):
            self._go_live.let_go()
            self._shared.session = home
            self._shared.pages.show("live")
            return
        self._doing = f"Opening {entry.name}: asking whether its code may run"
        try:
            reference = await self._aside.run(lambda: self._cleared(entry))
        except NotCleared as error:
            if not self._withdrawn():
                self._notify(f"{entry.name} was not opened", sentence(str(error)))
            return
        self._doing = f"Opening {entry.name} …"
        if not self._withdrawn():
            await self._change(reference, entry)

    def _cleared(self, entry: Entry) -> TaskName:
        """The task to open. Asks the user whether its file may run, and waits for the answer. Does not ask
        for a registered id, an example, a file below the folder in which the workbench was started, or a task
        that was open in this run.

        Raises:
            NotCleared: the task must not run.
        """
        file = entry.file
        known = entry.lasting in self._ran or file in example_tasks()
        if file is None or known or is_below(file, self.catalogue.folder):
            return entry.reference
        return self._clearances.clear_file(file, file_and_class(entry.reference)[1], self._withdrawn)

    async def _change(self, reference: TaskName, entry: Entry) -> None:
        shared, old = self._shared, self._shared.home
        self._go_live.let_go()
        if old is not None:
            old.do(PauseRun())
            self._kept[self._open_reference] = old.kept_work()
            # Not a `RecordedTask`: the user allowed only the recorded texts; the file may have changed since.
            if isinstance(old.reference, str):
                self._ran.add(self._open_reference)
        kept = self._kept.get(entry.lasting)
        options = entry.options or self.catalogue.options
        session = await self._aside.run(lambda: self._open_session(reference, options, kept))
        shared.session = shared.home = session
        self._open_reference = entry.lasting
        # Until the new page is shown, the old page draws the old session.
        shown = asyncio.wrap_future(shared.pages.show("live", rebuild=True))
        await asyncio.wait([shown], timeout=_SHOW_TIMEOUT_SECONDS)
        if old is not None:
            self._doing = "Closing the previous task: writing its recordings …"
            await self._aside.run(lambda: shared.close_session(old))

    def _notify(self, title: str, text: str) -> None:
        notify_all(self._shared.server, title, text, "red")
