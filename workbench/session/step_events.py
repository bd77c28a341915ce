"""What the server is told of every reset, control step and restore: the result, and all it takes to come back.

The server never asks the worker for the past: with each event it gets a snapshot of the batch, packed so that what
did not change is sent once (`core.snapshot_parts`), and while somebody records the pictures of exactly this step.
The newest snapshot stays here as well, for a step that is left half done.
"""

from __future__ import annotations

import sys

import numpy as np
from numpy.typing import NDArray

from workbench.core.pictures import Picture
from workbench.core.snapshot import Snapshot
from workbench.core.snapshot_parts import PackedSnapshot, SnapshotPacker
from workbench.core.step import StepResult
from workbench.core.take_pictures import take_pictures
from workbench.session.episodes import recorded_pictures
from workbench.session.messages import Restored, Stepped
from workbench.session.open_task import OpenedTask


class StepEvents:
    """Makes the events, and counts them."""

    def __init__(self) -> None:
        self.captured_envs: tuple[int, ...] = ()
        """Those whose pictures come with each event; no other pictures may be under way then."""
        self.moment: Snapshot | None = None
        """The batch as the newest event left it; None for a task whose state cannot be kept."""
        self.number = 0
        self._packer: SnapshotPacker | None = SnapshotPacker()

    def new_scene(self) -> None:
        """Another env takes over: nothing that was sent before is of use for it."""
        self.captured_envs = ()
        self._packer = SnapshotPacker()

    def event(
        self,
        opened: OpenedTask,
        step: StepResult,
        reset_mask: NDArray[np.bool_],
        seeds: NDArray[np.int64] | None,
        restored: Restored | None,
    ) -> Stepped:
        """See `Stepped` for what the arguments become."""
        self.number += 1
        captured: tuple[Picture, ...] = ()
        wanted = recorded_pictures(opened.description.cameras) if self.captured_envs else []
        for env in self.captured_envs:
            captured += take_pictures(opened.env.env, env, wanted)
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
        )

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
