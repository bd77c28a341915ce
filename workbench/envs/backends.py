"""Simulation backend and renderer of this machine."""

from __future__ import annotations

import gc
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Literal

import numpy as np
import sapien
import sapien.physx as physx
import sapien.render
import torch

from workbench.machine.software_vulkan import known_render_device

Backend = Literal["auto", "cpu", "gpu"]


class BackendUnavailable(RuntimeError):
    """The requested backend does not work on this machine."""


@dataclass(frozen=True)
class ChosenBackend:
    simulation: Literal["cpu", "gpu"]
    render_backend: str
    """ManiSkill's name: ``gpu`` (SAPIEN's ``cuda`` device), ``cpu`` (any other) or ``none``."""


@dataclass(frozen=True)
class Renderer:
    render_backend: str
    name: str
    """Name of the device, for example ``llvmpipe (LLVM 15.0.6, 256 bits)``."""


def gpu_library_path() -> Path:
    """Where SAPIEN keeps PhysX's GPU library on Linux (see ``sapien/physx/__init__.py``)."""
    return Path.home() / ".sapien" / "physx" / physx.version() / "libPhysXGpu_64.so"


def why_no_gpu_simulation() -> str | None:
    """Why GPU simulation cannot be used, as a clause; None if it can.

    PhysX's GPU library is looked for on disk: asking SAPIEN for it would fetch it from the network.
    """
    if not torch.cuda.is_available():
        return "no CUDA device is visible to torch"
    if not physx.is_gpu_enabled() and not gpu_library_path().exists():
        return (
            "PhysX's GPU library is not installed; with a network, "
            "python -c 'import sapien.physx as p; p.enable_gpu()' fetches it"
        )
    return None


@lru_cache(maxsize=1)
def find_renderer() -> Renderer | None:
    """The device and backend that SAPIEN renders with; None if it finds no device.

    The answer is cached: a process can have only one render device, and asking for it by another name raises.

    Raises:
        BackendUnavailable: a material that was made earlier holds the device under another name.
    """
    for device in ("cuda", "cpu") if torch.cuda.is_available() else ("cpu",):
        try:
            _render_system(device)
        except RuntimeError:
            continue
        return Renderer("gpu" if device == "cuda" else "cpu", _device_summary() or "unknown device")
    if (name := _device_summary()) is not None:
        raise BackendUnavailable(
            f"A material or texture made before any env holds SAPIEN's renderer on {name} under another name. "
            "Create materials and textures in `_load_scene`."
        )
    return None


def _render_system(device: str) -> sapien.render.RenderSystem:
    """A render system on device ``cpu``, ``cuda`` or ``cuda:1``; RuntimeError if there is no such device.

    SAPIEN refuses a device name while a material exists that was made without a render system. A failed build
    may leave such a material behind: hence the garbage collection.
    """
    try:
        return sapien.render.RenderSystem(sapien.Device(device))
    except RuntimeError:
        gc.collect()
        return sapien.render.RenderSystem(sapien.Device(device))


@lru_cache(maxsize=1)
def why_no_ray_tracing() -> str | None:
    """Why this machine cannot draw ray traced pictures, as a clause; None if it can."""
    return known_render_device(install=False).why_no_ray_tracing


def _device_summary() -> str | None:
    """Name of the first supported device in SAPIEN's report (blocks of ``GPU: name``, ``Supported: 1`` ...),
    or None."""
    try:
        report = sapien.render.get_device_summary()
    except RuntimeError:  # no Vulkan driver
        return None
    name = None
    for line in report.splitlines():
        key, _, value = line.strip().partition(":")
        if key == "GPU":
            name = value.strip()
        elif key == "Supported" and value.strip() == "1":
            return name
    return None


def choose_backend(wanted: Backend, render: bool) -> ChosenBackend:
    """Choose simulation and renderer. ``auto`` is the batched CPU: so far, GPU simulation has not passed its
    tests (``make test-gpu``) on any machine.

    Raises:
        BackendUnavailable: the backend does not work here; the message says why, and what to use instead.
    """
    if wanted == "gpu" and (reason := why_no_gpu_simulation()) is not None:
        raise BackendUnavailable(f"GPU simulation is not available: {reason}. Use --backend cpu.")
    renderer = find_renderer() if render else None
    return ChosenBackend(
        "gpu" if wanted == "gpu" else "cpu", "none" if renderer is None else renderer.render_backend
    )


def unused_gpu_text(wanted: Backend) -> str | None:
    """Notice that ``auto`` simulates on the CPU although GPU simulation is available; else None."""
    if wanted != "auto" or why_no_gpu_simulation() is not None:
        return None
    return (
        "The envs are simulated in a batch on the CPU, although there is a GPU: GPU simulation has passed its tests on no "
        "machine so far. To simulate on the GPU, add --backend gpu."
    )


# --- the render device -------------------------------------------------------------------------------


@lru_cache(maxsize=1)
def _brdf_table() -> sapien.render.RenderTexture:
    """SAPIEN's BRDF table, as read by ``tests/envs/test_brdf_table.py``: (512, 512, 2), scale and bias.

    The file holds (2, 512, 512) numbers in float16, as differences between the bits of neighbours in a row:
    these compress to 154 kB, the numbers themselves to 416 kB.
    """
    steps = np.load(Path(__file__).parent / "brdf_table.npz")["steps"]
    table = np.moveaxis(np.cumsum(steps, axis=2, dtype=np.uint16).view(np.float16), 0, 2)
    return sapien.render.RenderTexture(
        np.ascontiguousarray(table, np.float32), 2, "R32G32Sfloat", 1, "linear", "edge"
    )


def give_brdf_table(camera: sapien.render.RenderCameraComponent) -> None:
    """Give a camera in a scene the BRDF table with which its shader looks up reflections of the environment.

    Without it, SAPIEN computes the table for the first picture of the process, from 268 million samples: 5 to
    19 s on a software driver. With it, the first picture takes 0.1 s and has the same bits. The table is that
    of the split-sum approximation (Karis, Real Shading in Unreal Engine 4, 2013). On a GPU SAPIEN computes
    the table quickly, so this function does nothing there.
    """
    scene = camera.entity.scene
    if not scene.render_system.device.is_cuda():
        camera.set_texture("BRDFLUT", _brdf_table())


_kept: dict[str, sapien.render.RenderSystem] = {}


def sapien_device(render_backend: str) -> str:
    """SAPIEN's name of the device behind a ``render_backend`` of ManiSkill: ``cpu``, ``cuda``, ``cuda:1``, ``pci:...``."""
    kind, colon, index = render_backend.partition(":")
    return {"gpu": "cuda", "sapien_cpu": "cpu", "sapien_cuda": "cuda"}.get(kind, kind) + colon + index


def keep_render_device(device: str) -> None:
    """Keep a render device for the life of the process: ``cpu``, ``cuda``, ``cuda:1``, or ManiSkill's names for them.

    SAPIEN compiles its shaders for a render device and drops them with the last ``RenderSystem`` on it. With one idle
    RenderSystem kept, the next env with cameras is made in about 0.2 s. On NVIDIA
    drivers it may also avoid a failure after some 28 make and close cycles (ManiSkill #1474, #1477).

    Raises:
        RuntimeError: the machine has no such render device, or this process keeps another.
    """
    name = sapien_device(device)
    if name in _kept:
        return
    try:
        _kept[name] = _render_system(name)
    except RuntimeError as error:
        if _kept and _exists(name):
            raise RuntimeError(
                f"SAPIEN allows one render device per process, and this process renders on {next(iter(_kept))!r}: "
                f"use another process for {name!r}."
            ) from error
        raise RuntimeError(
            f"SAPIEN cannot render on {name!r}: {error}. It needs a Vulkan driver: a GPU's own, or Mesa's "
            "software driver from version 24.3 on. `workbench doctor` says which one is found and what to "
            "install; without one, make the env with render_backend='none'."
        ) from error


def _exists(device: str) -> bool:
    try:
        sapien.Device(device)
    except RuntimeError:
        return False
    return True
