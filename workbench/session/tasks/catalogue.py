"""The list of tasks that a person may choose from; only what is in it can be opened from a page."""

from __future__ import annotations

import ast
import os
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from enum import Enum
from functools import cache
from pathlib import Path

from workbench.authoring.loading.find_tasks import FoundTasks, TaskFile, TaskFileReader, find_task_files
from workbench.commands.run import MOST_ENVS
from workbench.jobs.task import TaskOptions
from workbench.machine.folders import example_tasks
from workbench.machine.parse_python import parse_python
from workbench.machine.processes.watched_thread import report_failure
from workbench.machine.text import short_line
from workbench.session.tasks.recents import RecentTask, RecentTasks
from workbench.session.tasks.registered import RegisteredTasks, RegisteredView
from workbench.session.tasks.typed import typed_path

LONGEST_SHOWN = 300
SEARCH_SECONDS = 1.0
"""Pause between two searches of the folder."""
SEARCH_SHARE = 0.05
"""Largest share of the time that is spent on searches: a slow folder is searched less often."""


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
    """A row of the list. Its texts are printable, not escaped."""

    number: int
    """Number that a page sends to choose the row; never given to another row while the program runs."""
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
    """The id whose picture the row shows; empty for none."""
    blank: str = ""
    """Text in place of the picture."""

    def matches(self, words: list[str]) -> bool:
        """Whether its name has all of these words, in lower case, or a word of its other texts begins with them."""
        name, others = self.name.lower(), f" {self.about} {self.section.value}".lower()
        return all(word in name or f" {word}" in others for word in words)


@dataclass(frozen=True)
class CatalogueView:
    """The list at a moment."""

    entries: tuple[Entry, ...] = ()
    """Rows in the order of the sections."""
    folder: str = ""
    searching: bool = False
    """Whether the folder is being searched for the first time."""
    left_out: str = ""
    """Why the search may have missed files."""
    registered: RegisteredView = RegisteredView()
    serial: int = 0


class Catalogue:
    """Lists recent tasks, task files of a folder, examples, recordings and registered ids. Thread-safe.

    A page chooses by number: `entry` knows only what was listed, or typed and found.

    Args:
        folder: searched for task files.
        recordings: folder of recordings.
        recents: what was opened before.
        registered: ManiSkill's tasks.
        options: for tasks without options of their own.
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
        self._lock = threading.Lock()
        self._closing = threading.Event()
        self._searching: threading.Thread | None = None
        self._once_more = False
        self._numbers: dict[tuple[Section, str], int] = {}
        self._found: FoundTasks | None = None
        """Result of the last search; None before the first search has ended."""
        self._files = TaskFileReader()
        self._search_again = 0.0
        self._typed: dict[int, Entry] = {}
        self._seen: tuple[int, int] | None = None
        self._changes = 0
        self._view = CatalogueView(folder=_shown(str(self.folder)))

    def refresh(self) -> None:
        """Search the folder and look at the recent tasks again. Returns at once."""
        self._begin_search(again=True)

    def follow(self) -> None:
        """`refresh`, unless a search is under way or has just ended. Call it while the list is in sight."""
        if time.monotonic() >= self._search_again:
            self._begin_search(again=False)

    def view(self) -> CatalogueView:
        """The list; cheap while nothing changes."""
        registered = self.registered.view
        with self._lock:
            now = self._changes, registered.serial
            if now != self._seen:
                self._seen = now
                view = replace(
                    self._view,
                    entries=tuple(self._entries(registered)),
                    searching=self._found is None,
                    left_out="" if self._found is None else self._found.left_out,
                    registered=registered,
                )
                if view != self._view:
                    self._view = replace(view, serial=view.serial + 1)
            return self._view

    def entry(self, number: int) -> Entry | None:
        """The row of this number that is listed or was typed; None if there is none."""
        listed = next((entry for entry in self.view().entries if entry.number == number), None)
        return self._typed.get(number) if listed is None else listed

    def typed(self, text: str) -> Entry | None:
        """The row of the task file that a person has typed the path of; None for a text that is no path.

        Raises:
            NotAPath: the file cannot be opened.
        """
        named = typed_path(text, self.folder)
        if named is None:
            return None
        file, class_name = named
        reference = f"{file}:{class_name}" if class_name else str(file)
        with self._lock:
            about = _about(self._files.read(file) or TaskFile(file, (), ()))
            entry = self._entry(Section.TYPED, reference, reference, about, file=file)
            self._typed[entry.number] = entry
        return entry

    def add_file(self, file: Path, env_id: str) -> Entry:
        """List a task file of the folder that was just written; returns its row."""
        task = TaskFile(file, (env_id,), ())
        with self._lock:
            found = self._found or FoundTasks()
            if all(known.path != file for known in found.files):
                self._found = replace(found, files=(task, *found.files))
                self._changes += 1
            return self._of_folder(task)

    def close(self) -> None:
        """End the search and the process of the pictures."""
        self._closing.set()
        self.registered.close()
        with self._lock:
            searching = self._searching
        if searching is not None:
            searching.join()

    def _begin_search(self, again: bool) -> None:
        """
        Args:
            again: Whether to search once more after a search that is under way: it may have passed by what has changed.
        """
        self.registered.start()
        with self._lock:
            if self._closing.is_set():
                return
            if self._searching is not None and self._searching.is_alive():
                self._once_more |= again
                return
            self._searching = threading.Thread(target=self._search, name="find-tasks", daemon=True)
            self._searching.start()

    def _search(self) -> None:
        while True:
            found, began = FoundTasks(), time.monotonic()
            try:
                found = find_task_files(self.folder, self._closing.is_set, self._files.read)
            except Exception as error:
                report_failure("The folder could not be searched for tasks", error)
            with self._lock:
                self._found = found
                self._changes += 1
                took = time.monotonic() - began
                self._search_again = time.monotonic() + max(SEARCH_SECONDS, took / SEARCH_SHARE)
                if not self._once_more or self._closing.is_set():
                    self._searching = None
                    return
                self._once_more = False

    # --- entries -------------------------------------------------------------------------------------

    def _entries(self, registered: RegisteredView) -> Iterator[Entry]:
        yield from map(self._recent, self.recents.list())
        yield from map(self._of_folder, () if self._found is None else self._found.files)
        for task in example_tasks():
            yield self._entry(Section.EXAMPLES, str(task), task.name, _first_line(task), file=task)
        yield self._entry(
            Section.RECORDINGS,
            "",
            f"{self._recordings.name or self._recordings}/",
            "Look through recorded episodes: play, compare, share"
            if self._recordings.is_dir()
            else "No recordings here yet. workbench review FOLDER opens another folder.",
        )
        why_not = registered.why_not
        # Tasks that cannot be opened before a download come last.
        for env_id in sorted(registered.ids, key=why_not.__contains__):
            why = why_not.get(env_id)
            entry = self._entry(
                Section.REGISTERED, env_id, env_id, "" if why is None else why.text, env_id=env_id
            )
            blank = (
                "" if why is None else "needs a download" if why.needs_download else "cannot be drawn here"
            )
            yield replace(entry, blank=blank)

    def _recent(self, task: RecentTask) -> Entry:
        file = task.file
        num_envs = min(task.num_envs, MOST_ENVS)
        options = replace(self.options, num_envs=num_envs, env_kwargs=dict(task.env_kwargs))
        kwargs = "".join(f", {name}={value}" for name, value in task.env_kwargs.items())
        how = f"{num_envs} {'env' if num_envs == 1 else 'envs'}{kwargs}"
        if file is None:
            return self._entry(
                Section.RECENT, task.reference, task.reference, how, options=options, env_id=task.reference
            )
        name = task.reference.rpartition("/")[2]
        about = f"{self._place(file)} · {how}"
        return self._entry(
            Section.RECENT, task.reference, name, about, file=file, gone=not file.is_file(), options=options
        )

    def _of_folder(self, task: TaskFile) -> Entry:
        name = str(task.path.relative_to(self.folder))
        return self._entry(Section.FOLDER, str(task.path), name, _about(task), file=task.path)

    def _place(self, file: Path) -> str:
        """The folder of a file, as a person would write it."""
        folder = file.parent
        if folder.is_relative_to(self.folder):
            inside = folder.relative_to(self.folder)
            return "this folder" if inside == Path() else f"{inside}/"
        home = Path.home()
        return f"~/{folder.relative_to(home)}" if folder.is_relative_to(home) else str(folder)

    def _entry(
        self,
        section: Section,
        reference: str,
        name: str,
        about: str,
        file: Path | None = None,
        gone: bool = False,
        options: TaskOptions | None = None,
        env_id: str = "",
    ) -> Entry:
        number = self._numbers.setdefault((section, reference), len(self._numbers) + 1)
        return Entry(number, section, _shown(name), _shown(about), reference, file, gone, options, env_id)


def _about(task: TaskFile) -> str:
    if task.not_python:
        return "not Python yet" if task.line is None else f"not Python yet: line {task.line}"
    names = task.ids or task.classes
    return ", ".join((*names[:3], *(("…",) if len(names) > 3 else ())))


def _shown(text: str) -> str:
    return short_line(os.fsencode(text).decode(errors="replace"), LONGEST_SHOWN)


@cache
def _first_line(file: Path) -> str:
    """The first line of the docstring of an example."""
    try:
        return (ast.get_docstring(parse_python(file.read_bytes())) or "").partition("\n")[0].replace("`", "")
    except (OSError, SyntaxError, ValueError):
        return ""
