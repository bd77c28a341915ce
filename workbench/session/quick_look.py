"""The chosen camera's picture in another size than the file gives it, for a quick look while it is placed.

A camera of 1280 x 720 takes long to draw where there is no GPU, and one of 64 x 64 shows a person little. Giving the
env's camera another size would change the observation that the task and a policy get; so the look is taken by a camera
of its own, with the same lens, that comes and goes (`core.temporary_camera`). Nothing of it can be written.

There is one look at a time. The page asks for the next when the last one is there and is no longer what would be seen.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass

from workbench.core.camera_settings import CameraKey, CameraSettings
from workbench.core.pictures import Picture
from workbench.core.step import StepResult
from workbench.session.askers import Asker
from workbench.session.camera_judging import ShownMoment
from workbench.session.camera_messages import DrawCamera
from workbench.session.lane import Job, Lane

MODALITIES = ("rgb", "depth", "segmentation")
"""That a quick look has, whatever the camera's own shader gives."""


@dataclass(frozen=True, eq=False)
class Sight:
    """What would be looked at."""

    key: CameraKey
    settings: CameraSettings
    env: int
    step: StepResult | None
    scale: float

    def same(self, other: Sight | None) -> bool:
        return (
            other is not None
            and self.step is other.step
            and (self.key, self.settings, self.env, self.scale)
            == (other.key, other.settings, other.env, other.scale)
        )


class QuickLook:
    """Thread-safe; every method returns at once."""

    def __init__(self, asker: Asker, on_change: Callable[[], None]) -> None:
        self._on_change = on_change
        self._lock = threading.Lock()
        self._asker = asker
        self._lane = Lane("studio-look", lambda: None, self._failed)
        self._scale = 1.0
        self._asked: Sight | None = None
        self._busy = False
        self._picture: Picture | None = None
        self._problem = ""

    @property
    def problem(self) -> str:
        """Why the last look failed, as a sentence."""
        with self._lock:
            return self._problem

    @property
    def scale(self) -> float:
        """Of the picture's sides against the camera's own; 1 where no look is taken."""
        with self._lock:
            return self._scale

    def set_scale(self, scale: float) -> None:
        with self._lock:
            self._scale, self._asked, self._picture = scale, None, None

    def picture(self, key: CameraKey | None, env: int) -> Picture | None:
        """The last look, if it was by this camera in this env."""
        with self._lock:
            found = self._picture
        return None if found is None or ((found.kind, found.camera), found.env) != (key, env) else found

    def wants(self, sight: Sight) -> bool:
        """Whether this is to be looked at and was not yet, and nothing else is being looked at."""
        with self._lock:
            return sight.scale != 1.0 and not self._busy and not sight.same(self._asked)

    def look(self, sight: Sight, moment: ShownMoment) -> None:
        """Take a look, unless one is being taken."""
        with self._lock:
            if self._busy or sight.scale == 1.0:
                return
            self._asked, self._busy, self._problem = sight, True, ""

        def work(job: Job) -> None:
            question = DrawCamera(
                sight.key, sight.settings, sight.env, MODALITIES, moment.of(sight.env), sight.scale
            )
            try:
                picture = self._asker.ask(job.check, question)
                with self._lock:
                    self._picture = picture
            finally:
                with self._lock:
                    self._busy = False
                self._on_change()

        self._lane.start("a quick look", work)

    def stop(self) -> None:
        """The worker is gone, or another version runs: what is under way is not answered any more."""
        self._lane.stop()
        with self._lock:
            self._asked, self._busy = None, False

    def close(self) -> None:
        self._lane.close()

    def _failed(self, why: str) -> None:
        """The last look stays; the next change looks again."""
        with self._lock:
            self._problem = f"The quick look failed: {why}."
