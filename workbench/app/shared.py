"""The objects that the pages of one server share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import psutil

from workbench.app.pages import Pages, ShownPage, Which
from workbench.app.session import Session
from workbench.commands import COMMANDS
from workbench.episodes.reader.reading import recover_confined, recovered_text
from workbench.library.folder import Library
from workbench.machine.loop import BlockingPool
from workbench.page.door.gated_server import GatedServer
from workbench.page.scene.viewpoint import View3D
from workbench.page.widgets.notices import notify_all
from workbench.page.widgets.templates import counted
from workbench.page.widgets.visitors import PATH, Visitors
from workbench.review.playback import Review
from workbench.review.recorded_scene import SceneProcess

MIN_FREE_BYTES = 4 << 30
"""Minimum free RAM for rendering catalogue thumbnails while a task is open."""
_NOTICE_SECONDS = 8.0
_RECOVERY_TIMEOUT_SECONDS = 10.0
"""Maximum time that `close` waits for the recovery of episodes."""


@dataclass(frozen=True)
class Recordings:
    """The recordings of a folder, and the review of the open ones."""

    library: Library
    review: Review


class Shared:
    """The sessions, the recordings, the 3-D view, and the shown page.

    Args:
        gated_server: The server of the pages.
        folder: The folder that is recorded to and reviewed.
        make_page: Builds a page; see `Pages`.
        session: The live env, if there is one.
        tasks: Task files that may define the envs of foreign recordings.
        imports: Modules that register tasks, as in `TaskOptions.imports`.
        on_notice: Called, on any thread, with a message for the terminal.
    """

    def __init__(
        self,
        gated_server: GatedServer,
        folder: Path,
        make_page: Callable[[Which, bool], ShownPage],
        session: Session | None,
        tasks: tuple[Path, ...],
        imports: tuple[str, ...],
        on_notice: Callable[[str], None],
    ) -> None:
        self.server, self._folder, self._tasks = gated_server.server, folder, tasks
        self._imports, self._on_notice = imports, on_notice
        self._recordings: Recordings | None = None
        self._first: Path | Literal["newest"] = "newest"
        """Recording that the first review opens."""
        self.looks_at = False
        """Whether the next review page opens a recording that the user chose on another page."""
        self._recovering = BlockingPool("recover")
        self.visitors = Visitors(self.server, COMMANDS)
        gated_server.add_channel(PATH, self.visitors.serve)
        self.session = session
        """Session that the live page shows when it is next built."""
        self.home = session
        """The session that the user opened, by command or from the list. `session` differs while a recording of another task
        is continued."""
        self._saving: set[Session] = set()
        """Sessions that are closed when their episodes are saved."""
        self.stage = View3D(self.server)
        self.pages = Pages(self.server, self.stage, make_page)

    @property
    def recordings(self) -> Recordings:
        """The recordings. The first access, by the first review page, reads the folder; later accesses return
        the same object."""
        self._recordings = self._recordings or self._open_recordings()
        return self._recordings

    def _open_recordings(self) -> Recordings:
        library = Library(self._folder)
        review = Review(library, make_scene=SceneProcess(self._tasks, self._imports))
        library.on_change.add(review.library_changed)
        review.open_first(self._first)
        library.watch()
        opened = Recordings(library, review)
        if self.session is None:
            # A live session's recorder has already recovered the episodes, and may be writing new ones.
            self._recovering.begin(lambda: self._recover(opened))
        return opened

    def _recover(self, opened: Recordings) -> None:
        """Recover episodes that a killed program left half written."""
        try:
            recovered = [str(file) for file in recover_confined(self._folder)]
        except OSError as error:
            opened.review.add_problem(str(error))
            self._on_notice(str(error))
            return
        if recovered:
            what = "An episode" if len(recovered) == 1 else f"{len(recovered)} episodes"
            opened.review.add_problem(f"{what} left half written by a killed program is back in the library.")
            self._on_notice(recovered_text(recovered))
            opened.library.request_scan()

    def look_at(self, recording: Path) -> None:
        """Open the recording with this file in the review."""
        self._first, self.looks_at = recording, True
        if self._recordings is not None:
            self._recordings.review.open_first(recording)
        self.pages.show("review")

    def task_files(self) -> tuple[Path, ...]:
        """The task files that this program was started with or has open."""
        task = None if self.session is None else self.session.view().task
        live = () if task is None or task.file is None else (Path(task.file),)
        return tuple(file.absolute() for file in (*live, *self._tasks))

    def is_idle(self) -> bool:
        """Whether the machine has capacity for work besides an open task."""
        session = self.session
        if session is None:
            return True
        view = session.view()
        free = psutil.virtual_memory().available
        return view.state in ("paused", "error", "stopped") and view.busy is None and free > MIN_FREE_BYTES

    @property
    def sessions(self) -> set[Session]:
        """The open sessions, and those that are closed when their episodes are saved."""
        return {one for one in (*self._saving, self.home, self.session) if one is not None}

    def saving_text(self) -> str:
        """Text for the page: the episodes that are being saved of sessions that no page shows any more; or empty."""
        return ", ".join(f"saving {text}" for one in list(self._saving) if (text := one.saving().text))

    def close_session(self, session: Session) -> None:
        """Close a session that no page shows any more. Must not be called on the loop.

        If its episodes are still being saved, waits for them, and tells the pages what becomes of them.
        """
        before = session.saving()
        if not before.unsaved:
            session.close()
            return
        what = counted(before.unsaved, "episode")
        notify_all(
            self.server,
            "Still saving",
            f"{what} of the previous task: Open another task (Ctrl+O) shows the progress.",
            seconds=_NOTICE_SECONDS,
        )
        self._saving.add(session)
        session.close(finish_saving=True)
        self._saving.discard(session)
        after = session.saving()
        if after.status.failed or after.kept.failed > before.kept.failed:
            why = after.kept.why or after.status.message
            notify_all(self.server, "An episode of the previous task was not saved", why, "red")
        elif not after.unsaved:
            notify_all(self.server, "Saved", f"{what} of the previous task.", None, _NOTICE_SECONDS)

    def close(self) -> None:
        """End the recovery of episodes, and close the recordings. Sessions are not closed."""
        self._recovering.close(_RECOVERY_TIMEOUT_SECONDS)
        if self._recordings is not None:
            self._recordings.review.close()
            self._recordings.library.close()
