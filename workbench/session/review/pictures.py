"""What the cameras of a recording saw at a state: decoded when it is asked for, and only what is asked for.

A picture is decoded in some milliseconds, but an episode of four cameras has thousands of them. So one is decoded for
the state that is shown, and kept until another one is shown: the page asks thirty times a second for the same.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from workbench.core.camera_data import CameraInfo, CameraKey, Picture
from workbench.recording.episode.episode import CameraTrack, Episode
from workbench.recording.reader.processes import ReaderBusy
from workbench.session.protocol.messages import CameraRequest

MODALITIES = ("rgb", "depth", "segmentation")


class PictureReader:
    """The pictures of one opened recording at a time. Not thread-safe: the page's loop owns it."""

    def __init__(self) -> None:
        self._episode: Episode | None = None
        self._kept: dict[CameraKey, tuple[int, tuple[str, ...], Picture]] = {}
        self.problem = ""
        """Why a picture cannot be shown, a sentence; empty while all can."""

    def cameras(self, episode: Episode) -> tuple[CameraInfo, ...]:
        """Its cameras, each with the modalities that were recorded."""
        return tuple(
            replace(track.info, modalities=recorded_modalities(track))
            for track in episode.cameras
            if recorded_modalities(track) and len(track.frame)
        )

    def pictures(
        self, episode: Episode, state: int, wanted: Iterable[CameraRequest], env: int
    ) -> dict[CameraKey, Picture]:
        """By camera, the newest picture that there was at `state`; said to be of `env`.

        A camera whose picture cannot be decoded has none; `problem` says why.
        """
        if episode is not self._episode:
            self._episode, self._kept, self.problem = episode, {}, ""
        tracks = {track.info.key: track for track in episode.cameras}
        found: dict[CameraKey, Picture] = {}
        for request in wanted:
            track = tracks.get((request.kind, request.name))
            if track is None:
                continue
            index = int(np.searchsorted(track.frame, state, side="right")) - 1
            modalities = tuple(m for m in recorded_modalities(track) if m in request.modalities)
            if index < 0 or not modalities:
                continue
            kept = self._kept.get(track.info.key)
            if kept is None or kept[:2] != (index, modalities) or kept[2].env != env:
                try:
                    picture = decoded(track, index, modalities, env)
                except ReaderBusy:
                    # The one before stays for the moment that another recording is opened in.
                    if kept is not None:
                        found[track.info.key] = kept[2]
                    continue
                except (OSError, ValueError, EOFError, IndexError) as error:
                    self.problem = f"A picture of {track.info.name} cannot be read: {error}."
                    continue
                kept = (index, modalities, picture)
                self._kept[track.info.key] = kept
            found[track.info.key] = kept[2]
        return found


def recorded_modalities(track: CameraTrack) -> tuple[str, ...]:
    return tuple(modality for modality in MODALITIES if getattr(track, modality) is not None)


def decoded(track: CameraTrack, index: int, modalities: tuple[str, ...], env: int) -> Picture:
    """Picture `index` of a camera."""
    planes = {modality: np.asarray(getattr(track, modality)[index]) for modality in modalities}
    return Picture(track.info.name, track.info.kind, env, track.pose[index], **planes)
