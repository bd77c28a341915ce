"""The list of tasks to choose from, on the start page and in the *Open...* dialog."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from typing import Protocol

import viser

from workbench.authoring.templates.new_task import TEMPLATES
from workbench.commands.command import Command, Refused
from workbench.commands.tasks import (
    LONGEST_NAME,
    ChooseTemplate,
    ClearTaskSearch,
    CreateTask,
    LookForTasks,
    NameTask,
    OpenFoundTask,
    OpenListedTask,
    OpenTaskList,
    TemplateName,
)
from workbench.session.tasks.catalogue import Catalogue, CatalogueView, Entry, Section
from workbench.session.tasks.typed import NotAPath
from workbench.ui.library.dialogs import Dialog
from workbench.ui.widgets.fields import Field, choice
from workbench.ui.widgets.parts import PagePart
from workbench.ui.widgets.templates import render, sentence
from workbench.ui.widgets.tools import tool, tools_html
from workbench.ui.widgets.visitors import Done, Visitor

PICTURES = "/task_pictures/"
"""Prefix of the route of the pictures of registered tasks."""
LONGEST_WORDS = 4096
"""Maximum number of characters of the search; a path may be as long."""
MOST_RECENT = 6
"""Maximum number of recent tasks that are shown while nothing is searched."""
OPEN = "Open…"
NEW_TASK, CREATE = "New task", "Create"


class Chooser(Protocol):
    """Opens what a person chooses."""

    @property
    def catalogue(self) -> Catalogue: ...

    def choose(self, number: int) -> None:
        """Open this row of the list; returns at once. A number that is not listed is refused."""
        ...

    async def create(self, name: str, template: TemplateName) -> None:
        """Write a new task into the folder of the list, and open it.

        Raises:
            ValueError: nothing was written; the message says why.
        """
        ...

    def doing(self) -> str:
        """Text for the page: what is being done; empty if nothing."""
        ...

    def is_open(self, entry: Entry) -> bool:
        """Whether this is the open task."""
        ...


class TaskList:
    """A search field and the list, in the present container.

    Enter in the field opens the best match; the arrows lead from the field to the rows.
    """

    does = (
        OpenListedTask,
        OpenFoundTask,
        LookForTasks,
        ClearTaskSearch,
        NameTask,
        ChooseTemplate,
        CreateTask,
    )

    def __init__(
        self,
        server: viser.ViserServer,
        chooser: Chooser,
        on_chosen: Callable[[], None] = lambda: None,
    ) -> None:
        """
        Args:
            on_chosen: called after a row was chosen.
        """
        self._chooser, self._on_chosen = chooser, on_chosen
        self._words = self._name = ""
        self._template: TemplateName = TEMPLATES[0].name
        self._drawn: object = None
        self._find = Field(
            server,
            "Search",
            LookForTasks,
            "words",
            hint="Words in the name or the folder, all of which must be found; or the path of a file",
            live=True,
            enter=OpenFoundTask(),
            longest=LONGEST_WORDS,
        )
        with server.gui.add_folder(NEW_TASK, expand_by_default=False):
            self._name_field = Field(
                server,
                "Name",
                NameTask,
                "name",
                hint="Such as stack_two, which is written to stack_two.py",
                longest=LONGEST_NAME,
            )
            about = {f"{template.name}: {template.about}": template.name for template in TEMPLATES}
            self._template_choice = choice(
                server, "Template", ChooseTemplate, "template", about, self._template
            )
            server.gui.add_html(tools_html([tool(CREATE, CreateTask())]))
        self._html = server.gui.add_html("")
        chooser.catalogue.refresh()

    def draw(self) -> None:
        """Draw it if something has changed."""
        self._find.show(self._words)
        self._name_field.show(self._name)
        self._template_choice.show(self._template)
        catalogue = self._chooser.catalogue
        catalogue.follow()
        view, doing = catalogue.view(), self._chooser.doing()
        typed, why_not = self._typed()
        wanted = view.serial, self._words, doing, typed, why_not
        if wanted == self._drawn:
            return
        self._drawn = wanted
        self._html.content = tasks_html(
            view, self._words, doing, self._chooser.is_open, typed, why_not, self._find.name
        )

    def _typed(self) -> tuple[Entry | None, str]:
        """The file whose path the words are; or why it cannot be opened."""
        try:
            return self._chooser.catalogue.typed(self._words), ""
        except NotAPath as error:
            return None, sentence(str(error))

    def do(self, command: Command, visitor: Visitor) -> Done:
        match command:
            case OpenListedTask(number=number):
                if self._chooser.catalogue.entry(number) is None:
                    raise Refused("It is no longer in the list.")
                self._choose(number)
            case OpenFoundTask():
                found = shown_rows(self._chooser.catalogue.view(), self._words, self._typed()[0])
                best = best_row([row for rows in found.values() for row in rows], self._chooser.is_open)
                if best is None:
                    raise Refused("Nothing in the list has these words.")
                self._choose(best.number)
            case LookForTasks(words=words):
                self._words = words[:LONGEST_WORDS]
            case ClearTaskSearch():
                self._words = ""
            case NameTask(name=name):
                if not name.isprintable():
                    raise Refused("The name has characters that cannot be shown.")
                self._name = name
            case ChooseTemplate(template=template):
                self._template = template
            case CreateTask():
                return self._create(self._name.strip(), self._template)
        return None

    async def _create(self, name: str, template: TemplateName) -> None:
        try:
            await self._chooser.create(name, template)
        except ValueError as why:
            raise Refused(str(why)) from None
        self._on_chosen()

    def _choose(self, number: int) -> None:
        self._chooser.choose(number)
        self._on_chosen()


def shown_rows(view: CatalogueView, words: str, typed: Entry | None) -> dict[Section, list[Entry]]:
    """The rows of each section, in the order of the list.

    Args:
        words: searched for.
        typed: the file whose path the words are.
    """
    wanted = words.lower().split()
    found = [entry for entry in view.entries if entry.matches(wanted)]
    if typed is not None and all(entry.reference != typed.reference for entry in found):
        found.insert(0, typed)
    rows = {section: [entry for entry in found if entry.section is section] for section in Section}
    if not wanted:
        rows[Section.RECENT] = rows[Section.RECENT][:MOST_RECENT]
    return rows


def best_row(rows: Sequence[Entry], is_open: Callable[[Entry], bool]) -> Entry | None:
    """Row that Enter opens: the first that can be opened and is not open; else one that is open; else the first."""
    return min(rows, key=lambda row: (row.gone, is_open(row)), default=None)


def tasks_html(
    view: CatalogueView,
    words: str,
    doing: str,
    is_open: Callable[[Entry], bool] = lambda entry: False,
    typed: Entry | None = None,
    why_not: str = "",
    search: str = "",
) -> str:
    """The list.

    Args:
        words: searched for.
        doing: what is being opened, if anything.
        is_open: whether a row is the open task, which is marked and which Enter does not choose.
        typed: the file whose path the words are.
        why_not: why the path in the words cannot be opened.
        search: name of the field of the search.
    """
    found = shown_rows(view, words, typed)
    every = [row for rows in found.values() for row in rows]
    notes = {
        section: _note(section, view, bool(rows), bool(words.split())) for section, rows in found.items()
    }
    sections = [
        {"of": section, "rows": rows, "note": notes[section]}
        for section, rows in found.items()
        if rows or notes[section]
    ]
    return render(
        "tasks",
        view=view,
        words=words,
        doing=doing,
        open_task=lambda number: OpenListedTask(number=number),
        clear=ClearTaskSearch(),
        found=len(every),
        best=best_row(every, is_open),
        search=search,
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
    """Text below the heading of a section."""
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

    does = (OpenTaskList, *TaskList.does)

    def __init__(
        self,
        server: viser.ViserServer,
        chooser: Chooser,
    ) -> None:
        self._server, self._chooser = server, chooser
        self._lock = threading.RLock()
        self._shown: tuple[Dialog, TaskList] | None = None

    def do(self, command: Command, visitor: Visitor) -> Done:
        match command:
            case OpenTaskList():
                self.open()
            case _:
                with self._lock:
                    if self._shown is None:
                        raise Refused("The list of tasks is closed.")
                    return self._shown[1].do(command, visitor)
        return None

    def add_button(self) -> None:
        """Add the button that opens it to the present container."""
        self._server.gui.add_html(tools_html([tool(OPEN, OpenTaskList())]))

    def open(self) -> None:
        """Open it; close it if it is open."""
        with self._lock:
            if self._shown is not None and not self._shown[0].modal.closed:
                self.close()
                return
            with self._server.atomic():
                dialog = Dialog(self._server, "Open a task")
                with dialog.modal:
                    listed = TaskList(self._server, self._chooser, self._close_chosen)
                self._shown = dialog, listed

    def _close_chosen(self) -> None:
        self.close()

    def close(self) -> bool:
        """False if it is closed."""
        with self._lock:
            shown, self._shown = self._shown, None
            return shown is not None and shown[0].close()

    def draw(self, view: object) -> None:
        with self._lock:
            if self._shown is not None:
                if self._shown[0].modal.closed:
                    self._shown = None
                else:
                    self._shown[1].draw()
