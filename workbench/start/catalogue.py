"""The list of tasks to choose from; a page can open only listed tasks."""

from __future__ import annotations

import ast
import asyncio
import math
import os
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from enum import Enum
from functools import cache
from pathlib import Path

from workbench.live.commands import MAX_NUM_ENVS
from workbench.machine.folders import example_tasks
from workbench.machine.loop import BlockingPool, begin, do, on_loop
from workbench.machine.parse_python import parse_python
from workbench.machine.processes.watched_thread import report_failure
from workbench.machine.text import short_line
from workbench.start.recents import RecentTask, RecentTasks
from workbench.start.registered import RegisteredTasks, RegisteredView
from workbench.start.typed_path import typed_path
from workbench.task.description import TaskOptions
from workbench.task.find import FoundTasks, TaskFile, TaskFileReader, find_task_files, read_task_file
from workbench.task.reference import lasting

MAX_TEXT_CHARACTERS = 300
SEARCH_SECONDS = 1.0
"""Pause between two searches of the folder."""
SEARCH_SHARE = 0.05
"""Maximum share of the time that searches may take: a slow folder is searched less often."""
SHOWN_SECONDS = 2.0
"""Time after a call of `Catalogue.view` for which the list counts as shown; a page calls it several times a second."""


class Section(Enum):
    """Part of the list, in the order of the page; the value is its heading."""

    TYPED = "Path"
    RECENT = "Recent"
    FOLDER = "In this folder"
    EXAMPLES = "Examples"
    RECORDINGS = "Recordings"
    REGISTERED = "ManiSkill's tasks"


@dataclass(frozen=True)
class Entry:
    """A row of the list. Its texts contain no control characters, but are not escaped for HTML."""

    number: int
    """Number that a page sends to choose the row; never reused while the program runs. 0 if not assigned yet."""
    section: Section
    name: str
    about: str
    reference: str
    """Reference of the task to open; empty for the recordings."""
    file: Path | None = None
    """File of the task; None for a registered id and for the recordings."""
    gone: bool = False
    """Whether the file no longer exists."""
    options: TaskOptions | None = None
    """Options with which the task was last opened; None for the options of this run."""
    env_id: str = ""
    """Id of the task whose picture the row shows; empty for none."""
    blank: str = ""
    """Text in place of the picture."""
    lasting: str = ""
    """The reference as `task.reference.lasting` returns it: equal for all rows of a task."""

    def matches(self, words: list[str]) -> bool:
        """Whether each of these lower-case words occurs in the name or begins a word of the other texts."""
        name, others = self.name.lower(), f" {self.about} {self.section.value}".lower()
        return all(word in name or f" {word}" in others for word in words)


@dataclass(frozen=True)
class CatalogueView:
    """The list at one moment."""

    entries: tuple[Entry, ...] = ()
    """Rows in the order of the sections."""
    folder: str = ""
    searching: bool = False
    """Whether the folder is being searched for the first time."""
    left_out: str = ""
    """Why the search may have missed files."""
    registered: RegisteredView = RegisteredView()


class Catalogue:
    """Lists recent tasks, task files of a folder, examples, recordings and registered ids.

    The list is one value, which is replaced on the loop. It follows the disk while it is shown. A page
    chooses a row by its number: `entry` returns only rows that are listed, or were found by a typed path.

    Args:
        folder: folder to search for task files.
        recordings: folder of recordings.
        recents: recently opened tasks.
        registered: ManiSkill's tasks.
        options: options of rows without options of their own.
    """

    def __init__(
        self,
        folder: Path,
        recordings: Path,
        recents: RecentTasks,
        registered: RegisteredTasks,
        options: TaskOptions,
    ) -> None:
        self.folder = Path(os.path.realpath(folder))
        self.recents, self.registered, self.options = recents, registered, options
        self._recordings = recordings
        self._aside = BlockingPool("find-tasks")
        self._following: asyncio.Task[None] | None = None
        self._files = TaskFileReader()
        self._numbers: dict[tuple[Section, str], int] = {}
        self._typed: dict[int, Entry] = {}
        self._shown_at = -math.inf
        self._on_disk = CatalogueView(folder=_shown(str(self.folder)), searching=True)
        """The list without the registered tasks."""
        self._view = self._on_disk
        registered.on_change = self._list

    @on_loop
    def refresh(self) -> None:
        """Search the folder and read the recent tasks now, and repeat that while the list is shown."""
        self.registered.start()
        if self._following is not None:
            self._following.cancel()  # a running search may already have passed changed files
        self._following = begin(self._follow())

    def view(self) -> CatalogueView:
        """The present list. Pages poll it while the list is shown."""
        self._shown_at = time.monotonic()
        return self._view

    def entry(self, number: int) -> Entry | None:
        """The listed or typed row with this number; None if there is none."""
        listed = next((entry for entry in self._view.entries if entry.number == number), None)
        return self._typed.get(number) if listed is None else listed

    async def typed(self, text: str) -> Entry | None:
        """The row of the task file with the typed path; None for a text that is not a path.

        Raises:
            NotAPath: the file cannot be opened.
        """
        aside = BlockingPool("typed-path")  # one per text: a disk that hangs must not block the next text
        try:
            found = await aside.run(lambda: self._find_typed(text))
        finally:
            aside.end()
        if found is None:
            return None
        entry = self._numbered(found)
        self._typed[entry.number] = entry
        return entry

    @on_loop
    def add_file(self, file: Path, env_id: str) -> Entry:
        """Add a task file that was just written into the folder; returns its row."""
        entry = self._numbered(self._of_folder(TaskFile(file, (env_id,), ())))
        rows = self._on_disk.entries
        if all(row.number != entry.number for row in rows):
            self._on_disk = replace(self._on_disk, entries=(entry, *rows))
            self._list()
        return entry

    def close(self) -> None:
        """End the search and the process that draws pictures. Must not be called on the loop."""
        do(self._end)
        self.registered.close()

    def _end(self) -> None:
        self._aside.end()  # also cancels searches that begin later
        if self._following is not None:
            self._following.cancel()

    async def _follow(self) -> None:
        while True:
            began = time.monotonic()
            try:
                found = await self._aside.run(self._search)
                self._on_disk = replace(found, entries=tuple(map(self._numbered, found.entries)))
            except Exception as error:
                report_failure("The folder could not be searched for tasks", error)
                self._on_disk = replace(self._on_disk, searching=False)
            self._list()
            took = time.monotonic() - began
            await asyncio.sleep(max(SEARCH_SECONDS, took / SEARCH_SHARE))
            while time.monotonic() - self._shown_at > SHOWN_SECONDS:
                await asyncio.sleep(SEARCH_SECONDS)

    def _list(self) -> None:
        """Update the list from the present data."""
        registered = self.registered.view
        entries = (*self._on_disk.entries, *self._of_maniskill(registered))
        view = replace(self._on_disk, entries=entries, registered=registered)
        if view != self._view:
            self._view = view

    # --- off the loop --------------------------------------------------------------------------------

    def _search(self) -> CatalogueView:
        """The list without the rows' numbers and without registered tasks."""
        found = find_task_files(self.folder, self._files.read)
        return CatalogueView(tuple(self._entries(found)), self._on_disk.folder, left_out=found.left_out)

    def _find_typed(self, text: str) -> Entry | None:
        named = typed_path(text, self.folder)
        if named is None:
            return None
        file, class_name = named
        reference = f"{file}:{class_name}" if class_name else str(file)
        about = _about(read_task_file(file) or TaskFile(file, (), ()))
        return _entry(Section.TYPED, reference, reference, about, file=file)

    # --- entries -------------------------------------------------------------------------------------

    def _numbered(self, entry: Entry) -> Entry:
        number = self._numbers.setdefault((entry.section, entry.reference), len(self._numbers) + 1)
        return replace(entry, number=number)

    def _entries(self, found: FoundTasks) -> Iterator[Entry]:
        yield from map(self._recent, self.recents.list())
        yield from map(self._of_folder, found.files)
        for task in example_tasks():
            yield _entry(Section.EXAMPLES, str(task), task.name, _first_line(task), file=task)
        yield _entry(
            Section.RECORDINGS,
            "",
            f"{self._recordings.name or self._recordings}/",
            "Look through recorded episodes: play, compare, share"
            if self._recordings.is_dir()
            else "No recordings here yet. workbench review FOLDER opens another folder.",
        )

    def _of_maniskill(self, registered: RegisteredView) -> Iterator[Entry]:
        why_not = registered.why_not
        # Tasks without a picture, some of which need a download, come last.
        for env_id in sorted(registered.ids, key=why_not.__contains__):
            why = why_not.get(env_id)
            entry = _entry(Section.REGISTERED, env_id, env_id, "" if why is None else why.text, env_id=env_id)
            blank = (
                "" if why is None else "needs a download" if why.needs_download else "cannot be drawn here"
            )
            yield self._numbered(replace(entry, blank=blank))

    def _recent(self, task: RecentTask) -> Entry:
        file = task.file
        num_envs = min(task.num_envs, MAX_NUM_ENVS)
        options = replace(self.options, num_envs=num_envs, env_kwargs=dict(task.env_kwargs))
        kwargs = "".join(f", {name}={value}" for name, value in task.env_kwargs.items())
        how = f"{num_envs} {'env' if num_envs == 1 else 'envs'}{kwargs}"
        if file is None:
            return _entry(
                Section.RECENT, task.reference, task.reference, how, options=options, env_id=task.reference
            )
        name = task.reference.rpartition("/")[2]
        about = f"{self._place(file)} · {how}"
        return _entry(
            Section.RECENT, task.reference, name, about, file=file, gone=not file.is_file(), options=options
        )

    def _of_folder(self, task: TaskFile) -> Entry:
        name = str(task.path.relative_to(self.folder))
        return _entry(Section.FOLDER, str(task.path), name, _about(task), file=task.path)

    def _place(self, file: Path) -> str:
        """Short text for the folder of a file."""
        folder = file.parent
        if folder.is_relative_to(self.folder):
            inside = folder.relative_to(self.folder)
            return "this folder" if inside == Path() else f"{inside}/"
        home = Path.home()
        return f"~/{folder.relative_to(home)}" if folder.is_relative_to(home) else str(folder)


def _entry(
    section: Section,
    reference: str,
    name: str,
    about: str,
    file: Path | None = None,
    gone: bool = False,
    options: TaskOptions | None = None,
    env_id: str = "",
) -> Entry:
    known = (reference, file, gone, options, env_id)
    return Entry(0, section, _shown(name), _shown(about), *known, lasting=lasting(reference))


def _about(task: TaskFile) -> str:
    if task.not_python:
        return "not Python yet" if task.line is None else f"not Python yet: line {task.line}"
    names = task.ids or task.classes
    return ", ".join((*names[:3], *(("…",) if len(names) > 3 else ())))


def _shown(text: str) -> str:
    return short_line(os.fsencode(text).decode(errors="replace"), MAX_TEXT_CHARACTERS)


@cache
def _first_line(file: Path) -> str:
    """The first line of the docstring of an example."""
    try:
        return (ast.get_docstring(parse_python(file.read_bytes())) or "").partition("\n")[0].replace("`", "")
    except (OSError, SyntaxError, ValueError):
        return ""
