"""A camera's picture that is taken for a look only, by a camera of its own that comes and goes.

A camera of 1280 x 720 takes long to draw where there is no GPU, and one of 64 x 64 shows a person little; giving the
env's camera another size would change the observation that the task and a policy get. And one that is about to be
added is not there yet, while whether it stands well is seen in its picture alone. So both are seen by a camera beside
the env's, with the same lens (`core.temporary_camera`). Nothing of it can be written.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from workbench.core.camera_settings import CameraKey, CameraSettings
from workbench.core.pictures import Picture
from workbench.core.step import StepResult
from workbench.session.askers import Asker
from workbench.session.lane import Job, JobFailed, Lane
from workbench.session.questions import DrawCamera

IN_A_QUICK_LOOK = ("rgb", "depth", "segmentation")


@dataclass(frozen=True, eq=False)
class Sight:
    """What would be looked at."""

    key: CameraKey
    settings: CameraSettings
    env: int
    step: StepResult | None
    scale: float
    """Of the picture's sides against the camera's own."""

    def same(self, other: Sight | None) -> bool:
        return (
            other is not None
            and self.step is other.step
            and (self.key, self.settings, self.env, self.scale)
            == (other.key, other.settings, other.env, other.scale)
        )


class Preview:
    """One look at a time; a new one takes the place of the one before. Thread-safe; every method returns at once."""

    def __init__(
        self,
        asker: Asker,
        on_change: Callable[[], None],
        failing: str,
        modalities: tuple[str, ...] = ("rgb",),
    ) -> None:
        """
        Args:
            failing: how the sentence begins that says why there is no picture.
            modalities: that the picture has, whatever the camera's own shader gives.
        """
        self._asker, self._failing, self._modalities = asker, failing, modalities
        self._lock = threading.Lock()
        self._lane = Lane("studio-preview", on_change, self._failed)
        self._asked: Sight | None = None
        self._picture: Picture | None = None
        self._problem = ""

    @property
    def problem(self) -> str:
        """Why the last look failed, as a sentence."""
        with self._lock:
            return self._problem

    def picture(self, key: CameraKey | None, env: int | None = None) -> Picture | None:
        """The last look, if it was by this camera, and in this env if one is named."""
        with self._lock:
            found = self._picture
        if found is None or (found.kind, found.camera) != key or env not in (None, found.env):
            return None
        return found

    def wants(self, sight: Sight) -> bool:
        """Whether this is to be looked at and was not yet, and nothing else is being looked at."""
        with self._lock:
            return self._lane.progress is None and not sight.same(self._asked)

    def look(self, sight: Sight, poses: NDArray[np.float32] | None) -> None:
        """
        Args:
            poses: (B, 7) of the env's bodies at a moment of the past; None for now.
        """
        question = DrawCamera(sight.key, sight.settings, sight.env, self._modalities, poses, sight.scale)

        def work(job: Job) -> None:
            picture = self._asker.ask(job.check, question)
            with self._lock:
                self._picture = picture

        with self._lock:
            self._asked, self._problem = sight, ""
        self._lane.start("a preview", work)

    def forget(self) -> None:
        """What was seen is not to be shown any more."""
        with self._lock:
            self._asked, self._picture = None, None

    def stop(self) -> None:
        """The worker is gone, or another version runs: what is under way is not answered any more."""
        self._lane.stop()
        with self._lock:
            self._asked = None

    def close(self) -> None:
        self._lane.close()

    def _failed(self, job: Job, failure: JobFailed) -> None:
        """The last picture stays; the next change looks again."""
        with self._lock:
            self._problem = f"{self._failing}: {failure}."
