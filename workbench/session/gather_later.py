"""What an `EpisodeGatherer` takes, a few hundred steps at a time, for whoever steps the env in this very process.

A `Stepped` is made to cross a pipe, whole, at every step. Who records in the process of the env needs none: what the step is made of is
copied (`core.step_rows`, `step_ring`), and becomes the rows of episodes when somebody has time. A thread sees to it that this
is soon, so that a killed process loses no more than it does otherwise. Pictures are on their way to the encoders at once.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from workbench.core.step_pictures import observed_pictures
from workbench.core.step_rows import ELAPSED, StepRows
from workbench.core.take_pictures import Request
from workbench.core.task_env import TaskEnv
from workbench.recording.encoded_pictures import MODALITIES, Modality
from workbench.recording.journal import Item, before_writing
from workbench.recording.step_ring import StepRing, Steps
from workbench.session.episodes import EpisodeGatherer, others_of

_Pictures = Mapping[int, Sequence[Item]]


class LaterSteps:
    """The control steps of one scene on their way to `gatherer`, which nobody else may touch before `flush`."""

    def __init__(self, task: TaskEnv, gatherer: EpisodeGatherer, wanted: Sequence[Request]) -> None:
        """Raises ValueError where the task's steps cannot be told later (`StepRows`)."""
        self._task, self._gatherer, self._wanted = task, gatherer, wanted
        self._rows = StepRows(task)
        self._ring = StepRing(self._deliver, self._rows.learn)
        self._told = True
        """Whether the step before had entries that are no columns; at first nobody knows."""
        before_writing(self._ring.flush)

    def take(self, given: tuple[Any, ...], action: NDArray[np.float32]) -> bool:
        """The step that gave `given`; False where it has pictures that must be drawn: `flush`, and go the long way.

        Raises:
            ValueError, RecordingError: as `EpisodeGatherer.take`, of this step or of one before.
        """
        _, reward, terminated, truncated, info = given
        found = self._rows.read(reward, terminated, truncated, info, action)
        pictures: _Pictures | None = None
        if self._wanted:
            pictures = self._encoded()
            if pictures is None:
                return False
        if self._rows.others or self._told:
            pictures = self._with_texts(pictures)
        self._ring.take(found, pictures)
        self._say_what_failed()
        return True

    def _with_texts(self, pictures: _Pictures | None) -> _Pictures:
        """`pictures` with what ``evaluate`` returned in texts, where that is news."""
        others = self._rows.others
        self._told = bool(others)
        elapsed = self._task.env.elapsed_steps.tolist()
        items: dict[int, list[Item]] = {env: [*held] for env, held in (pictures or {}).items()}
        for episode in self._gatherer.under_way:
            env = episode.env
            if news := episode.writer.texts(elapsed[env], others_of(others, env)):
                items.setdefault(env, []).extend(news)
        return items

    def flush(self) -> None:
        """What was taken is with the gatherer. Raises as `take`."""
        self._ring.flush()
        self._say_what_failed()

    def _say_what_failed(self) -> None:
        if self._ring.error is not None:
            raise self._ring.error

    def _encoded(self) -> _Pictures | None:
        seen = observed_pictures(self._task, self._wanted)
        if seen is None:
            return None
        elapsed = self._task.env.elapsed_steps.tolist()
        items: dict[int, list[Item]] = {}
        for episode in self._gatherer.under_way:
            env = episode.env
            items[env] = held = []
            for camera in seen:
                images: dict[Modality, NDArray] = {
                    name: camera.images[name][env] for name in MODALITIES if name in camera.images
                }
                held += episode.writer.encode(
                    elapsed[env], ("sensor", camera.camera), camera.poses[env], images
                )
        return items

    def _deliver(self, steps: Steps) -> None:
        arrays = steps.arrays
        pictures: list[Any] = [{} if extra is None else extra for extra in steps.extras]
        self._gatherer.take_steps(arrays[ELAPSED], self._rows.columns(arrays), pictures)
