"""The history: the moments since the env was built, within a memory limit."""

from __future__ import annotations

import pickle
import sys
from bisect import bisect_left
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from typing import TypeGuard

import numpy as np
from numpy.typing import NDArray

from workbench.envs.camera_data import CameraKind, Picture
from workbench.envs.gpu_rules import Finding
from workbench.envs.outliers import OutlierKind
from workbench.envs.snapshots.packing import WholeSnapshot
from workbench.envs.step_result import TERM_PREFIX, StepResult
from workbench.live.history.curves import REWARD, Column, Columns, number_of
from workbench.live.history.env_table import KEPT_REWARDS, EnvRows, EnvTable, Outcome
from workbench.live.messages import PastPictures, Pictures, ReplayPath
from workbench.task.description import NO_MOMENT, Pulled, Restored, Stepped

RESET, WENT_BACK, SUCCESS, FAIL, TRUNCATED, REWARD_NONFINITE, BY_HAND = 1, 2, 4, 8, 16, 32, 64
"""Event flags of an env at a moment. Success, fail and a NaN or infinite reward are flagged only once per episode,
a pull by hand at its first step."""
_OVERHEAD_BYTES = 2500
"""Memory of the objects around a moment's arrays; with it, the counted total agrees with tracemalloc
within 2 %."""
_PICTURES_SHARE = 0.5
"""Share of the memory limit for pictures: they are by far the largest part, and can be rendered again. A
picture of a human camera has 0.8 MB; a step without pictures has 21 KB for 16 PickCube envs, and 72 KB for
64."""
_MAX_ENDED = 64
"""Maximum number of ended episodes whose numbers are cached for curves."""
_RECENT_MOMENTS = 200
"""Number of newest moments to search for the one that a picture shows: pictures arrive some steps late."""


@dataclass
class SnapshotPartSet:
    """The parts of a snapshot, shared by all moments with the same parts."""

    keys: tuple[int, ...]
    content: tuple[bytes, ...] | None
    """Bytes of the parts; None if some of them were sent to another history; the moments then
    have no snapshot."""
    moments: int = 0
    """Number of moments with these parts."""


class SnapshotParts:
    """Reference-counted store of snapshot parts.

    A snapshot has a body and parts (`envs.snapshots.packing`), and shares most parts with the previous
    snapshot. Each moment refers to a set of parts. The store counts the moments that use each set, and the
    sets that use each part.
    """

    def __init__(self) -> None:
        self._parts: dict[int, bytes] = {}
        self._references: dict[int, int] = {}
        self._last = SnapshotPartSet((), ())
        self.used = 0
        """Bytes in use."""

    def take(self, keys: tuple[int, ...] | None, new_parts: Mapping[int, bytes]) -> SnapshotPartSet:
        """Parts of the next moment; `keys` is None if it has the same parts as the previous moment."""
        self._parts.update(new_parts)
        if keys is not None and keys != self._last.keys:
            known = self._parts.keys() >= {*keys}
            self._last = SnapshotPartSet(keys, tuple(self._parts[key] for key in keys) if known else None)
        parts = self._last
        if parts.content is not None and parts.moments == 0:
            for key in parts.keys:
                self._references[key] = self._references.get(key, 0) + 1
                if self._references[key] == 1:
                    self.used += len(self._parts[key])
        parts.moments += 1
        return parts

    def release(self, parts: SnapshotPartSet) -> None:
        """Release these parts, because a moment that had them was dropped."""
        parts.moments -= 1
        if parts.moments == 0 and parts.content is not None:
            for key in parts.keys:
                self._references[key] -= 1
                if self._references[key] == 0:
                    self.used -= len(self._parts[key])
                    del self._references[key]
                    # If a later moment has this part, the worker sends it again: the worker leaves out only
                    # parts of the newest moment, which is never dropped.
                    del self._parts[key]


@dataclass
class Moment:
    """The batch after one reset, control step or jump back."""

    serial: int
    """Number of the moment, counting up over the session."""
    step: StepResult
    """Result of the step. The reward is NaN in an env that was reset here. In an env that went back to a
    moment, it is the reward of that moment."""
    jumped: NDArray[np.bool_]
    """(N,) mask as in `Stepped.reset_mask`."""
    seeds: NDArray[np.int64] | None
    tick: int
    """Number of control steps up to this moment, of the whole batch."""
    event_flags: NDArray[np.uint8]
    """(N,) event flags (`RESET` ...), combined."""
    restored: Restored | None
    number: int
    """`Stepped.number`."""
    snapshot: WholeSnapshot | None
    """Snapshot of the whole batch, or None; shares its bytes with other moments."""
    parts: SnapshotPartSet
    size: int
    """Size in bytes, without snapshot parts and pictures."""
    rows: EnvRows
    """The table of envs at that moment."""
    acted_by: str
    """Source of the action, as in `Stepped.acted_by`."""
    pulled: Pulled | None = None
    """The pull by hand, as in `Stepped.pulled`."""
    pictures: dict[tuple[int, CameraKind, str], Picture] = field(default_factory=dict)
    """Pictures by env, kind and name of the camera."""
    outdated: set[tuple[int, CameraKind, str]] = field(default_factory=set)
    """Keys of pictures whose camera was moved since."""
    original_step: StepResult | None = None
    """The original `step`, if a newer version replaced it; else None."""

    @property
    def as_recorded(self) -> StepResult:
        """The step result of the version that made this moment."""
        return self.step if self.original_step is None else self.original_step


EnvMoment = tuple[Moment, int]
"""A moment of an env's episode, and the row of this episode in the moment's arrays. If the env continued from
another env's moment, this is the other env's row in that moment and in earlier ones."""


@dataclass(frozen=True, eq=False)
class EpisodeNumbers:
    """Numbers of one env's episode, up to some moment."""

    steps: NDArray[np.int64]
    """(T,) control steps of the episode, as far as they are kept."""
    values: dict[Column, NDArray[np.float32]]
    """(T,) numbers after each of these steps."""
    before: int | None
    """Serial of the moment before the reset with which the episode began; None if that moment is not kept."""


@dataclass(frozen=True)
class ShownMoment:
    """The moment that the page shows."""

    env: int
    """The selected env."""
    num_envs: int
    poses: NDArray[np.float32] | None
    """(N, B, 7) poses of a past moment; None while live."""

    def of(self, env: int) -> NDArray[np.float32] | None:
        """(B, 7) poses of one env; None while live."""
        return None if self.poses is None else self.poses[env]


class History:
    """The moments of one built task, oldest first, append-only. Not thread-safe: used on the loop.

    A *jump* of an env is a reset or a return to an earlier moment (a jump back); it is a separate moment. The
    moments before a jump are kept, and the env can go back to them; undo goes back to the last of them.
    A *segment* reaches from one jump of an env to its next jump: it starts from a snapshot and has all
    actions, so it can be replayed. An *episode* starts at a reset and continues through jumps back.

    Memory is bounded. First, the oldest pictures are dropped, until pictures use at most half of the limit;
    then the oldest moments are dropped.
    """

    def __init__(
        self, table: EnvTable, limit: int, first_serial: int = 0, joints: Sequence[str] = ()
    ) -> None:
        """
        Args:
            table: a table of envs that has no events yet.
            limit: memory limit in bytes; the newest moment is always kept.
            first_serial: serial of the first moment.
            joints: names of the joints of `StepResult.qpos`.
        """
        self._table, num_envs = table, table.rows().num_envs
        self.num_envs = num_envs
        self.limit = limit
        self._moments: deque[Moment] = deque()
        self._next_serial = first_serial
        self._parts = SnapshotParts()
        self._used = 0
        self._pictures_used = 0
        self._pictured: deque[int] = deque()
        self._jumps: deque[Moment] = deque()
        self._columns = Columns(num_envs, first_serial)
        self._ticks = Columns(1, first_serial)
        self._joints = tuple(joints)
        self._ended: dict[tuple[int, int], EpisodeNumbers] = {}
        """Numbers of ended episodes, by env and serial of the last moment."""
        self.count = 0
        """Control steps so far."""

    # --- events ------------------------------------------------------------------------------------

    def add(self, stepped: Stepped, limited: bool = True) -> Moment:
        """Add a moment.

        Without an action (a reset or a jump back) the worker sends reward zero and no reward terms. Other
        values are stored instead: NaN for envs that were reset, those of the origin for envs that went back,
        and those of the previous moment for all other envs.

        Args:
            limited: whether the time limit ends the episodes.
        """
        restored, jumps = stepped.restored, bool(stepped.reset_mask.any())
        origin = None if restored is None else self.at(restored.origin)
        parts = self._parts.take(stepped.part_keys, stepped.new_parts)
        stepped = replace(stepped, step=self._with_rewards(stepped, origin))
        rows = self._table.add(
            stepped,
            None if origin is None else origin.rows,
            lambda env: self._rewards_until(env, origin, KEPT_REWARDS),
            limited,
        )
        self.count += not jumps
        snapshot = None
        if stepped.snapshot and parts.content is not None:
            snapshot = WholeSnapshot(stepped.snapshot, parts.content)
        size = _OVERHEAD_BYTES + len(stepped.snapshot) + stepped.step.nbytes
        size += EnvRows.bytes_a_step(self.num_envs)
        moment = Moment(
            serial=self._next_serial,
            step=stepped.step,
            jumped=stepped.reset_mask,
            seeds=stepped.seeds,
            tick=self.count,
            event_flags=self._events(stepped, rows, limited),
            restored=restored,
            number=stepped.number,
            snapshot=snapshot,
            parts=parts,
            size=size,
            rows=rows,
            acted_by=sys.intern(stepped.acted_by),
            pulled=stepped.pulled,
        )
        self._write(moment)
        self._next_serial += 1
        self._moments.append(moment)
        if jumps:
            self._jumps.append(moment)
        self._used += size
        self._shrink()
        return moment

    def replace_last(self, step: StepResult) -> StepResult:
        """Replace the newest moment's result by that of a patched version.

        Returns:
            The new result; a moment without an action keeps its reward.
        """
        if not self._moments:
            return step
        moment = self._moments[-1]
        if moment.original_step is None:
            moment.original_step = moment.step
            moment.size += step.nbytes
            self._used += step.nbytes
        moment.step = step if step.action is not None else replace(step, reward=moment.step.reward)
        self._write(moment)
        return moment.step

    def add_pictures(self, event: Pictures | PastPictures) -> None:
        """Store pictures with their moment, if it is still kept."""
        if isinstance(event, PastPictures):
            moment = self.at(event.origin)
        else:
            recent = islice(reversed(self._moments), _RECENT_MOMENTS)
            moment = next((one for one in recent if one.number == event.number), None)
        if moment is None:
            return
        for picture in event.pictures:
            key = (picture.env, picture.kind, picture.camera)
            before = moment.pictures.get(key)
            if before is None:
                self._pictured.append(moment.serial)
            moment.pictures[key] = picture
            moment.outdated.discard(key)
            change = picture.nbytes - (0 if before is None else before.nbytes)
            self._pictures_used += change
            self._used += change
        self._shrink()

    def camera_moved(self, kind: CameraKind, name: str) -> None:
        """Mark the stored pictures of this camera as outdated."""
        for serial in self._pictured:
            moment = self.at(serial)
            if moment is not None:
                moment.outdated.update(key for key in moment.pictures if key[1:] == (kind, name))

    # --- reading -----------------------------------------------------------------------------------

    def __len__(self) -> int:
        return len(self._moments)

    @property
    def used(self) -> int:
        """Bytes in use."""
        return self._used + self._parts.used

    @property
    def first(self) -> int:
        """Serial of the oldest moment; one past `last` if there is none."""
        return self._next_serial - len(self._moments)

    @property
    def last(self) -> int:
        """Serial of the newest moment."""
        return self._next_serial - 1

    def at(self, serial: int) -> Moment | None:
        """The moment of this serial, if it is kept."""
        return self._moments[serial - self.first] if self.first <= serial <= self.last else None

    def serial_of_tick(self, tick: int) -> int:
        """Serial of the moment after this control step (`Moment.tick`), or of the nearest kept one."""
        serials = range(self.first, self.last + 1)
        found = bisect_left(serials, tick, key=lambda serial: self._moments[serial - self.first].tick)
        return serials[min(found, len(serials) - 1)] if serials else self.last

    def ticks(self, low: int, high: int) -> NDArray[np.int64]:
        """(K,) `Moment.tick` of the moments `low` to `high` inclusive, which must be kept."""
        return self._ticks.between("tick", low, high)[:, 0].astype(np.int64)

    def snapshot_at(self, serial: int) -> bytes | None:
        """A pickled `envs.snapshots.snapshot.Snapshot` of the whole batch at that moment, or None."""
        moment = self.at(serial)
        return None if moment is None or moment.snapshot is None else pickle.dumps(moment.snapshot)

    def between(self, low: int, high: int) -> Iterable[Moment]:
        """The kept moments of these serials, both included."""
        start = self.first
        return (self._moments[k - start] for k in range(max(low, start), min(high, self.last) + 1))

    def env_rows(self) -> EnvRows:
        """The present table of envs."""
        return self._table.rows()

    def rows_at(self, moment: Moment) -> EnvRows:
        """The table of envs at a moment, with the rewards that `Moment.rows` lacks."""
        rewards = np.full((self.num_envs, KEPT_REWARDS), np.nan, np.float32)
        for env in range(self.num_envs):
            known = self._rewards_until(env, moment, KEPT_REWARDS)
            rewards[env, KEPT_REWARDS - len(known) :] = known
        return replace(moment.rows, rewards=rewards)

    @property
    def findings(self) -> tuple[Finding, ...]:
        """See `EnvTable.findings`."""
        return self._table.findings

    def begin_version(self, rules: Mapping[str, Finding]) -> None:
        """See `EnvTable.begin_version`."""
        self._table.begin_version(rules)

    def events(self, env: int, low: int, high: int) -> list[tuple[int, int]]:
        """Events of this env between two moments, both included: serials and combined flags (`RESET` ...)."""
        low = max(low, self.first)
        event_flags = self._columns.between("event_flags", low, min(high, self.last))[:, env]
        return [(low + int(k), int(event_flags[k])) for k in np.flatnonzero(event_flags)]

    def numbers(self, env: int, low: int, high: int, column: Column = REWARD) -> NDArray[np.float32]:
        """(K,) numbers of this env in a column, between two moments, both included; at a reset, the reward is
        NaN."""
        low, high = max(low, self.first), min(high, self.last)
        if column == REWARD:
            return self._columns.between("reward", low, high)[:, env]
        found = (number_of(moment.step, column, env, self._joints) for moment in self.between(low, high))
        return np.fromiter(found, np.float32)

    def episodes(
        self, env: int, serial: int, columns: Sequence[Column], before: int
    ) -> tuple[EpisodeNumbers, ...]:
        """Numbers of this env's episode up to a moment, and of at most `before` episodes before it; newest
        first. Earlier episodes without a control step are left out."""
        found = [self._episode_numbers(env, serial, columns)]
        last = found[0].before
        while last is not None and len(found) <= before:
            key = env, last
            known = self._ended.pop(key, None)
            if known is None or not known.values.keys() >= {*columns}:
                known = self._episode_numbers(env, last, columns)
            # The episodes that were requested last stay in the cache.
            self._ended[key] = known
            if len(known.steps):
                found.append(known)
            last = known.before
        while len(self._ended) > _MAX_ENDED:
            del self._ended[next(iter(self._ended))]
        return tuple(found)

    def _episode_numbers(self, env: int, serial: int, columns: Sequence[Column]) -> EpisodeNumbers:
        moments = [*self.episode_backwards(env, serial)][::-1]
        steps = [one for one in moments if not one[0].jumped.any()]
        values = {
            column: np.array(
                [number_of(moment.step, column, of, self._joints) for moment, of in steps], np.float32
            )
            for column in columns
        }
        first = moments[0][0] if moments else None
        begins = first is not None and first.jumped.any() and self.first < first.serial
        return EpisodeNumbers(
            np.array([moment.step.elapsed_steps[of] for moment, of in steps], np.int64),
            values,
            first.serial - 1 if first is not None and begins else None,
        )

    def jumps_back(self, env: int) -> list[tuple[int, int]]:
        """Serials of the moments at which this env went back, each with the serial that it went back to."""
        return [
            (moment.serial, moment.restored.origin)
            for moment in self._jumps
            if _went_back(moment.restored) and moment.jumped[env]
        ]

    def segments(self, env: int) -> list[tuple[int, int]]:
        """First and last serials of this env's segments, as far as they are kept; oldest first. A segment also contains
        moments at which only other envs jumped."""
        if not self._moments:
            return []
        jumps = [moment.serial for moment in self._jumps if moment.jumped[env] and moment.serial > self.first]
        return list(zip([self.first, *jumps], [*(jump - 1 for jump in jumps), self.last], strict=True))

    def segment_at(self, env: int, serial: int) -> tuple[int, int]:
        """The segment of this env that contains this moment."""
        return next(segment for segment in reversed(self.segments(env)) if segment[0] <= serial)

    def episode(self, env: int, serial: int, most: int | None = None) -> tuple[EnvMoment, ...]:
        """The whole episode of this env that contains a moment; oldest first, see `episode_backwards`.

        Args:
            most: maximum number of moments, evenly spread, including the first and the last; None for all.
        """
        episode_backwards = [*self.episode_backwards(env, self.segment_at(env, serial)[1])][::-1]
        count = len(episode_backwards) if most is None else min(most, len(episode_backwards))
        chosen = np.unique(np.linspace(0, len(episode_backwards) - 1, count).round().astype(int))
        return tuple(episode_backwards[k] for k in chosen)

    def episode_backwards(self, env: int, serial: int) -> Iterator[EnvMoment]:
        """The episode of this env up to a moment, newest first. At a jump back, it continues with the
        jump's origin.

        Yields each control step, and finally the reset that began the episode, as far as they are kept.
        """
        for moment, at in self._moments_back(env, serial):
            jumped = moment.jumped.any()
            if not jumped or moment.restored is None:
                yield moment, at
            if jumped and moment.restored is None:
                return

    def by_hand(self, moment: Moment, env: int) -> bool:
        """Whether a person moved or pulled a body in this env's episode up to a moment."""
        for earlier, at in self._moments_back(env, moment.serial):
            if earlier.event_flags[at] & BY_HAND:
                return True
            if earlier.jumped.any() and earlier.restored is None:
                break
        return False

    def replay_path(self, env: int, serial: int, most: int) -> ReplayPath | None:
        """Replay path of this env from the last exact point to a moment; None if unknown or longer than `most` steps.

        Exact points are resets and restored moments: from them on the same actions give the same bits.
        """
        rows: list[NDArray[np.float32]] = []
        for moment, at in self._moments_back(env, serial):
            jump = moment.restored
            if not moment.jumped.any():
                by_hand = moment.pulled is not None and moment.pulled.env == at
                if moment.step.action is None or by_hand or len(rows) == most:
                    return None
                rows.append(moment.step.action[at])
            elif jump is None or (at not in jump.replayed and jump.origin != NO_MOMENT):
                if moment.snapshot is None or not rows:
                    return None
                return ReplayPath(moment.serial, at, np.stack(rows[::-1]).astype(np.float32))
        return None

    def _moments_back(self, env: int, serial: int) -> Iterator[EnvMoment]:
        """The kept moments that led this env to `serial`, newest first: its control steps and its own jumps.
        A jump back is followed by its origin (the moment to which the env went back), and by the moments
        that led there."""
        while (moment := self.at(serial)) is not None:
            jump, serial = moment.restored, moment.serial - 1
            if not moment.jumped.any():
                yield moment, env
            elif moment.jumped[env]:
                yield moment, env
                if jump is not None:
                    serial, env = jump.origin, jump.source[jump.env_idx.index(env)]

    def last_jump(self, env: int) -> Moment | None:
        """The jump that led this env to its present state, if it can be undone.

        After an undo the env is in the state before the undone jump. So the search skips the moments from
        that jump up to the undo.
        """
        until = self.last
        for moment in reversed(self._jumps):
            if moment.serial > until or not moment.jumped[env]:
                continue
            if moment.restored is not None and moment.restored.undoes is not None:
                until = moment.restored.origin
                continue
            before = self.at(moment.serial - 1)
            return moment if before is not None and before.snapshot is not None else None
        return None

    def envs_still_at(self, jump: Moment) -> tuple[int, ...]:
        """The envs of this jump that have not jumped since."""
        moved = (int(env) for env in np.flatnonzero(jump.jumped))
        return tuple(env for env in moved if self.last_jump(env) is jump)

    # --- private -----------------------------------------------------------------------------------

    def _shrink(self) -> None:
        while self._pictures_used > self.limit * _PICTURES_SHARE and self._pictured:
            moment = self.at(self._pictured.popleft())
            if moment is not None and moment.pictures:
                self._drop_pictures(moment)
        while self.used > self.limit and len(self._moments) > 1:
            oldest = self._moments.popleft()
            self._used -= oldest.size
            self._drop_pictures(oldest)
            self._parts.release(oldest.parts)
            if self._jumps and self._jumps[0] is oldest:
                self._jumps.popleft()

    def _drop_pictures(self, moment: Moment) -> None:
        size = sum(picture.nbytes for picture in moment.pictures.values())
        moment.pictures = {}
        self._pictures_used -= size
        self._used -= size

    def _write(self, moment: Moment) -> None:
        values = {"event_flags": moment.event_flags, "reward": moment.step.reward}
        self._columns.write(moment.serial, self.first, values)
        self._ticks.write(moment.serial, self.first, {"tick": np.array([moment.tick])})

    def _rewards_until(self, env: int, moment: Moment | None, most: int) -> NDArray[np.float32]:
        """(K,) the newest rewards of this env's episode up to a moment, at most `most`, oldest first."""
        episode_backwards = () if moment is None else self.episode_backwards(env, moment.serial)
        rewards = (one.step.reward[of] for one, of in episode_backwards if not one.jumped.any())
        return np.array(list(islice(rewards, most))[::-1], np.float32)

    def _with_rewards(self, stepped: Stepped, origin: Moment | None) -> StepResult:
        step, jumped, restored = stepped.step, stepped.reset_mask, stepped.restored
        if step.action is not None or not jumped.any():
            return step
        reward = np.full(self.num_envs, np.nan, np.float32)
        terms: dict[str, NDArray[np.float32]] = {}

        def take(
            other: StepResult, targets: Sequence[int] | NDArray, sources: Sequence[int] | NDArray
        ) -> None:
            """Copy rewards and reward terms of the envs `sources` of another step into the envs `targets`."""
            reward[targets] = other.reward[sources]
            for name, values in other.evaluate.items():
                # evaluate() has no reward terms: only the reward's hook adds them, and it is not called here.
                if name.startswith(TERM_PREFIX) and name not in step.evaluate:
                    column = terms.setdefault(name, np.full(values.shape, np.nan, np.float32))
                    column[targets] = values[sources]

        kept = np.flatnonzero(~jumped | stepped.resumed)
        if self._moments:
            # Call this even if every env was reset: otherwise this moment would lack the terms, and the
            # page's rows below them would move.
            take(self._moments[-1].step, kept, kept)
        if restored is not None and origin is not None:
            # The reward of a state in which a person has moved a body is unknown.
            if not restored.moved:
                take(origin.step, list(restored.env_idx), list(restored.source))
        return replace(step, reward=reward, evaluate={**step.evaluate, **terms})

    def _events(self, stepped: Stepped, rows: EnvRows, limited: bool) -> NDArray[np.uint8]:
        step, jumped = stepped.step, stepped.reset_mask
        if jumped.any():
            # Success or fail in a restored state is not an event of this moment: it happened at the origin.
            restored = stepped.restored
            flag = RESET if restored is None else BY_HAND if restored.moved else WENT_BACK
            return np.where(jumped, flag, 0).astype(np.uint8)
        event_flags = np.where(step.truncated & limited, TRUNCATED, 0).astype(np.uint8)
        lost = OutlierKind.REWARD_NOT_FINITE
        for flag, what in ((SUCCESS, "success"), (FAIL, "fail"), (REWARD_NONFINITE, lost)):
            if what in rows.first:
                event_flags[rows.first[what] == step.elapsed_steps] |= flag
        pulled, last = stepped.pulled, self._moments[-1].pulled if self._moments else None
        if pulled is not None and (last is None or (last.env, last.body) != (pulled.env, pulled.body)):
            event_flags[pulled.env] |= BY_HAND
        # A task without the entry `fail` may end an episode by a rule of its own.
        event_flags[(rows.outcome == Outcome.FAIL) & (rows.end == step.elapsed_steps)] |= FAIL
        return event_flags


def _went_back(restored: Restored | None) -> TypeGuard[Restored]:
    """Whether it is a jump back to a moment of the history."""
    return restored is not None and restored.origin != NO_MOMENT and not restored.moved
