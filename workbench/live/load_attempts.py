"""Decides what a worker loads: the file after a save, the last good version after a crash."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

from workbench.task.description import TaskDescription

Attempt = Literal["file", "moment", "version", "nothing"]
"""What to load. ``file``: the file on disk. ``moment``: the last good version, at its newest moment.
``version``: the last good version, from its start."""
Newest = Callable[[], bytes | None]
"""Returns the newest state of the batch, a pickled `envs.snapshots.snapshot.Snapshot`, or None. Called only
when needed, because assembling the snapshot takes longer than a step."""
_GOOD_VERSIONS = 2
PROVEN_SECONDS = 30.0
"""A version that ran for longer than this before its process crashed counts as one that works."""


class LoadInputs(NamedTuple):
    """Source and moment of a load."""

    source: dict[str, str] | None
    """Texts to use in place of the files; None to read the files on disk."""
    snapshot: bytes | None
    """Pickled snapshot to restore, or None."""
    number: int
    """`Load.number`."""


@dataclass(frozen=True)
class GoodVersion:
    """A version that was loaded without a failure."""

    file: str | None
    source: dict[str, str]
    since: float
    """Time of the version's last load, in seconds of the session's clock."""
    crashes: int = 0
    """Number of crashes of the version's process in a row, each soon after a load of the version."""
    idle_crashes: int = 0
    """How many of `crashes` happened in an idle worker, since the version's last step."""


@dataclass(frozen=True)
class Recovery:
    """Chooses what the next worker loads after a worker has ended. Methods that change something return a new
    `Recovery`.

    Loading may end the worker again: the version is refused, the moment cannot be restored, the import crashes, memory runs
    out. So the attempts are, in order: the file on disk if no worker has tried it yet, the last good version at its newest
    moment, the same version from its start, and finally nothing, until the file changes. No attempt is repeated, so that a
    file cannot kill one worker after another. A version that crashes twice, each time soon after its load, is not good: the
    previous good version is restored. If there is none, the version itself is restored, unless it crashed
    twice while idle, with no step in between.
    """

    good: tuple[GoodVersion, ...] = ()
    """Good versions, newest last; at most `_GOOD_VERSIONS`."""
    attempt: Attempt = "file"
    asked: int = 1
    begun: int = 1
    """`asked`: number of the newest requested load of the file. `begun`: number of the newest load that a
    worker has begun."""
    loading: bool = True
    """Whether a load is running."""
    has_env: bool = False

    @property
    def restoring(self) -> bool:
        """Whether the running load restores the last good version."""
        return self.loading and self.attempt in ("moment", "version")

    @property
    def good_source(self) -> dict[str, str] | None:
        """Source of the version to restore; None if there is none."""
        return self.good[-1].source if self.good else None

    @property
    def file_waits(self) -> bool:
        """Whether no worker has begun to load the last saved text of the file."""
        return self.asked > self.begun

    def next_load(self, newest: Newest) -> tuple[Recovery, LoadInputs | None]:
        """The load for a new worker; None if it has to load nothing."""
        if self.attempt == "nothing":
            return self, None
        good = self.good_source if self.attempt != "file" else None
        snapshot = newest() if self.attempt in ("file", "moment") else None
        number = self.asked if good is None else 0
        return replace(self, loading=True), LoadInputs(good or None, snapshot, number)

    def file_requested(self, newest: Newest) -> tuple[Recovery, LoadInputs]:
        """The load of the file on disk for the present worker."""
        asked = self.asked + 1
        inputs = LoadInputs(None, None if self.has_env else newest(), asked)
        return replace(self, attempt="file", loading=True, asked=asked), inputs

    def began(self, number: int) -> Recovery:
        """Record that a worker has begun the load of this number."""
        return replace(self, begun=max(self.begun, number))

    def loaded(self, task: TaskDescription, now: float) -> Recovery:
        """Record that `task` runs: it is the last good version from now on."""
        good = self.good
        if good and good[-1].file != task.file:
            good = ()  # no version of another file is restored
        if good and good[-1].source == task.source:
            good = (*good[:-1], replace(good[-1], since=now))
        else:
            good = (*good, GoodVersion(task.file, task.source, now))[-_GOOD_VERSIONS:]
        return replace(self, good=good, has_env=True, attempt="file", loading=self.file_waits)

    def stepped(self) -> Recovery:
        """Record that a requested step was made."""
        if not self.good or not self.good[-1].idle_crashes:
            return self
        return replace(self, good=(*self.good[:-1], replace(self.good[-1], idle_crashes=0)))

    def failed(self, kept: bool, newest: Newest) -> tuple[Recovery, bool]:
        """Record that a load failed in a worker that continues. Also returns whether to call `next_load`:
        True if the worker has no version now and an attempt is left."""
        after = replace(self, loading=self.file_waits)
        if kept or not self.loading or self.file_waits:
            return after, False
        after = after._step_down(newest)
        return after, after.attempt != "nothing"

    def died(self, crashed: bool, idle: bool, now: float, newest: Newest) -> Recovery:
        """Record that the worker has ended.

        Args:
            crashed: the worker ended by itself: it was not killed by the supervisor, and did not hand over.
            idle: the worker was handling no request.
        """
        after = self
        if self.file_waits:
            after = replace(self, attempt="file")
        elif self.loading:
            after = self._step_down(newest)
        elif self.attempt != "nothing":
            after = self._after_running(crashed, idle, now)
        return replace(after, loading=False, has_env=False)

    def restart_requested(self) -> Recovery:
        """Record that the user restarts the worker. The next worker loads the file as it is now. If the file
        is being loaded already (and may hang), the next worker restores the last good version."""
        good = tuple(replace(version, crashes=0, idle_crashes=0) for version in self.good)
        if self.loading and not self.restoring and not self.file_waits and good:
            return replace(self, good=good)  # `died` then chooses the last good version
        return replace(self, good=good, attempt="file", loading=False, has_env=False, asked=self.asked + 1)

    def _after_running(self, crashed: bool, idle: bool, now: float) -> Recovery:
        if not self.good:
            return replace(self, attempt="nothing")
        after, version = replace(self, attempt="moment"), self.good[-1]
        if not crashed:
            return after
        proven = now - version.since > PROVEN_SECONDS
        version = replace(
            version,
            crashes=0 if proven else version.crashes + 1,
            idle_crashes=0 if proven else version.idle_crashes + idle,
        )
        if version.crashes > 1 and len(self.good) > 1:
            return replace(after, good=self.good[:-1])
        attempt: Attempt = "nothing" if version.idle_crashes > 1 else "moment"
        return replace(after, good=(*self.good[:-1], version), attempt=attempt)

    def _step_down(self, newest: Newest) -> Recovery:
        if not self.good:
            return replace(self, attempt="nothing")
        if self.attempt == "file":
            return replace(self, attempt="moment" if newest() is not None else "version")
        if self.attempt == "moment" and newest() is not None:
            return replace(self, attempt="version")
        return replace(self, attempt="nothing")
