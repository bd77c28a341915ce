"""Decides which version of the author's file the worker loads: after a save, on request, or after a crash."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Future
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal, NamedTuple

from workbench.authoring.loading.modules import read_source
from workbench.authoring.loading.watch import SourceWatcher
from workbench.authoring.problem import Problem
from workbench.jobs.policy import NoPolicy, find_policy
from workbench.jobs.task import Stepped, TaskDescription, TaskOptions
from workbench.session.live.live_state import LiveState
from workbench.session.loop import Aside, do, on_loop, wait_for_disk
from workbench.session.process.supervisor import Death, End
from workbench.session.protocol.messages import (
    Load,
    LoadFailed,
    Loading,
    LoadLevel,
    NewProcessNeeded,
    Play,
    Request,
)

Attempt = Literal["file", "moment", "version", "nothing"]
_GOOD_VERSIONS = 2
_PROVEN_SECONDS = 30.0
"""Seconds after a load: a version whose process crashes later than this counts as one that worked."""


class LoadInputs(NamedTuple):
    """Source and moment of a load."""

    source: dict[str, str] | None
    """Texts to use in place of the files; None for those on disk."""
    snapshot: bytes | None
    """The moment to restore."""
    number: int
    """`Load.number`."""


def is_on_disk(source: Mapping[str, str]) -> bool:
    """Whether the files still have these texts."""
    for path, text in source.items():
        try:
            if read_source(path) != text:
                return False
        except (OSError, SyntaxError):
            return False
    return True


@dataclass
class _GoodVersion:
    """A version that was loaded without a failure."""

    file: str | None
    source: dict[str, str]
    since: float
    """When the version was last loaded."""
    crashes: int = 0
    """Crashes of its process in a row, each soon after the version was loaded."""
    idle_crashes: int = 0
    """How many of `crashes` came since its last step, while nothing was asked of the worker."""


class Recovery:
    """Chooses what the next worker loads after one has ended.

    Loading may end the worker again: the version is refused, the moment cannot be restored, importing the file crashes,
    memory runs out. So the attempts are, in order: the file on disk if no worker has tried it yet, the last good version at
    its newest moment, the same from its start, and at last nothing, until the file changes. None is tried twice, so that
    no file can end workers one after the other. A version that crashes twice, each time soon after it was loaded, is no good
    one: the version before it comes back. Without one it comes back itself, unless it crashed twice without making a step.
    Used on the loop.
    """

    def __init__(
        self, newest: Callable[[], bytes | None], clock: Callable[[], float] = time.monotonic
    ) -> None:
        """
        Args:
            newest: returns the newest state of the batch, a pickled `core.snapshots.snapshot.Snapshot`, or None. Called
                only when needed, since assembling one takes longer than a step.
        """
        self._newest, self._clock = newest, clock
        self._good: list[_GoodVersion] = []
        """The newest last; at most `_GOOD_VERSIONS`."""
        self._attempt: Attempt = "file"
        self._asked = self._begun = 1
        """Numbers of the newest load of the file that was asked for, and of the newest that a worker has begun."""
        self.loading = True
        """A load is running."""
        self._has_env = False

    @property
    def restoring(self) -> bool:
        """Whether the running load brings back the last good version."""
        return self.loading and self._attempt in ("moment", "version")

    @property
    def good_source(self) -> dict[str, str] | None:
        """Source of the version that is brought back; None if there is none."""
        return self._good[-1].source if self._good else None

    @property
    def file_waits(self) -> bool:
        """Whether no worker has begun to load the file as it was saved last."""
        return self._asked > self._begun

    def next_load(self) -> LoadInputs | None:
        """What a new worker has to load; None for nothing."""
        if self._attempt == "nothing":
            return None
        self.loading = True
        good = self.good_source if self._attempt != "file" else None
        snapshot = self._newest() if self._attempt in ("file", "moment") else None
        return LoadInputs(good or None, snapshot, self._asked if good is None else 0)

    def file_requested(self) -> LoadInputs:
        """The present worker is to load the file on disk."""
        self._attempt, self.loading = "file", True
        self._asked += 1
        return LoadInputs(None, None if self._has_env else self._newest(), self._asked)

    def began(self, number: int) -> None:
        """A worker has begun the load of this number."""
        self._begun = max(self._begun, number)

    def loaded(self, task: TaskDescription) -> None:
        """`task` runs: it is the last good version from now on."""
        now, last = self._clock(), self._good[-1] if self._good else None
        if last is not None and last.file != task.file:
            self._good, last = [], None  # no version of another file comes back
        if last is not None and last.source == task.source:
            last.since = now
        else:
            self._good = [*self._good, _GoodVersion(task.file, task.source, now)][-_GOOD_VERSIONS:]
        self._has_env = True
        self._attempt, self.loading = "file", self.file_waits

    def stepped(self) -> None:
        """A step was made, which somebody had asked for."""
        if self._good:
            self._good[-1].idle_crashes = 0

    def failed(self, kept: bool) -> bool:
        """A load failed in a worker that continues. True if the worker has no version now, and `next_load` has one to
        try."""
        was_loading, self.loading = self.loading, self.file_waits
        if kept or not was_loading or self.file_waits:
            return False
        self._step_down()
        return self._attempt != "nothing"

    def died(self, crashed: bool, idle: bool = False) -> None:
        """The worker is gone.

        Args:
            crashed: by itself, and not because it was ended or handed over.
            idle: nothing was asked of it at the time.
        """
        if self.file_waits:
            self._attempt = "file"
        elif self.loading:
            self._step_down()
        elif self._attempt != "nothing":
            self._after_running(crashed, idle)
        self.loading = self._has_env = False

    def restart_requested(self) -> None:
        """A person restarts the worker, to load the file as it is now; if that is just being loaded (it may loop there), to
        have the last good version back."""
        for version in self._good:
            version.crashes = version.idle_crashes = 0
        if self.loading and not self.restoring and not self.file_waits and self._good:
            return  # `died` goes on from there
        self._attempt, self.loading, self._has_env = "file", False, False
        self._asked += 1

    def _after_running(self, crashed: bool, idle: bool) -> None:
        if not self._good:
            self._attempt = "nothing"
            return
        self._attempt, version = "moment", self._good[-1]
        if not crashed:
            return
        proven = self._clock() - version.since > _PROVEN_SECONDS
        version.crashes = 0 if proven else version.crashes + 1
        version.idle_crashes = 0 if proven else version.idle_crashes + idle
        if version.crashes > 1 and len(self._good) > 1:
            self._good.pop()
        elif version.idle_crashes > 1:
            self._attempt = "nothing"

    def _step_down(self) -> None:
        if not self._good:
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
        state: LiveState,
        on_change: Callable[[], None],
        send: Callable[[Request], None],
        replace_worker: Callable[[], None],
        on_save: Callable[[], None],
        aside: Aside,
    ) -> None:
        """
        Args:
            state: the session's.
            on_change: called when a watched file was saved.
            on_save: called then too, before it is loaded.
            aside: begins to watch files, for which they are read.
        """
        self._state, self._on_change, self._send = state, on_change, send
        self._replace_worker, self._on_save = replace_worker, on_save
        self._recovery = Recovery(state.newest_moment)
        self._watcher = SourceWatcher(self._on_files_changed)
        self._aside = aside
        self._needed = NewProcessNeeded("", False)
        """Why the next worker is a new process, where the last one said so."""

    def start(self) -> None:
        """Watch the task's own file from now on. Called before there is a worker, on another thread than the loop."""
        self._watcher.follow(self._wanted(()))

    # --- requests ------------------------------------------------------------------------------------

    @on_loop
    def reload(self, level: LoadLevel = "auto") -> None:
        """Load the file again. A level other than ``auto`` is forced, even if it keeps parts of the old version.

        A worker that does not take the request (an endless loop) is interrupted or replaced.
        """
        request = self._state.load_request(*self._recovery.file_requested(), level=level)
        if self._state.now.state == "stopped":
            self._replace_worker()  # the new one loads the file, see `first_requests`
        else:
            self._send(request)

    @on_loop
    def choose_class(self, name: str) -> None:
        """Load another task class of the same file, one of `TaskDescription.others`."""
        if self._state.choose_class(name):
            self.reload()

    @on_loop
    def apply_options(self, options: TaskOptions) -> None:
        """Make the envs with other options. If the task fails with them, the present envs and options stay."""
        self._state.apply_options(options)
        self.reload()

    @on_loop
    def use_control_mode(self, mode: str) -> None:
        """Make the envs with this control mode, unless it is in effect."""
        options, task = self._state.options, self._state.now.task
        if task is not None and task.control_mode != mode:
            self.apply_options(replace(options, env_kwargs={**options.env_kwargs, "control_mode": mode}))

    @on_loop
    def open_file(self, file: Path, class_name: str) -> None:
        """Open a task class of another file instead, and watch that file."""
        self._state.open_file(file, class_name)
        self._follow((), {})
        self.reload()

    @on_loop
    def restart_worker(self) -> None:
        """Kill the worker and start another, which loads the file as it is now, at the newest moment."""
        self._recovery.restart_requested()
        self._replace_worker()

    @on_loop
    def _on_files_changed(self, paths: set[Path]) -> None:
        self._on_save()
        self._state.set(stale=True)
        self._state.use_saved_file()
        self._on_change()
        self.reload()

    # --- for a new worker ----------------------------------------------------------------------------

    @on_loop
    def first_requests(self) -> list[Request]:
        """First requests to a new worker: settings, what to load, and whether to play."""
        state = self._state
        requests: list[Request] = [state.settings()]
        next_load = self._recovery.next_load()
        if next_load is not None:
            needed, self._needed = self._needed, NewProcessNeeded("", False)
            requests.append(
                state.load_request(*next_load, because=needed.reason, same_scene=needed.same_scene)
            )
        else:
            state.wait_for_file()
        # A version that failed while it ran would fail again: it comes back paused.
        if state.wants_play and not (self._recovery.restoring and state.now.problem_at_run):
            requests.append(Play(True))
        return requests

    @on_loop
    def own_files(self) -> list[str]:
        """The known files of the author."""
        return self._state.own_files()

    def knows_file(self, path: str) -> bool:
        """Whether this absolute path is a file of the task, of its policy, or a module in the task's folder. Looks at the
        disk."""
        state = self._state
        known, policy, folder, own_folder = do(
            lambda: (state.own_files(), state.policy, state.folder, state.own_folder)
        )
        if policy is not None:
            with contextlib.suppress(NoPolicy):
                known = [*known, str(find_policy(policy, folder)[0])]
        file = Path(path)
        # A module that has never loaded is in no `source_files`. Resolved: a path may leave the folder again by "..".
        beside = own_folder is not None and file.resolve().is_relative_to(own_folder.resolve())
        return file in [Path(one).absolute() for one in known] or (
            beside and file.suffix == ".py" and file.is_file()
        )

    @on_loop
    def running_load(self) -> Load | None:
        """The load of the running version, for another worker; None if no task runs."""
        task = self._state.now.task
        return None if task is None else self._state.load_request(dict(task.source))

    def began(self, loading: Loading) -> None:
        """The worker has begun a load."""
        self._recovery.began(loading.number)

    def stepped(self, event: Stepped) -> None:
        """The worker has made a step."""
        if event.step.action is not None:
            self._recovery.stepped()

    def new_process_needed(self, needed: NewProcessNeeded) -> None:
        """The worker ends and leaves the load to the next one."""
        self._needed = needed

    # --- results -------------------------------------------------------------------------------------

    def version_loaded(self, task: TaskDescription) -> bool:
        """A version runs; returns whether it was brought back after a crash."""
        restored = self._recovery.restoring
        self._recovery.loaded(task)
        return restored

    def follow(self, task: TaskDescription, stale: bool) -> None:
        """Watch the files of the running version."""
        self._follow(task.source_files, {} if stale else task.source)

    def failed(self, failed: LoadFailed) -> None:
        """A load failed; a worker without a version gets the next attempt of `Recovery`, unless it is spoiled and ends."""
        if failed.spoiled:
            self._needed = NewProcessNeeded(failed.spoiled, failed.at_run)
            next_load = None
        else:
            next_load = self._recovery.next_load() if self._recovery.failed(failed.kept) else None
        request = None if next_load is None else self._state.load_request(*next_load)
        if request is not None:
            self._send(request)

    def follow_failure(self, failed: LoadFailed) -> None:
        """Watch the file of a problem too, before a person sees it and mends it. Called on another thread than the loop."""
        if failed.problem.file is None:
            return
        file = Path(failed.problem.file)
        task = self._state.now.task
        # It may be a module that the task has never imported without an error, so it is in no `source_files`; or one of
        # another folder, and a person mends it there.
        wait_for_disk(do(lambda: self._follow(() if task is None else task.source_files, {}, file)))

    def died(self, death: Death, printed: str) -> tuple[Problem | None, bool]:
        """The worker is gone.

        Args:
            printed: the last lines.

        Returns:
            The problem to show, if any, and whether there is a version to bring back.
        """
        while_loading = self._recovery.loading
        texts = self._loading_texts() if while_loading else None
        self._recovery.died(death.end is End.DIED, idle=death.doing is None)
        problem = self._state.died(death, while_loading, printed, texts)
        return problem, self._state.now.task is not None

    def _loading_texts(self) -> Mapping[str, str]:
        """Source by path of the version that is being loaded, as far as it is known."""
        if self._recovery.restoring:
            good = self._recovery.good_source
            return {} if good is None else good
        if self._recovery.file_waits:
            # It was saved again since: its lines on disk are not those that ran.
            return dict.fromkeys(self._state.own_files(), "")
        return {}

    def close(self) -> None:
        """Stop watching. Called on another thread than the loop."""
        self._watcher.stop()

    def _follow(
        self, paths: Iterable[str], texts: Mapping[str, str], at_fault: Path | None = None
    ) -> Future[None] | None:
        if wanted := self._wanted(paths, at_fault):
            return self._aside.begin(partial(self._watcher.follow, wanted, texts))
        return None

    def _wanted(self, paths: Iterable[str], at_fault: Path | None = None) -> set[Path]:
        """The task's own file, those of `paths` in its folder, and the one that `at_fault` names, wherever it is; none if
        nothing is watched."""
        own_file, folder = self._state.own_file, self._state.own_folder
        if own_file is None or folder is None:
            return set()
        modules = [Path(p) for p in paths if Path(p).is_relative_to(folder)]
        return {own_file, *modules, *([] if at_fault is None else [at_fault])}
