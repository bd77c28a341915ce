"""The snapshot of the open recordings for the review page: position, events, curves and pictures."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from workbench.envs.camera_data import CameraInfo, CameraKey, Picture, PictureDegree
from workbench.envs.step_result import TERM_PREFIX
from workbench.episodes.episode import CameraTrack, Episode
from workbench.episodes.reader.reader_process import ReaderBusy
from workbench.episodes.row import is_stopped
from workbench.live.messages import CameraRequest

START = "start"
"""The alignment that is available for every recording."""
Style = Literal["reset", "success", "fail", "limit", "odd", "other"]
"""Colour of an event on the strip under the slider."""
REWARD = "reward"
TERMS = "terms of the reward"
ACTION = "action"
MAX_LINES = 12
"""Maximum number of lines of one entry in a chart; more cannot be distinguished."""
_MAX_RUNS = 40
"""Maximum number of events of one entry. If there are more, only the first is kept: an entry that changes at
every step would cover the strip."""


@dataclass(frozen=True)
class EpisodeEvent:
    """An event: the first state of a run of states in which a condition is true."""

    state: int
    name: str
    style: Style


@dataclass(frozen=True, eq=False)
class Opened:
    """One open recording. Objects are equal only if they are identical."""

    id: str
    """Id of the library's row."""
    name: str
    """Shown name of the file."""
    episode: Episode
    events: tuple[EpisodeEvent, ...]
    scene: str = ""
    """Message about the 3-D scene: that it is being made, why it cannot be made, or what of it was not
    restored."""
    making: bool = False
    """Whether the scene is being made in the background."""

    @property
    def length(self) -> int:
        """Number of control steps; there is one more state."""
        return len(self.episode.reward)

    @property
    def has_scene(self) -> bool:
        return self.episode.geometry is not None and self.episode.poses is not None

    def first(self, name: str) -> int | None:
        """The first state with an event of this name; None if there is none."""
        return next((event.state for event in self.events if event.name == name), None)


@dataclass(frozen=True)
class Playback:
    """Position and time at which playback began."""

    position: int
    at: float
    """Clock time in seconds."""


@dataclass(frozen=True)
class ReviewView:
    """Immutable snapshot of the open recordings and of the position.

    Recordings differ in length and in the times of their events. So all share one *position*, counted from the state at
    which they are aligned (their starts, the first success of each, ...): position 0 is that state in each. Before its
    start an episode shows its first state, after its end its last.
    """

    opened: tuple[Opened, ...] = ()
    opened_serial: int = 0
    """Increases when the open recordings change, and when one of them gets its scene."""
    selected: int = 0
    """Index into `opened` of the recording whose cameras and numbers are shown."""
    align: str = START
    alignments: tuple[str, ...] = (START,)
    """Possible alignments of the open recordings."""
    anchors: tuple[int, ...] = ()
    """State of each recording at position 0."""
    position: int = 0
    first: int = 0
    last: int = 0
    """First and last position, inclusive."""
    playback: Playback | None = None
    """Playback; None while paused."""
    speed: float = 1.0
    loop: bool = False
    loading: str = ""
    """Text: the recording that is being opened."""
    problems: tuple[str, ...] = ()
    """A sentence for each recording that could not be opened, and for each file that changed since it was
    read."""
    changed_symbols: str = ""
    """Symbols of the selected recording's task that changed since the recording."""
    not_opened: tuple[str, ...] = ()
    """Ids of the recordings that the last opening could not read."""
    library_stays: bool = False
    """Whether the library stays unfolded next to the open recordings."""

    @property
    def playing(self) -> bool:
        return self.playback is not None

    @property
    def states(self) -> tuple[int, ...]:
        """State of each recording at the position."""
        return tuple(
            state_at(self.position, a, o.length) for o, a in zip(self.opened, self.anchors, strict=True)
        )

    @property
    def chosen(self) -> Opened | None:
        return self.opened[self.selected] if self.opened else None


def state_at(position: int, anchor: int, length: int) -> int:
    """State of an episode with `length` steps at a position: before the episode the first state, after it the
    last."""
    return min(max(position + anchor, 0), length)


def column_at(
    states: NDArray[np.integer], values: NDArray[np.float64], anchor: int, axis: NDArray[np.int64]
) -> NDArray[np.float64]:
    """(len(axis),) values of one episode at the positions of `axis`; NaN where the episode has no value.

    Args:
        states: (K,) states of the values.
        values: (K,) values.
        anchor: state of the episode at position 0.
        axis: consecutive positions.
    """
    line = np.full(len(axis), np.nan)
    if len(axis):
        places = states.astype(np.int64) - anchor - int(axis[0])
        inside = (places >= 0) & (places < len(axis))
        line[places[inside]] = values[inside]
    return line


# --- events and curves ---------------------------------------------------------------------------------


def find_events(episode: Episode) -> tuple[EpisodeEvent, ...]:
    """Events in order of time, the start first: success, fail and every other bool of ``evaluate`` that becomes true, time
    limits, and rewards that are not finite."""
    found = [EpisodeEvent(0, "reset", "reset")]
    for name, values in episode.evaluate.items():
        yes = None if name.startswith(TERM_PREFIX) else _flag(values)
        if yes is not None:
            style: Style = "success" if name == "success" else "fail" if name == "fail" else "other"
            found += [EpisodeEvent(state, name, style) for state in _turns_true(yes)]
    found += [
        EpisodeEvent(state + 1, "time limit", "limit")
        for state in _turns_true(np.asarray(episode.truncated, bool))
    ]
    found += [
        EpisodeEvent(state + 1, "reward is NaN or infinite", "odd")
        for state in _turns_true(~np.isfinite(np.asarray(episode.reward, np.float64)))
    ]
    return tuple(sorted(found, key=lambda event: (event.state, event.style == "other")))


def curves(episode: Episode) -> dict[str, dict[str, tuple[NDArray[np.int64], NDArray[np.float64]]]]:
    """Curves of the numeric entries: the states (K,) and the values (K,) of each line, by entry name, then by line name.

    An entry with several values per state (an action, the terms of a reward) has one line per value, at most `MAX_LINES`.
    """
    states = np.arange(len(episode.reward) + 1)
    after = states[1:]
    found: dict[str, dict[str, tuple[NDArray, NDArray]]] = {}
    if episode.info.has_reward:
        found[REWARD] = {REWARD: (after, _numbers(episode.reward))}
    terms: dict[str, tuple[NDArray, NDArray]] = {}
    for name, values in episode.evaluate.items():
        if values.dtype.kind not in "fiub":
            continue
        if name.startswith(TERM_PREFIX):
            if values.ndim == 1 and len(terms) < MAX_LINES:
                terms[name.removeprefix(TERM_PREFIX)] = (after, _numbers(values)[1:])
            continue
        label = f"{name} (evaluate)" if name in (REWARD, TERMS, ACTION) else name
        found[label] = dict(_lines(name, values, states))
    for name, values in episode.batch.items():
        label = f"{name} (not per env)"
        found[label] = dict(_lines(label, values, states))
    if terms:
        found[TERMS] = terms
    if episode.action.shape[1:] and episode.action.shape[1]:
        action = np.asarray(episode.action, np.float64)[:, :MAX_LINES]
        found[ACTION] = {
            name: (after, action[:, index]) for index, name in enumerate(episode.action_names[:MAX_LINES])
        }
    return found


def outcome_text(episode: Episode) -> tuple[str, str]:
    """(text, colour): how the episode ended, and ``good``, ``bad``, ``warn`` or empty."""
    success, fail = (_flag(episode.evaluate.get(name)) for name in ("success", "fail"))
    if fail is not None and len(fail) and fail[-1]:
        return "failed", "bad"
    if success is None or not len(success):
        return "no success defined", ""
    if success[-1]:
        return "success", "good"
    if len(once := np.flatnonzero(success)):
        return f"success lost (first reached at step {once[0]})", "warn"
    if is_stopped(episode.length, episode.info.max_episode_steps):
        return "stopped, no success yet", ""
    return "no success", "bad"


def _lines(name: str, values: NDArray, states: NDArray) -> Iterator[tuple[str, tuple[NDArray, NDArray]]]:
    flat = _numbers(values.reshape(len(values), -1))
    for column in range(min(flat.shape[1], MAX_LINES)):
        label = name if values.ndim == 1 else f"{name}[{column}]"
        yield label, (states, flat[:, column])


def _numbers(values: NDArray) -> NDArray[np.float64]:
    return np.asarray(values, np.float64)


def _flag(values: NDArray | None) -> NDArray[np.bool_] | None:
    """(T + 1,) values of a bool entry; None for any other entry."""
    if values is None or not len(values) or values.size != len(values):
        return None
    flat = values.reshape(len(values))
    if flat.dtype.kind == "b":
        return flat
    if flat.dtype.kind != "f":
        return None
    # A bool entry that only some states have is stored as 0.0 and 1.0, with NaN at the other states.
    known = flat[np.isfinite(flat)]
    return np.nan_to_num(flat) != 0 if len(known) and np.isin(known, (0.0, 1.0)).all() else None


def _turns_true(yes: NDArray[np.bool_]) -> list[int]:
    before = np.concatenate([[False], yes[:-1]])
    starts = np.flatnonzero(yes & ~before)
    return starts[:1].tolist() if len(starts) > _MAX_RUNS else starts.tolist()


# --- pictures ------------------------------------------------------------------------------------------


class PictureReader:
    """Decodes the pictures of one recording at a time. Not thread-safe: used on the page's loop.

    A picture takes some milliseconds to decode and an episode with four cameras has thousands. So only the shown picture of
    each camera is decoded and cached: the page requests the same picture thirty times a second.
    """

    def __init__(self) -> None:
        self._episode: Episode | None = None
        self._cache: dict[CameraKey, tuple[int, tuple[str, ...], Picture]] = {}
        self.problem = ""
        """Why a picture cannot be shown, as a sentence; else empty."""

    def cameras(self, episode: Episode) -> tuple[CameraInfo, ...]:
        """Cameras of the episode, each with its recorded modalities."""
        return tuple(
            replace(track.info, modalities=tuple(track.pictures))
            for track in episode.cameras
            if track.pictures and len(track.frame)
        )

    def pictures(
        self, episode: Episode, state: int, requests: Iterable[CameraRequest], env: int
    ) -> dict[CameraKey, Picture]:
        """The newest picture of each camera at or before `state`, labelled with `env`.

        A camera whose picture cannot be decoded is left out; `problem` contains the reason.
        """
        if episode is not self._episode:
            self._episode, self._cache, self.problem = episode, {}, ""
        tracks = {track.info.key: track for track in episode.cameras}
        found: dict[CameraKey, Picture] = {}
        for request in requests:
            track = tracks.get((request.kind, request.name))
            if track is None:
                continue
            index = int(np.searchsorted(track.frame, state, side="right")) - 1
            modalities = tuple(m for m in track.pictures if m in request.modalities)
            if index < 0 or not modalities:
                continue
            kept = self._cache.get(track.info.key)
            if kept is None or kept[:2] != (index, modalities) or kept[2].env != env:
                try:
                    degree = "fast" if episode.info.pictures == "fast" else None
                    picture = decode_picture(track, index, modalities, env, degree)
                except ReaderBusy:
                    # The reader is opening another recording: the last picture stays until that is done.
                    if kept is not None:
                        found[track.info.key] = kept[2]
                    continue
                except (OSError, ValueError, EOFError, IndexError) as error:
                    self.problem = f"A picture of {track.info.name} cannot be read: {error}."
                    continue
                kept = (index, modalities, picture)
                self._cache[track.info.key] = kept
            found[track.info.key] = kept[2]
        return found


def decode_picture(
    track: CameraTrack, index: int, modalities: tuple[str, ...], env: int, degree: PictureDegree | None
) -> Picture:
    """Picture `index` of a camera."""
    planes: dict[str, Any] = {
        m: np.asarray(encoded[index]) for m, encoded in track.pictures.items() if m in modalities
    }
    return Picture(track.info.name, track.info.kind, env, track.pose[index], **planes, degree=degree)
