"""Opens a listed task in place of the open one: asks for consent, changes the session, and keeps what was done in the old."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from workbench.authoring.loading.find_tasks import is_below
from workbench.authoring.loading.reference import TaskName, file_and_class
from workbench.authoring.templates.new_task import write_new_task
from workbench.commands.run import PauseRun
from workbench.commands.tasks import TemplateName
from workbench.jobs.task import TaskOptions
from workbench.machine.folders import example_tasks
from workbench.machine.processes.watched_thread import watched_thread
from workbench.session.clearance import Clearances, NotCleared
from workbench.session.live.session import KeptWork, Session
from workbench.session.tasks.catalogue import Catalogue, Entry, Section
from workbench.session.tasks.recents import RecentTasks, lasting
from workbench.ui.widgets.notices import tell_all
from workbench.ui.widgets.templates import sentence

if TYPE_CHECKING:
    from workbench.ui.app.workplace import Workplace

OpenSession = Callable[[TaskName, TaskOptions, KeptWork | None], Session]
"""Opens a task, with what was kept of an earlier session of it."""


@dataclass(frozen=True)
class Choices:
    """Content of the list of tasks in addition to the tasks that are found, and how a chosen task is opened."""

    recents: RecentTasks
    open_session: OpenSession
    options: TaskOptions
    """Options of tasks without options of their own."""


_SHOWN_WITHIN = 10.0
"""Seconds that the old session waits for the page of the new one."""


class OpenTask:
    """Opens what a person chooses from the list.

    One thread does it, since a question may wait for minutes and a session that ends writes its recordings. Of several
    wishes the last counts: a question for an earlier one is withdrawn. The page of the new session is shown first, then
    the old session is closed as at the end of the program.

    Args:
        place: The pages and the open session.
        open_session: Opens a task.
        catalogue: What may be chosen.
        clearances: Decide whether a file may run.
    """

    def __init__(
        self, place: Workplace, open_session: OpenSession, catalogue: Catalogue, clearances: Clearances
    ) -> None:
        self._place, self._open_session = place, open_session
        self.catalogue, self._clearances = catalogue, clearances
        self._wake = threading.Condition()
        self._wish: Entry | None = None
        self._doing = ""
        self._closing = False
        self._ran: set[str] = set()
        """References of tasks that were open in this run; opening one again asks for no consent."""
        self._kept: dict[str, KeptWork] = {}
        """Work kept of sessions of this run, by `lasting` reference."""
        self._thread = watched_thread("open-task", self._serve)
        self._thread.start()

    def choose(self, number: int) -> None:
        """Open the row of this number; returns at once. What is not listed is refused."""
        entry = self.catalogue.entry(number)
        if entry is not None:
            self._want(entry)

    def _want(self, entry: Entry) -> None:
        with self._wake:
            self._wish = entry
            self._wake.notify_all()

    def create(self, name: str, template: TemplateName) -> None:
        """Write a new task into the folder of the list, and open it; see `Chooser.create`."""
        made = write_new_task(name, template, self.catalogue.folder)
        # Not by its number: a search that began before it was written may end now, and list it not.
        self._want(self.catalogue.add_file(made.file, made.env_id))

    def doing(self) -> str:
        """Text for the page: what is being done; empty if nothing."""
        return self._doing

    def is_open(self, entry: Entry) -> bool:
        """Whether this is the open task."""
        home = self._place.home
        return home is not None and lasting(str(home.reference)) == lasting(entry.reference)

    def close(self) -> None:
        """Withdraw a question and end the thread; a session that is being closed is waited for."""
        with self._wake:
            self._closing = True
            self._wake.notify_all()
        self._thread.join()
        self.catalogue.close()

    def _serve(self) -> None:
        while True:
            with self._wake:
                self._wake.wait_for(lambda: self._wish is not None or self._closing)
                if self._closing:
                    return
                entry, self._wish = self._wish, None
            try:
                if entry is not None:
                    self._open(entry)
            finally:
                self._doing = ""

    def _withdrawn(self) -> bool:
        return self._closing or self._wish is not None

    def _open(self, entry: Entry) -> None:
        if entry.section is Section.RECORDINGS:
            self._place.pages.show("review")
            return
        if entry.file is not None and not entry.file.is_file():
            self._say(f"{entry.name} is gone", f"There is no file {entry.file} any more.")
            self.catalogue.refresh()
            return
        home = self._place.home
        if home is not None and self.is_open(entry):
            self._place.go_live.let_go()
            self._place.session = home
            self._place.pages.show("live")
            return
        self._doing = f"Opening {entry.name}: asking whether its code may run"
        try:
            reference = self._cleared(entry)
        except NotCleared as error:
            if not self._withdrawn():
                self._say(f"{entry.name} is not opened", sentence(str(error)))
            return
        self._doing = f"Opening {entry.name} …"
        if not self._withdrawn():
            self._change(reference, entry)

    def _cleared(self, entry: Entry) -> TaskName:
        """What to open. A file is opened unasked where the workbench was started, if it is one of the examples, and if it
        was open before in this run.

        Raises:
            NotCleared: it may not run.
        """
        file = entry.file
        known = lasting(entry.reference) in self._ran or file in example_tasks()
        if file is None or known or is_below(file, self.catalogue.folder):
            return entry.reference
        return self._clearances.clear_file(file, file_and_class(entry.reference)[1], self._withdrawn)

    def _change(self, reference: TaskName, entry: Entry) -> None:
        place, old = self._place, self._place.home
        place.go_live.let_go()
        if old is not None:
            old.do(PauseRun())
            self._kept[lasting(str(old.reference))] = old.kept_work()
            if isinstance(
                old.reference, str
            ):  # not the texts of a recording, which name a path and are other code
                self._ran.add(lasting(old.reference))
        kept = self._kept.get(lasting(entry.reference))
        place.session = place.home = self._open_session(
            reference, entry.options or self.catalogue.options, kept
        )
        place.pages.show("live", anew=True)
        # Until then the old page draws the old session.
        place.pages.wait_until_shown(_SHOWN_WITHIN)
        if old is not None:
            self._doing = "Closing the task before: its recordings are written …"
            old.close()

    def _say(self, title: str, text: str) -> None:
        tell_all(self._place.server, title, text, "red")
