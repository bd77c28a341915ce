"""Keep the render device alive, so that only the first scene of a process pays for it.

SAPIEN compiles its shaders for a render device, which takes 5 to 19 s on a software driver, and
throws both away when the last ``RenderSystem`` on that device goes. A tool that closes one env and
makes the next one would pay every time. One idle RenderSystem that is held for the life of the
process keeps them: the next env with cameras is made in about 0.2 s. On NVIDIA drivers it may also
avoid the failure after some 28 make and close cycles (ManiSkill #1474, #1477), since the Vulkan
instance is not made anew.
"""

from __future__ import annotations

import sapien
import sapien.render

_kept: dict[str, sapien.render.RenderSystem] = {}


def keep_render_device(device: str) -> None:
    """Hold a render device for good: ``cpu``, ``cuda``, ``cuda:1``, or ManiSkill's own names for them.

    Takes as long as compiling the shaders the first time, nothing afterwards.

    Raises:
        RuntimeError: the machine has no such render device.
    """
    kind, colon, index = device.partition(":")
    name = {"gpu": "cuda", "sapien_cpu": "cpu", "sapien_cuda": "cuda"}.get(kind, kind) + colon + index
    if name in _kept:
        return
    try:
        _kept[name] = sapien.render.RenderSystem(sapien.Device(name))
    except RuntimeError as error:
        raise RuntimeError(
            f"SAPIEN cannot render on {name!r}: {error}. It needs a Vulkan driver: a GPU's own, or Mesa's "
            "software driver from version 24.3 on. `workbench doctor` says which one is found and what to "
            "install; without one, make the env with render_backend='none'."
        ) from error
