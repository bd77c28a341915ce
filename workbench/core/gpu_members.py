"""The members of ``PhysxGpuSystem`` that ManiSkill itself never uses, for tasks that reach for them.

`BatchedCpuSystem` has what ManiSkill calls. A task may go further: its author read SAPIEN's reference, or
copied a line from a script. That is refused in one sentence, because an AttributeError about a member that SAPIEN
documents sends its reader to look for the wrong fault.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any

import sapien.physx as physx


def uncommon_member(name: str) -> Any:
    """What a `BatchedCpuSystem` answers for a member that it does not define.

    Raises:
        NotImplementedError: SAPIEN has such a member.
        AttributeError: there is no such member, in SAPIEN neither.
    """
    if hasattr(physx.PhysxGpuSystem, name):
        raise NotImplementedError(
            f"{name} is a member of SAPIEN's GPU system that the batched CPU simulation has not: here every env has its "
            "own physics, at its own origin. What all of them share is asked of one: self.scene.px.systems[0]."
        )
    raise AttributeError(f"the batched CPU system has no '{name}'")


def applies_everything(apply: Callable[[Any], None]) -> Callable[..., None]:
    """For ``gpu_apply_*``: refuse SAPIEN's optional buffer of indices in words.

    Not needed here: what differs from the last fetch is applied, and nothing else is touched anyway.
    """

    @wraps(apply)
    def checked(self: Any, index_buffer: Any = None) -> None:
        if index_buffer is not None:
            raise NotImplementedError(
                f"{apply.__name__} takes no index buffer in the batched CPU simulation: call it without, "
                "it applies the rows that were changed."
            )
        apply(self)

    return checked
