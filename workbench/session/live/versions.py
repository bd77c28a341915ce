"""Which version of the author's file is asked for, and from where: a save, a person, or the end of a worker.

The file is followed whether or not it ever loaded, with the modules beside it that the task imported. What a worker is
asked to load after another's end is `Recovery`'s to say; `Versions` says it to the worker, and the page's state follows.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Literal, NamedTuple

from workbench.authoring.loading.modules import read_source
from workbench.authoring.loading.watch import SourceWatcher
from workbench.authoring.problem import Problem
from workbench.jobs.task import TaskDescription
from workbench.session.live.live_state import SharedState
from workbench.session.process.supervisor import Death
from workbench.session.protocol.messages import Load, LoadFailed, LoadLevel, Play, Request

Rung = Literal["file", "moment", "version", "nothing"]


class LoadInputs(NamedTuple):
    """What a load is to name besides the task."""

    source: dict[str, str] | None
    """Text to be used in place of the files; None for what is on disk."""
    snapshot: bytes | None
    """The moment to be restored."""


def is_on_disk(source: Mapping[str, str]) -> bool:
    """Whether the files still have these texts."""
    for path, text in source.items():
        try:
            if read_source(path) != text:
                return False
        except (OSError, SyntaxError):
            return False
    return True


class Recovery:
    """What the next worker is asked to load when one has gone: the last good version at the last moment.

    Bringing back a version can itself fail, in ways that end the worker again: the moment cannot be restored, the file kills
    whoever imports it, the memory does not suffice. So there is a way down: the file as it is on disk (if that is what
    somebody waits for), the last good version at its last moment, the same from its start, and at last nothing: a worker
    that is up and waits for the file to change. None is tried twice, so that no file can make workers die one after the
    other. Used under the session's lock.
    """

    def __init__(self, newest: Callable[[], bytes | None]) -> None:
        """
        Args:
            newest: the newest state of the batch, a pickled `core.snapshots.snapshot.Snapshot`, or None. Asked for only
                when it is wanted, since putting one together takes longer than a step.
        """
        self._good: TaskDescription | None = None
        self._newest = newest
        self._rung: Rung = "file"
        self.loading = True
        """Whether a load is under way."""
        self._has_env = False

    @property
    def restoring(self) -> bool:
        """Whether the load under way brings back what there was."""
        return self.loading and self._rung in ("moment", "version")

    def wanted(self) -> LoadInputs | None:
        """What a fresh worker is to load; None to load nothing."""
        if self._rung == "nothing":
            return None
        self.loading = True
        good = self._good.source if self._good is not None and self._rung != "file" else None
        return LoadInputs(good or None, self._newest() if self._rung in ("file", "moment") else None)

    def file_asked(self) -> LoadInputs:
        """The file is to be loaded as it is on disk, by the worker that there is."""
        self._rung, self.loading = "file", True
        return LoadInputs(None, None if self._has_env else self._newest())

    def loaded(self, task: TaskDescription) -> None:
        """`task` runs, and is the last good version from now on."""
        self._good, self._has_env = task, True
        self._rung, self.loading = "file", False

    def failed(self, kept: bool) -> bool:
        """A load failed in a worker that goes on. True if it has nothing now, and `wanted` says what to try."""
        was_loading, self.loading = self.loading, False
        if kept or not was_loading:
            return False
        self._step_down()
        return self._rung != "nothing"

    def died(self, file_waits: bool) -> None:
        """The worker is gone; `file_waits`: it was ended because a newer file waited behind it."""
        if file_waits:
            self._rung = "file"
        elif self.loading:
            self._step_down()
        elif self._rung != "nothing":
            self._rung = "moment" if self._good is not None else "nothing"
        self.loading = self._has_env = False

    def restart_asked(self) -> None:
        """Somebody had the worker replaced: what there was comes back, or the file if nothing ever ran."""
        self._rung = "file" if self._good is None else "moment"
        self.loading = self._has_env = False

    def _step_down(self) -> None:
        if self._good is None:
            self._rung = "nothing"
        elif self._rung == "file":
            self._rung = "moment" if self._newest() is not None else "version"
        elif self._rung == "moment" and self._newest() is not None:
            self._rung = "version"
        else:
            self._rung = "nothing"


class Versions:
    """See the module's text."""

    def __init__(
        self,
        shared: SharedState,
        send: Callable[[Request], None],
        replace_worker: Callable[[], None],
        on_save: Callable[[], None],
    ) -> None:
        """
        Args:
            on_save: called when a file that is followed was saved, before it is loaded.
        """
        self._shared, self._send, self._replace_worker = shared, send, replace_worker
        self._on_save = on_save
        self._recovery = Recovery(shared.state.newest_moment)
        self._watcher = SourceWatcher(self._on_files_changed)

    def start(self) -> None:
        """Follow the task's own file from now on."""
        self._follow((), {})

    # --- what is asked for ---------------------------------------------------------------------------

    def reload(self, level: LoadLevel = "auto") -> None:
        """Load the file again, by a level that is named whatever it may leave of the old version.

        A worker that does not take it up (an endless loop) is interrupted or replaced.
        """
        with self._shared.lock:
            state = self._shared.state
            request = state.load_request(*self._recovery.file_asked(), level)
            stopped = state.now.state == "stopped"
        if stopped:
            self._replace_worker()  # it will be greeted with the file
        else:
            self._send(request)

    def choose_class(self, name: str) -> None:
        """Another task class of the same file, one that `TaskDescription.others` names."""
        with self._shared.lock:
            chosen = self._shared.state.choose_class(name)
        if chosen:
            self.reload()

    def open_file(self, file: Path, class_name: str) -> None:
        """Open a task class of another file in place of the one that is open, and follow that file."""
        with self._shared.lock:
            self._shared.state.open_file(file, class_name)
        self.start()
        self.reload()

    def restart_worker(self) -> None:
        """End the worker, whatever it is doing, and start another with the last good version where it was."""
        with self._shared.lock:
            self._recovery.restart_asked()
        self._replace_worker()

    def _on_files_changed(self, paths: set[Path]) -> None:
        self._on_save()
        with self._shared.changing() as state:
            state.set(stale=True)
            state.file_is_edited()
        self.reload()

    # --- what a worker needs to know -----------------------------------------------------------------

    def greeting(self) -> list[Request]:
        """Everything that a worker before this one knew."""
        with self._shared.lock:
            state = self._shared.state
            requests: list[Request] = [state.settings()]
            wanted = self._recovery.wanted()
            if wanted is not None:
                requests.append(state.load_request(*wanted))
            else:
                state.waits_for_the_file()
            if state.wants_play:
                requests.append(Play(True))
            return requests

    def own_files(self) -> list[str]:
        """The author's files, as far as they are known."""
        with self._shared.lock:
            return self._shared.state.own_files()

    def same_again(self) -> Load | None:
        """How another worker gets the version that runs."""
        with self._shared.lock:
            task = self._shared.state.now.task
            return None if task is None else self._shared.state.load_request(dict(task.source))

    # --- what came of it -----------------------------------------------------------------------------

    def came_in(self, task: TaskDescription) -> tuple[bool, bool]:
        """A version runs. Under the lock.

        Returns:
            whether it is the last good one, brought back, and whether the files hold another by now.
        """
        restored = self._recovery.restoring
        self._recovery.loaded(task)
        return restored, restored and not is_on_disk(task.source)

    def follow(self, task: TaskDescription, stale: bool) -> None:
        """The files of a version that runs."""
        self._follow(task.source_files, {} if stale else task.source)

    def failed(self, failed: LoadFailed) -> None:
        """If it was a load of a fresh worker, that is to have the last good version."""
        with self._shared.lock:
            wanted = self._recovery.wanted() if self._recovery.failed(failed.kept) else None
            request = None if wanted is None else self._shared.state.load_request(*wanted)
            task = self._shared.state.now.task
        if request is not None:
            self._send(request)
        if failed.problem.file is not None:
            # A module beside the task that broke before the task had ever imported it whole.
            self._follow((*(() if task is None else task.source_files), failed.problem.file), {})

    def died(self, death: Death, printed: str) -> tuple[Problem | None, bool]:
        """The worker is gone.

        Args:
            printed: the last lines.

        Returns:
            what is to be told of it, if anything, and whether there is a version that can come back.
        """
        with self._shared.lock:
            while_loading = self._recovery.loading
            self._recovery.died(death.file_waits)
            problem = self._shared.state.died(death, while_loading, printed)
            return problem, self._shared.state.now.task is not None

    def close(self) -> None:
        """Follow nothing any more."""
        self._watcher.stop()

    def _follow(self, paths: Iterable[str], texts: Mapping[str, str]) -> None:
        """The task's own file, whether or not it ever loaded, and `paths` beside it."""
        own_file, folder = self._shared.state.own_file, self._shared.state.own_folder
        if own_file is None or folder is None:
            return
        beside = [Path(p) for p in paths if Path(p).is_relative_to(folder)]
        self._watcher.follow({own_file, *beside}, texts)
