"""The list of tasks to choose from, on the start page and in the *Open...* dialog."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Protocol

import viser

from workbench.authoring.templates.new_task import TEMPLATES
from workbench.session.tasks.catalogue import Catalogue, CatalogueView, Entry, Section
from workbench.session.tasks.typed import NotAPath
from workbench.ui.library.dialogs import Dialog
from workbench.ui.server.control_values import limit_text
from workbench.ui.widgets.click_targets import Presses
from workbench.ui.widgets.inputs import Control, refusals_told
from workbench.ui.widgets.parts import Clock, PagePart
from workbench.ui.widgets.templates import render, sentence

PICTURES = "/task_pictures/"
"""Where the server gives the pictures of registered tasks."""
LONGEST_WORDS = 4096
"""Characters of the search; a path may be as long."""
LONGEST_NAME = 200
TYPING = 0.15
"""Seconds without a keystroke after which the search runs."""
MOST_RECENT = 6
"""Recent tasks that are shown while nothing is searched."""
TWICE = 4
"""Bit of ``choosable.html`` for the second press of a double click: the first has chosen already."""
OPEN = "Open…"
NEW_TASK, CREATE = "New task", "Create"


class Chooser(Protocol):
    """Opens what a person chooses."""

    @property
    def catalogue(self) -> Catalogue: ...

    def choose(self, number: int) -> None:
        """Open this row of the list; returns at once. A number that is not listed is refused."""
        ...

    def create(self, name: str, template: int) -> None:
        """Write a new task into the folder of the list, and open it.

        Args:
            template: its place in `TEMPLATES`.

        Raises:
            ValueError: nothing was written; the message says why.
        """
        ...

    def doing(self) -> str:
        """What it is doing, for the page; empty if nothing."""
        ...

    def is_open(self, entry: Entry) -> bool:
        """Whether this is the open task."""
        ...


class TaskList:
    """A search field and the list, in the present container.

    The arrow keys and Enter act in the browser (``task_list.js``), which presses a row as a mouse would; what is sent is
    the row's number.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        chooser: Chooser,
        on_chosen: Callable[[], None] = lambda: None,
        clock: Clock = time.monotonic,
    ) -> None:
        """
        Args:
            on_chosen: called after a row was chosen.
        """
        self._chooser, self._on_chosen = chooser, on_chosen
        self._words = ""
        self._drawn: object = None
        self._find = Control(
            server.gui.add_text(
                "Search",
                "",
                hint="Words in the name or the folder, all of which must be found; or the path of a file",
            ),
            send=self._look_for,
            settle=TYPING,
            clock=clock,
        )
        with server.gui.add_folder(NEW_TASK, expand_by_default=False):
            self._name = server.gui.add_text(
                "Name", "", hint="Such as stack_two, which is written to stack_two.py"
            )
            limit_text(self._name, LONGEST_NAME)
            about = [f"{template.name}: {template.about}" for template in TEMPLATES]
            self._template = server.gui.add_dropdown("Template", about)
            create = server.gui.add_button(CREATE, icon=viser.Icon.FILE_PLUS, color="gray")
            create.on_click(self._on_create)
        self._html = server.gui.add_html("")
        presses = Presses(server)
        self._numbers = presses.number_id("tasks", self._on_row)
        self._clear = presses.id_of("clear", lambda _client: self._clear_search())
        chooser.catalogue.refresh()

    def draw(self) -> None:
        """Draw it if something has changed."""
        self._find.show(self._words)
        catalogue = self._chooser.catalogue
        catalogue.follow()
        view, doing = catalogue.view(), self._chooser.doing()
        typed, why_not = None, ""
        try:
            typed = catalogue.typed(self._words)
        except NotAPath as error:
            why_not = sentence(str(error))
        wanted = view.serial, self._words, doing, typed, why_not
        if wanted == self._drawn:
            return
        self._drawn = wanted
        self._html.content = tasks_html(
            view, self._words, doing, self._numbers, self._clear, self._chooser.is_open, typed, why_not
        )

    def _look_for(self, words: str) -> None:
        self._words = words[:LONGEST_WORDS]

    def _clear_search(self) -> None:
        self._find.handle.value = self._words = ""

    def _on_create(self, event: viser.GuiEvent) -> None:
        with refusals_told(event.client, "Nothing was written"):
            self._chooser.create(self._name.value.strip(), self._template.options.index(self._template.value))
            self._on_chosen()

    def _on_row(self, sent: int) -> None:
        number, held = divmod(sent, 8)
        if held & TWICE or self._chooser.catalogue.entry(number) is None:
            return
        self._chooser.choose(number)
        self._on_chosen()


def tasks_html(
    view: CatalogueView,
    words: str,
    doing: str,
    numbers: str,
    clear: str,
    is_open: Callable[[Entry], bool] = lambda entry: False,
    typed: Entry | None = None,
    why_not: str = "",
) -> str:
    """The list.

    Args:
        words: searched for.
        doing: what is being opened, if anything.
        numbers, clear: ids of the input that takes a row's number, and of the button that clears the search.
        is_open: whether a row is the open task, which is marked and which Enter does not choose.
        typed: the file whose path the words are.
        why_not: why the path in the words cannot be opened.
    """
    wanted = words.lower().split()
    found = [entry for entry in view.entries if entry.matches(wanted)]
    if typed is not None and all(entry.reference != typed.reference for entry in found):
        found.insert(0, typed)
    sections = []
    for section in Section:
        rows = [entry for entry in found if entry.section is section]
        shown = rows[:MOST_RECENT] if section is Section.RECENT and not wanted else rows
        if note := _note(section, view, bool(rows), bool(wanted)):
            sections.append({"of": section, "rows": shown, "note": note})
        elif shown:
            sections.append({"of": section, "rows": shown, "note": ""})
    return render(
        "tasks",
        view=view,
        words=words,
        doing=doing,
        numbers=numbers,
        clear=clear,
        found=len(found),
        why_not=why_not,
        sections=sections,
        pictures=view.registered.pictures,
        registered=Section.REGISTERED,
        picture_of=_picture_of,
        is_open=is_open,
    )


def _picture_of(entry: Entry, pictures: frozenset[str]) -> str:
    return f"{PICTURES}{entry.env_id}.jpg" if entry.env_id in pictures else ""


def _note(section: Section, view: CatalogueView, some: bool, searched: bool) -> str:
    """What to say below the heading of a section."""
    if section is Section.FOLDER:
        if view.searching and not some:
            return f"Looking for task files in {view.folder} …"
        if not some and not searched:
            return f"No task file in {view.folder}. A task is a Python file with a class that inherits BaseEnv. {view.left_out}"
        return "" if searched else view.left_out
    if section is Section.REGISTERED and not searched:
        known = view.registered
        if known.problem:
            return known.problem
        if not known.ids:
            return (
                "Loading ManiSkill's list of tasks. The first time takes a few seconds …"
                if known.doing
                else ""
            )
        if known.doing and known.waiting:
            return f"Drawing pictures: {len(known.pictures)} of {len(known.ids)} so far"
    return ""


def picture_route(catalogue: Catalogue) -> Callable[[str], tuple[int, str, bytes]]:
    """Gives the picture of a listed id: the name is looked up, and is no path."""

    def reply(name: str) -> tuple[int, str, bytes]:
        picture = catalogue.registered.picture(name.removesuffix(".jpg"))
        return (404, "text/plain", b"") if picture is None else (200, "image/jpeg", picture)

    return reply


class OpenDialog(PagePart[object]):
    """The *Open...* dialog over a page. It is on all open pages, as every dialog of viser's is."""

    def __init__(
        self,
        server: viser.ViserServer,
        chooser: Chooser,
        asking: Callable[[bool], None] = lambda asking: None,
        clock: Clock = time.monotonic,
    ) -> None:
        """
        Args:
            asking: called with True when it opens and False when it closes.
        """
        self._server, self._chooser, self._asking, self._clock = server, chooser, asking, clock
        self._lock = threading.RLock()
        self._shown: tuple[Dialog, TaskList, viser.CommandHandle] | None = None

    def add_button(self) -> None:
        """Add the button that opens it to the present container."""
        button = self._server.gui.add_button(
            OPEN, icon=viser.Icon.FOLDER_OPEN, color="gray", hint="Open another task"
        )
        button.on_click(lambda _: self.open())

    def open(self) -> None:
        """Open it; close it if it is open."""
        with self._lock:
            if self._shown is not None and not self._shown[0].modal.closed:
                self.close()
                return
            with self._server.atomic():
                dialog = Dialog(self._server, "Open a task", lambda: self._asking(False))
                with dialog.modal:
                    listed = TaskList(self._server, self._chooser, self.close, self._clock)
                # viser's windows do not hear it themselves.
                escape = self._server.gui.add_command("Close the list of tasks", hotkey="escape")
                escape.on_trigger(lambda _: self.close())
                self._shown = dialog, listed, escape
            self._asking(True)

    def close(self) -> None:
        with self._lock:
            shown, self._shown = self._shown, None
            # False if a page switch has removed both.
            if shown is not None and shown[0].close():
                shown[2].remove()

    def draw(self, view: object) -> None:
        with self._lock:
            if self._shown is not None:
                if self._shown[0].modal.closed:
                    self._shown = None
                else:
                    self._shown[1].draw()
