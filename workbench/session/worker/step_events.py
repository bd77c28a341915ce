"""What the server is told of every reset, control step and restore: the result, and all it takes to come back.

The server never asks the worker for the past: with each event it gets a snapshot of the batch, packed so that what
did not change is sent once (`core.snapshots.packing`), and while somebody records the state columns of exactly this step
(`core.capture.state_columns`) and its pictures. The newest snapshot stays here as well, for a step that is left half done.
"""

from __future__ import annotations

import sys

import numpy as np
from numpy.typing import NDArray

from workbench.core.camera_data import Picture
from workbench.core.cameras.render import recorded_pictures, step_pictures
from workbench.core.capture.state_columns import read_state_columns
from workbench.core.env.step_result import StepResult
from workbench.core.snapshots.packing import PackedSnapshot, SnapshotPacker
from workbench.core.snapshots.snapshot import Snapshot
from workbench.jobs.open_task import OpenedTask
from workbench.jobs.task import Restored, Stepped


class StepEvents:
    """Makes the events, and counts them."""

    def __init__(self) -> None:
        self._captured: set[int] = set()
        self._armed: set[int] = set()
        self._columns_fail = False
        self.moment: Snapshot | None = None
        """The batch as the newest event left it; None for a task whose state cannot be kept."""
        self.number = 0
        self._packer: SnapshotPacker | None = SnapshotPacker()

    def new_scene(self) -> None:
        """Another env takes over: nothing that was sent before is of use for it."""
        self.capture((), from_reset=False)
        self._packer = SnapshotPacker()
        self._columns_fail = False

    def capture(self, env_idx: tuple[int, ...], from_reset: bool) -> None:
        """As `messages.SetCapture`; an env that is captured already stays so, whenever it is to begin."""
        begun = self._captured & set(env_idx) if from_reset else set(env_idx)
        self._captured, self._armed = begun, set(env_idx) - begun

    @property
    def recorded(self) -> frozenset[int]:
        """The envs that somebody records, from now on or from their next reset."""
        return frozenset(self._captured | self._armed)

    def pictures_due(self, step: StepResult, reset_mask: NDArray[np.bool_]) -> bool:
        """Whether the event of this step draws: no other pictures may be under way then."""
        begun = {env for env in self._armed if reset_mask[env] and step.elapsed_steps[env] == 0}
        self._captured |= begun
        self._armed -= begun
        return bool(self._captured)

    def event(
        self,
        opened: OpenedTask,
        step: StepResult,
        reset_mask: NDArray[np.bool_],
        seeds: NDArray[np.int64] | None,
        restored: Restored | None,
        acted_by: str,
        resumed: bool,
    ) -> Stepped:
        """See `Stepped` for what the arguments become."""
        self.number += 1
        captured: tuple[Picture, ...] = ()
        columns: dict[str, NDArray] = {}
        if self.pictures_due(step, reset_mask):
            columns = self._state_columns(opened)
            wanted = recorded_pictures(opened.description.cameras)
            captured = tuple(step_pictures(opened.env, sorted(self._captured), wanted))
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
            resumed,
        )

    def _state_columns(self, opened: OpenedTask) -> dict[str, NDArray]:
        """Those of this moment; none for a task whose own ``get_state_dict`` raises, which is said once."""
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
        """The batch as it is; empty for a task whose state cannot be kept, which is said once."""
        nothing = PackedSnapshot(b"", None, {})
        if self._packer is None:
            return nothing
        try:
            self.moment = opened.env.snapshot()
            return self._packer.pack(self.moment)
        except Exception as error:
            # What a task keeps on itself is open: an array of objects that cannot be pickled must not end
            # the run of a task that works.
            self._packer = self.moment = None
            print(
                f"The past of this task can be looked at, but not gone back to: {type(error).__name__}: {error}",
                file=sys.stderr,
            )
            return nothing
