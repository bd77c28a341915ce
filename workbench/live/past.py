"""The past of the run: the shown moment of the history, and requests to go back to it."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from workbench.envs.camera_data import CameraKind, Picture
from workbench.live.history.curves import REWARD, Column
from workbench.live.history.env_table import EnvEvent, EnvRows, event_step
from workbench.live.history.moments import FAIL, SUCCESS, TRUNCATED, EpisodeNumbers, History, Moment
from workbench.live.messages import CameraRequest, DrawPast, Restore
from workbench.task.description import ShownPictures, Stepped

Scope = Literal["this", "all", "into all"]
"""Envs that go back: the selected one; all, each to its own state; or all to the selected env's state."""
MAX_REPLAYED_STEPS = 400
"""Maximum number of control steps that are replayed to go back to a moment."""


@dataclass(frozen=True)
class TimelineView:
    """State of the time slider. Moments have serials, which count up and are never reused; resets are moments
    too. The page shows ticks: a tick is the number of control steps since the envs were built."""

    first: int = 0
    last: int = -1
    """Serials of the oldest and the newest kept moment; the newest is the live one."""
    shown: int | None = None
    """The shown moment; None while live."""
    first_tick: int = 0
    tick: int = 0
    last_tick: int = 0
    """Ticks of the first, the shown and the live moment."""
    used: int = 0
    limit: int = 0
    """Memory in use and its limit, in bytes."""
    moments: int = 0
    can_continue: bool = False
    """Whether envs can go back to the shown moment."""
    undo: str | None = None
    """Name of the change that `UndoReset` would undo; None if there is none."""
    not_carried: tuple[str, ...] = ()
    """Parts of the state that the last jump could not restore, each with the reason."""
    arrived: str = ""
    """How the last jump reached its state: by a replay or from a recording; empty if the state was
    restored."""
    entered: int = 0
    """Number of the last finished `EnterRecording`; 0 for none."""
    wants_pictures: bool = False
    """Whether the shown moment lacks pictures of the watched cameras."""

    @property
    def steps(self) -> int:
        """Control steps that are kept."""
        return self.last_tick - self.first_tick

    @property
    def steps_ago(self) -> int:
        """Control steps since the shown moment."""
        return self.last_tick - self.tick


Ending = Literal["", "success", "fail", "limit"]


def _ending(flags: Iterable[int]) -> Ending:
    """How a segment with these events, in order, ended; empty if it still runs or was cut short by a reset. Like the
    table of envs: the first end counts, and at one step success counts before fail."""
    for one in flags:
        if one & SUCCESS:
            return "success"
        if one & FAIL:
            return "fail"
        if one & TRUNCATED:
            return "limit"
    return ""


@dataclass(frozen=True)
class Strip:
    """A part of one env's history, for the strip under the slider. Positions are ticks (`TimelineView`)."""

    low: int
    high: int
    """Lowest and highest tick, both included."""
    events: tuple[tuple[int, int], ...]
    """Tick and event flags (`moments.RESET` ...); the flags of all events at a tick are combined."""
    values: NDArray[np.float32]
    """(high - low + 1,) number after each control step, by default the reward; NaN where there is none."""
    branches: tuple[tuple[int, int], ...]
    """Ticks at which the env went back, each with the tick that it went back to."""
    segments: tuple[tuple[int, int, bool, Ending], ...]
    """First and last tick of each segment (see `History`), whether it starts with a jump back, and how it ended."""


@dataclass(frozen=True)
class Past:
    """The history of the present task and its shown moment. Methods that change something return a new
    `Past`.

    Live is the newest moment. The slider pins another moment; then everything that the page draws of the
    batch (poses, numbers, pictures) comes from the server's memory, while the worker continues. The worker
    gets requests only to continue from a moment, to undo a jump, and to draw a moment that has no pictures.
    """

    history: History
    """Append-only store, changed in place by `added` and similar methods, and shared by all `Past` values of a task."""
    pinned: int | None = None
    """Serial of the shown moment; None while live."""
    entered: int = 0
    """See `TimelineView.entered`."""
    requested: tuple[int, int, tuple[CameraRequest, ...]] | None = None
    """Serial, env and cameras of the last request for pictures."""

    # --- events --------------------------------------------------------------------------------------

    def added(self, stepped: Stepped, limited: bool = True) -> tuple[Past, Moment]:
        """Add a moment. Returns the new past, and the moment.

        Args:
            limited: whether the time limit ends the episodes.
        """
        moment = self.history.add(stepped, limited)
        past = self
        if stepped.restored is not None and stepped.restored.number:
            past = replace(past, entered=stepped.restored.number)
        if past.pinned is not None and past.pinned < self.history.first:
            past = replace(past, pinned=self.history.first)  # the shown moment was dropped
        return past, moment

    def camera_moved(self, kind: CameraKind, name: str) -> Past:
        """See `History.camera_moved`; pictures of the shown moment are requested again."""
        self.history.camera_moved(kind, name)
        return replace(self, requested=None)

    # --- the shown moment ----------------------------------------------------------------------------

    @property
    def shown(self) -> Moment | None:
        """The pinned moment; None while live."""
        return None if self.pinned is None else self.history.at(self.pinned)

    @property
    def at(self) -> int:
        """Serial of the shown moment, the newest while live."""
        return self.history.last if self.pinned is None else self.pinned

    def seek(self, serial: int | None) -> Past:
        """Pin the moment of this serial, or the nearest kept moment. Go live if `serial` is None or the
        newest."""
        if serial is None or serial >= self.history.last:
            return replace(self, pinned=None)
        return replace(self, pinned=max(serial, self.history.first))

    def seek_by(self, env: int, steps: int) -> Past:
        """Go forward (or back, if negative) from the shown moment by moments of this env: control steps,
        resets and jumps back. Moments at which only other envs jumped are skipped."""
        history, at = self.history, self.at
        for _ in range(abs(steps)):
            at += 1 if steps > 0 else -1
            while (moment := history.at(at)) is not None and moment.jumped.any() and not moment.jumped[env]:
                at += 1 if steps > 0 else -1
        return self.seek(at)

    def seek_step(self, env: int, step: int) -> Past:
        """Go to a control step of this env's shown episode, or to the nearest kept one; jumps back do not end an episode."""
        episode_backwards = self.history.episode_backwards(env, self.history.segment_at(env, self.at)[1])
        serials = {int(moment.step.elapsed_steps[of]): moment.serial for moment, of in episode_backwards}
        if not serials:
            return self
        return self.seek(serials[min(serials, key=lambda known: abs(known - step))])

    def seek_env_event(self, env: int, event: EnvEvent) -> Past:
        """Go to this env's newest event of this kind: the end of an episode that failed, or the first outlier
        of an episode. Stay at the shown moment if no such event is kept."""
        for _, stop in reversed(self.history.segments(env)):
            moment = self.history.at(stop)
            step = None if moment is None else event_step(moment.rows, env, event)
            if step is not None:
                return self.seek(stop).seek_step(env, step)
        return self

    def seek_tick(self, tick: int, episode_of: int | None = None) -> Past:
        """Go to the moment after a control step (`Moment.tick`), or to the nearest kept one.

        Args:
            episode_of: stay within the shown episode of this env. The last step of the previous episode has the same tick as
                the start of this one.
        """
        first = self.history.first if episode_of is None else self.episode(episode_of)[0]
        return self.seek(max(self.history.serial_of_tick(tick), first))

    def seek_event(self, env: int, direction: int) -> Past:
        """Go to the next (1) or previous (-1) event of this env. Without a next event, go live; without a
        previous event, go to the oldest moment."""
        here = self.at
        if direction > 0:
            after = self.history.events(env, here + 1, self.history.last)
            return self.seek(after[0][0] if after else None)
        before = self.history.events(env, self.history.first, here - 1)
        return self.seek(before[-1][0] if before else self.history.first)

    def pictures(self, env: int) -> dict[tuple[CameraKind, str], Picture]:
        """Stored pictures of this env at the shown moment."""
        moment = self.shown
        if moment is None:
            return {}
        return {(kind, name): p for (of, kind, name), p in moment.pictures.items() if of == env}

    def view(
        self, env: int, cameras: tuple[CameraRequest, ...], degree: ShownPictures = "auto"
    ) -> TimelineView:
        history, moment = self.history, self.shown
        at = moment if moment is not None else history.at(history.last)
        jump = history.last_jump(env)
        begin = history.at(history.segment_at(env, self.at)[0]) if at is not None else None
        # Report only the jump that led this env to the shown moment: after a later reset, nothing is missing.
        jumped_to = begin.restored if begin is not None and begin.jumped[env] else None
        missed, how = ({}, "") if jumped_to is None else (jumped_to.not_carried, jumped_to.how)
        return TimelineView(
            first=history.first,
            last=history.last,
            shown=self.pinned,
            first_tick=self.tick_of(history.first),
            tick=0 if at is None else at.tick,
            last_tick=self.tick_of(history.last),
            used=history.used,
            limit=history.limit,
            moments=len(history),
            can_continue=moment is not None and moment.snapshot is not None,
            undo=None if jump is None else self._jump_text(jump),
            not_carried=tuple(f"{what}: {why}" for what, why in missed.items()),
            arrived=how,
            entered=self.entered,
            wants_pictures=moment is not None and bool(self._lacking(moment, env, cameras, degree)),
        )

    def env_rows(self) -> EnvRows:
        """The table of envs at the shown moment."""
        moment = self.shown
        return self.history.env_rows() if moment is None else self.history.rows_at(moment)

    def _jump_text(self, jump: Moment) -> str:
        envs, before = self.history.envs_still_at(jump), self.history.at(jump.serial - 1)
        if jump.restored is None and before is not None:
            ended = before.step.terminated | before.step.truncated
            if ended[jump.jumped].all():
                return "reset at the end"  # the reset was automatic
        what = "reset" if jump.restored is None else "jump"
        if jump.restored is not None and jump.restored.recording:
            what = "going live"
        if jump.restored is not None and jump.restored.moved:
            what = f"move of {jump.restored.moved}"
        if self.history.num_envs == 1:
            return what
        if len(envs) == self.history.num_envs:
            return f"{what} of all"
        return f"{what} of env {envs[0]}" if len(envs) == 1 else f"{what} of {len(envs)} envs"

    def tick_of(self, serial: int) -> int:
        """Tick of a kept moment; 0 if the moment is not kept."""
        moment = self.history.at(serial)
        return 0 if moment is None else moment.tick

    def strip(self, env: int, low: int, high: int, column: Column = REWARD) -> Strip:
        """The history of one env between two ticks, inclusive.

        Args:
            column: the number that is shown.
        """
        history = self.history
        ticks = history.ticks(history.first, history.last)
        low = min(max(low, int(ticks[0])), int(ticks[-1]))
        high = min(max(high, low), int(ticks[-1]))
        # The first moment at a tick is the control step; later moments at the tick are resets and jumps.
        first, end = int(np.searchsorted(ticks, low)), int(np.searchsorted(ticks, high, side="right"))
        here = slice(first, end)
        serials, base = (history.first + first, history.first + end - 1), history.first
        values = np.full(high - low + 1, np.nan, np.float32)
        stepped = np.diff(ticks, prepend=ticks[0] - 1)[here] > 0
        values[ticks[here][stepped] - low] = history.numbers(env, *serials, column)[stepped]
        events: dict[int, int] = {}
        happened = history.events(env, *serials)
        at = [serial for serial, _ in happened]
        for serial, flags in happened:
            tick = int(ticks[serial - base])
            events[tick] = events.get(tick, 0) | flags

        def tick_of(serial: int) -> int:
            return int(ticks[max(serial - base, 0)])

        jumps = dict(history.jumps_back(env))
        return Strip(
            low,
            high,
            tuple(events.items()),
            values,
            tuple(
                (tick_of(at), tick_of(origin)) for at, origin in jumps.items() if low <= tick_of(at) <= high
            ),
            tuple(
                (
                    max(begin, low),
                    min(last, high),
                    start in jumps,
                    _ending(flags for _, flags in happened[bisect_left(at, start) : bisect_right(at, stop)]),
                )
                for start, stop in history.segments(env)
                for begin, last in [(tick_of(start), tick_of(stop))]
                if last >= low and begin <= high
            ),
        )

    def episodes(
        self, env: int, last: int, columns: Sequence[Column], before: int
    ) -> tuple[EpisodeNumbers, ...]:
        """Numbers of this env's whole shown episode, and of the episodes before it; see `History.episodes`.

        Args:
            last: serial of the newest moment in the caller's view; the history may have newer ones by now.
        """
        end = last if self.pinned is None else min(self.history.segment_at(env, self.at)[1], last)
        return self.history.episodes(env, end, columns, before)

    def episode(self, env: int) -> tuple[int, int]:
        """Serials of the first and the last moment of this env's episode that contains the shown moment. The
        range includes moments that the env left when it went back."""
        end = self.history.segment_at(env, self.at)[1]
        begin = min((moment.serial for moment, _ in self.history.episode_backwards(env, end)), default=end)
        return begin, end

    # --- requests to the worker ------------------------------------------------------------------------

    def continue_from_shown(self, env: int, scope: Scope) -> Restore | None:
        """Request to continue from the shown moment; None if that is not possible."""
        moment = self.shown
        snapshot = None if moment is None else self.history.snapshot_at(moment.serial)
        if moment is None or snapshot is None:
            return None
        envs = (env,) if scope == "this" else tuple(range(self.history.num_envs))
        source = (env,) * len(envs) if scope == "into all" else envs
        return self._restore(snapshot, envs, source, moment.serial)

    def undo(self, env: int) -> Restore | None:
        """Request to undo this env's last jump in all envs that have not jumped since; None if impossible."""
        jump = self.history.last_jump(env)
        if jump is None:
            return None
        snapshot = self.history.snapshot_at(jump.serial - 1)
        if snapshot is None:
            return None
        envs = self.history.envs_still_at(jump)
        return self._restore(snapshot, envs, envs, jump.serial - 1, undoes=jump.serial)

    def _restore(
        self,
        snapshot: bytes,
        envs: tuple[int, ...],
        source: tuple[int, ...],
        origin: int,
        undoes: int | None = None,
    ) -> Restore:
        history = self.history
        found = {
            i: history.replay_path(of, origin, MAX_REPLAYED_STEPS) for i, of in zip(envs, source, strict=True)
        }
        paths = {i: path for i, path in found.items() if path is not None}
        beginnings = {path.start for path in paths.values()}
        starts = {at: taken for at in beginnings if (taken := history.snapshot_at(at)) is not None}
        return Restore(snapshot, envs, source, origin, undoes, paths, starts)

    def draw(
        self, env: int, cameras: tuple[CameraRequest, ...], degree: ShownPictures = "auto"
    ) -> tuple[Past, DrawPast | None]:
        """Request the missing pictures of the shown moment, unless the last request was for the same moment,
        env and cameras.

        A fast picture, drawn while something moved, counts as missing unless fast pictures are requested.
        """
        moment = self.shown
        if moment is None:
            return self, None
        lacking = self._lacking(moment, env, cameras, degree)
        requested = (moment.serial, env, lacking)
        if not lacking or requested == self.requested:
            return self, None
        return replace(self, requested=requested), DrawPast(
            moment.step.poses[env].copy(), env, lacking, moment.serial
        )

    def _lacking(
        self, moment: Moment, env: int, cameras: tuple[CameraRequest, ...], degree: ShownPictures
    ) -> tuple[CameraRequest, ...]:
        def lacks(camera: CameraRequest) -> bool:
            key = (env, camera.kind, camera.name)
            picture = moment.pictures.get(key)
            return (
                picture is None
                or key in moment.outdated
                or (picture.degree == "fast" and degree != "fast")
                or any(getattr(picture, m) is None for m in camera.modalities)
            )

        return tuple(camera for camera in cameras if lacks(camera))
