"""The list of tasks, on the start page and in the *Open...* dialog."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import viser

from workbench.machine.loop import begin
from workbench.page.command import Command, Refused
from workbench.page.widgets.dialog import Dialog
from workbench.page.widgets.fields import Field, choice
from workbench.page.widgets.keys_and_palette import with_key
from workbench.page.widgets.parts import PagePart
from workbench.page.widgets.templates import render, sentence
from workbench.page.widgets.tools import tool, tools_html
from workbench.page.widgets.visitors import Done, Visitor
from workbench.start.catalogue import Catalogue, CatalogueView, Entry, Section
from workbench.start.commands import (
    MAX_NAME_CHARACTERS,
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
from workbench.start.typed_path import NotAPath
from workbench.task.new_task import TEMPLATES

PICTURES = "/task_pictures/"
"""Prefix of the route for pictures of registered tasks."""
MAX_SEARCH_CHARACTERS = 4096
"""Maximum length of the search text; a path may be that long."""
MAX_RECENT = 6
"""Maximum number of recent tasks that are shown without a search."""
OPEN = "Open a task…"
HINT = with_key(OpenTaskList, "Open a task")
NEW_TASK, CREATE = "New task", "Create"


class Chooser(Protocol):
    """Opens tasks that the user chooses."""

    @property
    def catalogue(self) -> Catalogue: ...

    def choose(self, number: int) -> None:
        """Open this row of the list; returns at once. Raises `Refused` for a number that is not listed."""
        ...

    async def create(self, name: str, template: TemplateName) -> None:
        """Write a new task into the folder of the list, and open it.

        Raises:
            ValueError: nothing was written; the message contains the reason.
        """
        ...

    def doing(self) -> str:
        """Text for the page: the work in progress; empty if there is none."""
        ...

    def is_open(self, entry: Entry) -> bool:
        """Whether this is the open task."""
        ...


@dataclass(frozen=True)
class Search:
    """A search and its interpretation."""

    words: str = ""
    typed: Entry | None = None
    """The row of the file whose path the words are; None for other words."""
    why_not: str = ""
    """Why the path in the words cannot be opened."""


class TaskList:
    """A search field and the list, in the present container. Call `Catalogue.refresh` first.

    Enter in the field opens the best match; the arrow keys move from the field to the rows.
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
        on_chosen: Callable[[], object] = lambda: None,
    ) -> None:
        """
        Args:
            on_chosen: called after a row was chosen.
        """
        self._chooser, self._on_chosen = chooser, on_chosen
        self._search = Search()
        self._name = ""
        self._template: TemplateName = TEMPLATES[0].name
        self._drawn: object = None
        self._find = Field(
            server,
            "Search",
            LookForTasks,
            "words",
            hint="Words, all of which must be in the name or the folder; or the path of a file",
            live=True,
            enter=OpenFoundTask(),
            longest=MAX_SEARCH_CHARACTERS,
        )
        with server.gui.add_folder(NEW_TASK, expand_by_default=False):
            self._name_field = Field(
                server,
                "Name",
                NameTask,
                "name",
                hint="Such as stack_two, which is written to stack_two.py",
                longest=MAX_NAME_CHARACTERS,
            )
            about = {f"{template.name}: {template.about}": template.name for template in TEMPLATES}
            self._template_choice = choice(
                server, "Template", ChooseTemplate, "template", about, self._template
            )
            server.gui.add_html(tools_html([tool(CREATE, CreateTask())]))
        self._html = server.gui.add_html("")

    def draw(self) -> None:
        """Draw the list if it has changed."""
        search, view, doing = self._search, self._chooser.catalogue.view(), self._chooser.doing()
        self._find.show(search.words)
        self._name_field.show(self._name)
        self._template_choice.show(self._template)
        wanted = view, search, doing
        if wanted == self._drawn:
            return
        self._drawn = wanted
        self._html.content = tasks_html(view, search, doing, self._chooser.is_open, self._find.name)

    def do(self, command: Command, visitor: Visitor) -> Done:
        match command:
            case OpenListedTask(number=number):
                if self._chooser.catalogue.entry(number) is None:
                    raise Refused("This task is no longer in the list.")
                self._choose(number)
            case OpenFoundTask():
                return self._open_found(self._search.words)
            case LookForTasks(words=words):
                self._look_for(words[:MAX_SEARCH_CHARACTERS])
            case ClearTaskSearch():
                self._look_for("")
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

    def _look_for(self, words: str) -> None:
        self._search = Search(words)
        begin(self._look_up(words))

    async def _look_up(self, words: str) -> None:
        found = await self._read(words)
        if self._search.words == words:
            self._search = found

    async def _read(self, words: str) -> Search:
        """Check whether the words are the path of a task file."""
        try:
            return Search(words, typed=await self._chooser.catalogue.typed(words))
        except NotAPath as error:
            return Search(words, why_not=sentence(str(error)))

    async def _open_found(self, words: str) -> None:
        search = await self._read(words)
        found = shown_rows(self._chooser.catalogue.view(), search)
        best = best_row([row for rows in found.values() for row in rows], self._chooser.is_open)
        if best is None:
            raise Refused("No task in the list contains these words.")
        self._choose(best.number)

    def _choose(self, number: int) -> None:
        self._chooser.choose(number)
        self._on_chosen()


def shown_rows(view: CatalogueView, search: Search) -> dict[Section, list[Entry]]:
    """The rows of each section, in the order of the list."""
    wanted, typed = search.words.lower().split(), search.typed
    found = [entry for entry in view.entries if entry.matches(wanted)]
    if typed is not None and all(entry.reference != typed.reference for entry in found):
        found.insert(0, typed)
    rows = {section: [entry for entry in found if entry.section is section] for section in Section}
    if not wanted:
        rows[Section.RECENT] = rows[Section.RECENT][:MAX_RECENT]
    return rows


def best_row(rows: Sequence[Entry], is_open: Callable[[Entry], bool]) -> Entry | None:
    """Row that Enter opens: the first whose file exists and that is not open yet; else the first whose file
    exists; else the first; None without rows."""
    return min(rows, key=lambda row: (row.gone, is_open(row)), default=None)


def tasks_html(
    view: CatalogueView,
    search: Search,
    doing: str,
    is_open: Callable[[Entry], bool] = lambda entry: False,
    field: str = "",
) -> str:
    """HTML of the list.

    Args:
        doing: text about the work in progress, or empty.
        is_open: returns whether a row is the open task. That row is marked, and Enter opens it only if there
            is no better row (see `best_row`).
        field: name of the search field.
    """
    found, searched = shown_rows(view, search), bool(search.words.split())
    every = [row for rows in found.values() for row in rows]
    notes = {section: _note(section, view, bool(rows), searched) for section, rows in found.items()}
    sections = [
        {"of": section, "rows": rows, "note": notes[section]}
        for section, rows in found.items()
        if rows or notes[section]
    ]
    return render(
        "tasks",
        view=view,
        words=search.words,
        doing=doing,
        open_task=lambda number: OpenListedTask(number=number),
        clear=ClearTaskSearch(),
        found=len(every),
        best=best_row(every, is_open),
        search=field,
        why_not=search.why_not,
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


def picture_route(catalogue: Catalogue) -> Callable[[str, Mapping[str, str]], tuple[int, str, bytes]]:
    """Route handler for the picture of a listed id: the name is looked up and never used as a path."""

    def reply(name: str, query: Mapping[str, str]) -> tuple[int, str, bytes]:
        picture = catalogue.registered.picture(name.removesuffix(".jpg"))
        return (404, "text/plain", b"") if picture is None else (200, "image/jpeg", picture)

    return reply


class OpenDialog(PagePart[object]):
    """The *Open...* dialog. Like every dialog of viser, it is shown on all open pages."""

    does = (OpenTaskList, *TaskList.does)

    def __init__(
        self,
        server: viser.ViserServer,
        chooser: Chooser,
    ) -> None:
        self._server, self._chooser = server, chooser
        self._wanted = False
        self._shown: tuple[Dialog, TaskList] | None = None
        """The open dialog; only `draw` opens and closes it and uses its fields."""

    def do(self, command: Command, visitor: Visitor) -> Done:
        match command:
            case OpenTaskList():
                if not self.close():
                    self._chooser.catalogue.refresh()
                    self._wanted = True
            case _:
                shown = self._shown
                if not self._wanted or shown is None:
                    raise Refused("The list of tasks is closed.")
                return shown[1].do(command, visitor)
        return None

    def add_button(self, name: str = "") -> None:
        """Add the button that opens the dialog, with the name of the open task, to the present container."""
        self._server.gui.add_html(render("open_task", name=name or OPEN, command=OpenTaskList(), hint=HINT))

    def close(self) -> bool:
        """Close the dialog; returns False if it is already closed."""
        was, self._wanted = self._wanted, False
        return was

    def draw(self, view: object) -> None:
        if not self._wanted:
            if self._shown is not None:
                self._shown[0].close()
                self._shown = None
            return
        if self._shown is None:
            dialog = Dialog(self._server, "Open a task")
            with dialog.modal:
                self._shown = dialog, TaskList(self._server, self._chooser, self.close)
        self._shown[1].draw()
