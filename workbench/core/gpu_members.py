"""The members of ``PhysxGpuSystem`` that ManiSkill itself never uses, for tasks that reach for them.

`BatchedCpuSystem` has what ManiSkill calls. A task may go further: its author read SAPIEN's reference, or
copied a line from a script. What means something here does it; what does not is refused in one sentence,
because an AttributeError about a member that SAPIEN documents sends its reader to look for the wrong fault.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any

import sapien

_SAME_IN_EVERY_ENV = ("config", "get_config", "get_scene_collision_id", "scene_collision_id")
_REFUSED = {
    "gpu_set_cuda_stream": "the batched CPU simulation has no CUDA stream: leave gpu_set_cuda_stream out.",
    "set_scene_offset": (
        "set_scene_offset is not possible in the batched CPU simulation: every env has its own physics "
        "and stands at its own origin."
    ),
    "set_scene_collision_id": (
        "set_scene_collision_id is not possible in the batched CPU simulation: every env has its own "
        "physics, so nothing of another env can be touched."
    ),
}


def uncommon_member(system: Any, name: str) -> Any:
    """What a `BatchedCpuSystem` answers for a member that it does not define.

    Raises:
        NotImplementedError: SAPIEN has such a member and it means nothing on the CPU.
        AttributeError: there is no such member, in SAPIEN neither.
    """
    if name in _REFUSED:
        raise NotImplementedError(_REFUSED[name])
    if name in _SAME_IN_EVERY_ENV:
        return getattr(system.systems[0], name)
    if name == "device":
        return sapien.Device("cpu")
    if name in ("get_timestep", "set_timestep"):
        return lambda *value: setattr(system, "timestep", *value) if value else system.timestep
    if name in (
        "get_rigid_dynamic_components",
        "get_rigid_static_components",
        "get_articulation_link_components",
    ):
        return lambda: getattr(system, name.removeprefix("get_"))
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
