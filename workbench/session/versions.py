"""Which version of the author's file is asked for, and from where: a save, a person, or the end of a worker.

The file is followed whether or not it ever loaded, with the modules beside it that the task imported. What a worker is
asked to load after another's end is `recovery`'s to say; here it is said to the worker, and the page's state follows.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

from workbench.authoring.problem import Problem
from workbench.authoring.watch import SourceWatcher
from workbench.session.kept_worker import Death
from workbench.session.live_state import SharedState
from workbench.session.messages import Failed, Load, LoadLevel, Play, Request, TaskDescription
from workbench.session.recovery import Recovery, Wanted, is_on_disk


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
            request = state.load_request(self._recovery.file_asked(), level)
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
                requests.append(state.load_request(wanted))
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
            return None if task is None else self._shared.state.load_request(_as_it_is(task))

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

    def failed(self, failed: Failed) -> None:
        """If it was a load of a fresh worker, that is to have the last good version."""
        with self._shared.lock:
            wanted = self._recovery.wanted() if self._recovery.failed(failed.kept) else None
            request = None if wanted is None else self._shared.state.load_request(wanted)
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


def _as_it_is(task: TaskDescription) -> Wanted:
    return Wanted(dict(task.source), None)
