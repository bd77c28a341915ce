"""Makes the event of each reset, control step and restore, with a snapshot of the batch."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from workbench.envs.camera_data import CameraKey, CameraSettings, Picture
from workbench.envs.rendering.drawing import CannotDraw
from workbench.envs.snapshots.packing import PackedSnapshot, SnapshotPacker
from workbench.envs.snapshots.snapshot import Snapshot
from workbench.envs.state_columns import read_state_columns
from workbench.envs.step_result import StepResult
from workbench.pictures.render import recorded_pictures, step_pictures
from workbench.task.description import Pulled, Restored, Stepped
from workbench.task.open import OpenedTask


class StepEvents:
    """Makes and counts `Stepped` events.

    The server never asks the worker for past states: each event has a snapshot of the batch, packed so that
    unchanged parts are sent once (`envs.snapshots.packing`), and during a recording the state columns and
    pictures of exactly this step.
    """

    def __init__(self) -> None:
        self._recording: set[int] = set()
        self._from_reset: set[int] = set()
        self._columns_fail = False
        self._undrawable: set[CameraKey] = set()
        """Cameras that cannot be drawn."""
        self.moment: Snapshot | None = None
        """The batch at the newest event, to restore after a step that was cut short; None if it cannot be copied."""
        self.number = 0
        self.recording_took = 0.0
        """Seconds that recording took in the newest event: pictures, states, observations."""
        self._packer: SnapshotPacker | None = SnapshotPacker()

    def new_scene(self) -> None:
        """Start again for a new env: its snapshots share no parts with those that were sent."""
        self.capture((), from_reset=False)
        self._packer = SnapshotPacker()
        self._columns_fail = False
        self._undrawable.clear()

    def capture(self, env_idx: tuple[int, ...], from_reset: bool) -> None:
        """Start or stop capturing, see `SetCapture`. Envs that are captured now do not wait for a reset."""
        begun = self._recording & set(env_idx) if from_reset else set(env_idx)
        self._recording, self._from_reset = begun, set(env_idx) - begun

    @property
    def recorded(self) -> frozenset[int]:
        """The envs that are recorded now or from their next reset."""
        return frozenset(self._recording | self._from_reset)

    def pictures_due(self, step: StepResult, reset_mask: NDArray[np.bool_]) -> bool:
        """Whether `event` renders pictures for this step; no other picture may be in progress then. Also
        starts the recording of envs that waited for this reset."""
        begun = {env for env in self._from_reset if reset_mask[env] and step.elapsed_steps[env] == 0}
        self._recording |= begun
        self._from_reset -= begun
        return bool(self._recording)

    def event(
        self,
        opened: OpenedTask,
        step: StepResult,
        reset_mask: NDArray[np.bool_],
        seeds: NDArray[np.int64] | None,
        restored: Restored | None,
        acted_by: str,
        resumed: bool,
        placed: dict[CameraKey, CameraSettings],
        on_failed: Callable[[CannotDraw], None],
        pulled: Pulled | None = None,
    ) -> Stepped:
        """The next event; see `Stepped` for the arguments.

        Args:
            on_failed: called for each camera that cannot be drawn; the recording lacks its pictures.
        """
        self.number += 1
        captured: tuple[Picture, ...] = ()
        columns: dict[str, NDArray] = {}
        began = time.monotonic()
        if self.pictures_due(step, reset_mask):
            columns = self._state_columns(opened)
            captured = self._pictures(opened, on_failed)
        self.recording_took = time.monotonic() - began
        packed = self._packed_snapshot(opened)
        return Stepped(
            step,
            reset_mask,
            captured,
            seeds,
            packed.body,
            packed.keys,
            packed.new_parts,
            self.number,
            restored,
            columns,
            acted_by,
            placed if columns or captured else {},
            resumed,
            pulled,
        )

    def _pictures(self, opened: OpenedTask, on_failed: Callable[[CannotDraw], None]) -> tuple[Picture, ...]:
        while True:
            cameras = [camera for camera in opened.description.cameras if camera.key not in self._undrawable]
            try:
                return tuple(step_pictures(opened.env, sorted(self._recording), recorded_pictures(cameras)))
            except CannotDraw as failed:
                self._undrawable.add(failed.key)
                on_failed(failed)

    def _state_columns(self, opened: OpenedTask) -> dict[str, NDArray]:
        """State columns of this moment; empty for a task whose ``get_state_dict`` raises, which is printed once."""
        try:
            return {} if self._columns_fail else read_state_columns(opened.env)
        except Exception as error:
            self._columns_fail = True
            print(
                f"Recorded without env states and observations: {type(error).__name__}: {error}",
                file=sys.stderr,
            )
            return {}

    def _packed_snapshot(self, opened: OpenedTask) -> PackedSnapshot:
        """A snapshot of the batch; empty if the task's state cannot be copied, which is printed once."""
        nothing = PackedSnapshot(b"", None, {})
        if self._packer is None:
            return nothing
        try:
            self.moment = opened.env.snapshot()
            return self._packer.pack(self.moment)
        except Exception as error:
            # A task may have any attribute: one that cannot be pickled must not stop a working task.
            self._packer = self.moment = None
            print(
                f"The history of this task can be viewed, but not restored: {type(error).__name__}: {error}",
                file=sys.stderr,
            )
            return nothing
