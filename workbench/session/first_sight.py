"""What a camera would see that is about to be added: its picture, before anything of it is written.

A diff says where a camera is to stand; whether that is a good place is seen in its picture alone. The env has no such
camera yet, so the picture is taken by one that comes and goes (`core.temporary_camera`), at the moment that is shown.
"""

from __future__ import annotations

import threading
from collections.abc import Callable

from workbench.core.camera_settings import CameraKey, CameraSettings
from workbench.core.pictures import Picture
from workbench.session.askers import Asker
from workbench.session.camera_judging import ShownMoment
from workbench.session.camera_messages import DrawCamera
from workbench.session.lane import Job, Lane

_LARGEST = 256
"""Pixels of the picture's shorter side."""


class FirstSight:
    """Thread-safe; every method returns at once."""

    def __init__(self, asker: Asker, on_change: Callable[[], None]) -> None:
        self._on_change = on_change
        self._lock = threading.Lock()
        self._asker = asker
        self._lane = Lane("studio-first-sight", lambda: None, self._failed)
        self._picture: Picture | None = None
        self._problem = ""

    @property
    def problem(self) -> str:
        """Why there is no picture, as a sentence."""
        with self._lock:
            return self._problem

    def picture(self, key: CameraKey | None) -> Picture | None:
        """Of that camera, if it was the last that was asked for and was seen."""
        with self._lock:
            found = self._picture
        return None if found is None or (found.kind, found.camera) != key else found

    def look(self, key: CameraKey, settings: CameraSettings, moment: ShownMoment) -> None:
        """Take its picture in the shown env; what was taken before is forgotten."""
        with self._lock:
            self._picture, self._problem = None, ""
        scale = min(1.0, _LARGEST / min(settings.width, settings.height))

        def work(job: Job) -> None:
            question = DrawCamera(key, settings, moment.env, ("rgb",), moment.of(moment.env), scale)
            picture = self._asker.ask(job.check, question)
            with self._lock:
                self._picture = picture
            self._on_change()

        self._lane.start("a first sight", work)

    def stop(self) -> None:
        """The worker is gone, or another version runs: what is under way is not answered any more."""
        self._lane.stop()

    def close(self) -> None:
        self._lane.close()

    def _failed(self, why: str) -> None:
        with self._lock:
            self._problem = f"There is no picture of the new camera: {why}."
        self._on_change()
