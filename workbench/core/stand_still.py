"""Control steps of some envs of a batch, while the others stand still and notice nothing.

The task's code is batched: its hooks run for all envs or for none. But PhysX has a scene an env on the CPU, and those
of the envs that are to stand still are simply not stepped. What the hooks did to them meanwhile (a step more
counted, targets of a robot, a buffer) is put back from a snapshot that was taken before. Their physics is only put
back where somebody wrote to it: a state that is written, even the one that is there, wakes what slept and goes on
otherwise in the last bits.

In GPU simulation all envs are in one scene and all step; there the others are put back from the snapshot.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from workbench.core import seams
from workbench.core.snapshot import Snapshot, restore_memory, restore_snapshot


@contextmanager
def only_these_move(env: Any, env_idx: Sequence[int], others: Snapshot | None) -> Iterator[None]:
    """Within this, control steps are of these envs.

    Args:
        others: all other envs as they are now, which they are at the end again; None for a batch in which nobody
            asks for what the others were.
    """
    px = seams.batched_system(env.scene)
    if px is None:
        try:
            yield
        finally:
            if others is not None:
                restore_snapshot(env, others)
        return
    before = px.packs()
    flags = [flag.copy() for flag in px.drive_flags]
    px.hold_still(set(range(env.num_envs)) - {int(i) for i in env_idx})
    try:
        yield
    finally:
        now = px.packs()
        px.hold_still(())
        if others is not None:
            still = [i for i in others.env_idx if now[i] == before[i]]
            moved = [i for i in others.env_idx if now[i] != before[i]]
            if moved:
                restore_snapshot(env, others, moved, moved, fresh_physics=False)
            if still:
                positions = [others.env_idx.index(i) for i in still]
                restore_memory(env, others.memory, still, positions, whole=False)
            px.keep_drives(still, flags)
            env.scene._gpu_fetch_all()
