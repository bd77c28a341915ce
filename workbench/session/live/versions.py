"""Decides which version of the author's file the worker loads: after a save, on request, or after a crash."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Literal, NamedTuple

from workbench.authoring.loading.modules import read_source
from workbench.authoring.loading.watch import SourceWatcher
from workbench.authoring.problem import Problem
from workbench.jobs.task import TaskDescription, TaskOptions
from workbench.session.live.live_state import SharedState
from workbench.session.process.supervisor import Death
from workbench.session.protocol.messages import Load, LoadFailed, LoadLevel, Play, Request

Attempt = Literal["file", "moment", "version", "nothing"]


class LoadInputs(NamedTuple):
    """Source and moment of a load."""

    source: dict[str, str] | None
    """Texts to use in place of the files; None for those on disk."""
    snapshot: bytes | None
    """The moment to restore."""


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
    """Chooses what the next worker loads after one has died.

    Loading may kill the worker again: the moment cannot be restored, importing the file crashes, memory runs out. So the
    attempts are, in order: the file on disk (if a newer one waits), the last good version at its newest moment, the same
    from its start, and at last nothing, until the file changes. None is tried twice, so that no file can kill workers one
    after the other. Used under the session's lock.
    """

    def __init__(self, newest: Callable[[], bytes | None]) -> None:
        """
        Args:
            newest: returns the newest state of the batch, a pickled `core.snapshots.snapshot.Snapshot`, or None. Called
                only when needed, since assembling one takes longer than a step.
        """
        self._good: TaskDescription | None = None
        self._newest = newest
        self._attempt: Attempt = "file"
        self.loading = True
        """A load is running."""
        self._has_env = False

    @property
    def restoring(self) -> bool:
        """Whether the running load brings back the last good version."""
        return self.loading and self._attempt in ("moment", "version")

    def next_load(self) -> LoadInputs | None:
        """What a new worker has to load; None for nothing."""
        if self._attempt == "nothing":
            return None
        self.loading = True
        good = self._good.source if self._good is not None and self._attempt != "file" else None
        return LoadInputs(good or None, self._newest() if self._attempt in ("file", "moment") else None)

    def file_requested(self) -> LoadInputs:
        """The present worker is to load the file on disk."""
        self._attempt, self.loading = "file", True
        return LoadInputs(None, None if self._has_env else self._newest())

    def loaded(self, task: TaskDescription) -> None:
        """`task` runs: it is the last good version from now on."""
        self._good, self._has_env = task, True
        self._attempt, self.loading = "file", False

    def failed(self, kept: bool) -> bool:
        """A load failed in a worker that still runs. True if it has no version now, and `next_load` has one to try."""
        was_loading, self.loading = self.loading, False
        if kept or not was_loading:
            return False
        self._step_down()
        return self._attempt != "nothing"

    def died(self, file_waits: bool) -> None:
        """The worker is gone; `file_waits`: it was ended since a newer file waited to be loaded."""
        if file_waits:
            self._attempt = "file"
        elif self.loading:
            self._step_down()
        elif self._attempt != "nothing":
            self._attempt = "moment" if self._good is not None else "nothing"
        self.loading = self._has_env = False

    def restart_requested(self) -> None:
        """A person restarts the worker: the last good version comes back, or the file if there is none."""
        self._attempt = "file" if self._good is None else "moment"
        self.loading = self._has_env = False

    def _step_down(self) -> None:
        if self._good is None:
            self._attempt = "nothing"
        elif self._attempt == "file":
            self._attempt = "moment" if self._newest() is not None else "version"
        elif self._attempt == "moment" and self._newest() is not None:
            self._attempt = "version"
        else:
            self._attempt = "nothing"


class Versions:
    """Watches the author's files and asks the worker to load them.

    The task's own file is watched even if it never loaded, and with it the modules in its folder that the task imported.
    """

    def __init__(
        self,
        shared: SharedState,
        send: Callable[[Request], None],
        replace_worker: Callable[[], None],
        on_save: Callable[[], None],
    ) -> None:
        """
        Args:
            on_save: called when a watched file was saved, before it is loaded.
        """
        self._shared, self._send, self._replace_worker = shared, send, replace_worker
        self._on_save = on_save
        self._recovery = Recovery(shared.state.newest_moment)
        self._watcher = SourceWatcher(self._on_files_changed)

    def start(self) -> None:
        """Watch the task's own file from now on."""
        self._follow((), {})

    # --- requests ------------------------------------------------------------------------------------

    def reload(self, level: LoadLevel = "auto") -> None:
        """Load the file again. A level other than ``auto`` is forced, even if it keeps parts of the old version.

        A worker that does not take the request (an endless loop) is interrupted or replaced.
        """
        with self._shared.lock:
            state = self._shared.state
            request = state.load_request(*self._recovery.file_requested(), level)
            stopped = state.now.state == "stopped"
        if stopped:
            self._replace_worker()  # the new one loads the file, see `first_requests`
        else:
            self._send(request)

    def choose_class(self, name: str) -> None:
        """Load another task class of the same file, one of `TaskDescription.others`."""
        with self._shared.lock:
            chosen = self._shared.state.choose_class(name)
        if chosen:
            self.reload()

    def apply_options(self, options: TaskOptions) -> None:
        """Make the envs with other options. If the task fails with them, the present envs and options stay."""
        with self._shared.lock:
            self._shared.state.apply_options(options)
        self.reload()

    def open_file(self, file: Path, class_name: str) -> None:
        """Open a task class of another file instead, and watch that file."""
        with self._shared.lock:
            self._shared.state.open_file(file, class_name)
        self.start()
        self.reload()

    def restart_worker(self) -> None:
        """Kill the worker and start another with the last good version at its newest moment."""
        with self._shared.lock:
            self._recovery.restart_requested()
        self._replace_worker()

    def _on_files_changed(self, paths: set[Path]) -> None:
        self._on_save()
        with self._shared.changing() as state:
            state.set(stale=True)
            state.use_saved_file()
        self.reload()

    # --- for a new worker ----------------------------------------------------------------------------

    def first_requests(self) -> list[Request]:
        """First requests to a new worker: settings, what to load, and whether to play."""
        with self._shared.lock:
            state = self._shared.state
            requests: list[Request] = [state.settings()]
            next_load = self._recovery.next_load()
            if next_load is not None:
                requests.append(state.load_request(*next_load))
            else:
                state.wait_for_file()
            if state.wants_play:
                requests.append(Play(True))
            return requests

    def own_files(self) -> list[str]:
        """The known files of the author."""
        with self._shared.lock:
            return self._shared.state.own_files()

    def knows_file(self, path: str) -> bool:
        """See `LiveState.knows_file`."""
        with self._shared.lock:
            return self._shared.state.knows_file(path)

    def running_load(self) -> Load | None:
        """Loads the running version into another worker; None if no task runs."""
        with self._shared.lock:
            task = self._shared.state.now.task
            return None if task is None else self._shared.state.load_request(dict(task.source))

    # --- results -------------------------------------------------------------------------------------

    def version_loaded(self, task: TaskDescription) -> tuple[bool, bool]:
        """A version runs. Under the lock.

        Returns:
            Whether it was brought back after a crash, and whether it differs from the files.
        """
        restored = self._recovery.restoring
        self._recovery.loaded(task)
        return restored, restored and not is_on_disk(task.source)

    def follow(self, task: TaskDescription, stale: bool) -> None:
        """Watch the files of the running version."""
        self._follow(task.source_files, {} if stale else task.source)

    def failed(self, failed: LoadFailed) -> None:
        """A load failed; a worker without a version gets the next attempt of `Recovery`."""
        with self._shared.lock:
            next_load = self._recovery.next_load() if self._recovery.failed(failed.kept) else None
            request = None if next_load is None else self._shared.state.load_request(*next_load)
            task = self._shared.state.now.task
        if request is not None:
            self._send(request)
        if failed.problem.file is not None:
            # It may be a module that the task has never imported without an error, so it is in no `source_files`; or one of
            # another folder, and a person mends it there.
            self._follow(() if task is None else task.source_files, {}, Path(failed.problem.file))

    def died(self, death: Death, printed: str) -> tuple[Problem | None, bool]:
        """The worker is gone.

        Args:
            printed: the last lines.

        Returns:
            The problem to show, if any, and whether there is a version to bring back.
        """
        with self._shared.lock:
            while_loading = self._recovery.loading
            self._recovery.died(death.file_waits)
            problem = self._shared.state.died(death, while_loading, printed)
            return problem, self._shared.state.now.task is not None

    def close(self) -> None:
        """Stop watching."""
        self._watcher.stop()

    def _follow(self, paths: Iterable[str], texts: Mapping[str, str], at_fault: Path | None = None) -> None:
        """Watch the task's own file, those of `paths` in its folder, and the one that `at_fault` names, wherever it is."""
        own_file, folder = self._shared.state.own_file, self._shared.state.own_folder
        if own_file is None or folder is None:
            return
        modules = [Path(p) for p in paths if Path(p).is_relative_to(folder)]
        self._watcher.follow({own_file, *modules, *([] if at_fault is None else [at_fault])}, texts)
