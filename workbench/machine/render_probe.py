"""Probes in a child process whether SAPIEN can render. Run as a module, this is that child."""

from __future__ import annotations

import ctypes
import os
import struct
import subprocess
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import msgspec

from workbench.machine.processes.child_environment import child_environment, python_command
from workbench.machine.processes.family import describe_exit

ANSWER = "render-device-answer:"
DRIVER_VARIABLES = ("VK_DRIVER_FILES", "VK_ICD_FILENAMES")

SYSTEM_LIBRARIES = {
    "libX11.so.6": "libx11-6",
    "libxcb.so.1": "libxcb1",
    "libGL.so.1": "libgl1",
    "libgthread-2.0.so.0": "libglib2.0-0",
}
"""Libraries that the wheels of sapien and opencv-python load but do not contain, each with its Debian
package."""


@dataclass(frozen=True)
class RenderProbe:
    """Result of one probe."""

    ok: bool
    name: str | None = None
    """Device name from Vulkan: ``llvmpipe (LLVM 15.0.6, 256 bits)``."""
    driver: str | None = None
    """Driver and version: ``llvmpipe, Mesa 25.0.7-2``."""
    error: str | None = None
    """Why SAPIEN cannot render; None if `ok`."""
    env: Mapping[str, str] = field(default_factory=dict)
    """Environment variables with which a process finds this device; empty for a system driver."""
    device: str | None = None
    """Argument of ``sapien.Device``: ``cuda``, or ``cpu`` for any other Vulkan device."""
    missing_libraries: tuple[str, ...] = ()
    """Names in `SYSTEM_LIBRARIES` that cannot be loaded. If there are any, `ok` is False."""
    why_no_ray_tracing: str | None = None
    """Why this device cannot draw ray traced pictures, as a clause; None if it can."""


def probe_render_device(env: Mapping[str, str] | None = None, timeout_s: float = 60) -> RenderProbe:
    """Probe rendering in a child process, with the environment of this process and `env` on top.

    A driver file (ICD) proves nothing: SAPIEN refuses Debian 12's Mesa 22.3, and an NVIDIA ICD without the kernel module
    crashes or hangs in native code. So the child builds a `sapien.render.RenderSystem` on the device that ManiSkill would
    request.

    If the child crashes, takes longer than `timeout_s` or lacks a library, the result is ``ok=False``, never an exception.
    """
    added = dict(env or {})
    try:
        child = subprocess.run(
            python_command("-m", "workbench.machine.render_probe"),
            env=child_environment(**added),
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=timeout_s,
        )
    except subprocess.TimeoutExpired:
        return RenderProbe(ok=False, error=f"SAPIEN gave no answer in {timeout_s:.0f} s", env=added)
    for line in child.stdout.splitlines():
        if line.startswith(ANSWER):
            return replace(msgspec.json.decode(line[len(ANSWER) :], type=RenderProbe), env=added)
    how, last = (
        describe_exit(child.returncode),
        (child.stderr.strip().splitlines() or ["no output"])[-1],
    )
    return RenderProbe(
        ok=False, error=f"SAPIEN {how}" + (f": {last}" if child.returncode > 0 else ""), env=added
    )


def driver_files() -> list[Path]:
    """The driver manifests (ICDs) that the Vulkan loader would read, by its documented search order.

    Source: "LoaderDriverInterface.md" of Khronos' Vulkan-Loader, "Driver Discovery" on Linux.
    """
    for variable in DRIVER_VARIABLES:
        if os.environ.get(variable):
            return [Path(part) for part in os.environ[variable].split(os.pathsep) if Path(part).is_file()]
    home = Path.home()
    roots = [
        Path(os.environ.get("XDG_CONFIG_HOME") or home / ".config"),
        *(Path(part) for part in (os.environ.get("XDG_CONFIG_DIRS") or "/etc/xdg").split(os.pathsep)),
        Path("/etc"),
        Path(os.environ.get("XDG_DATA_HOME") or home / ".local/share"),
        *(
            Path(p)
            for p in (os.environ.get("XDG_DATA_DIRS") or "/usr/local/share:/usr/share").split(os.pathsep)
        ),
    ]
    return sorted({file for root in roots for file in (root / "vulkan" / "icd.d").glob("*.json")})


def _look() -> RenderProbe:
    """Build a render system and describe the device that it took; runs in the child."""
    missing = tuple(name for name in SYSTEM_LIBRARIES if not _loads(name))
    if missing:
        return RenderProbe(ok=False, error=f"missing: {', '.join(missing)}", missing_libraries=missing)
    import sapien
    import sapien.render

    refusals: list[str] = []
    # CUDA first, like ManiSkill's "gpu" render backend. A process can have only one render device: the first that works.
    for device in ("cuda", "cpu"):
        try:
            system = sapien.render.RenderSystem(device)
        except RuntimeError as refusal:
            refusals.append(str(refusal))
            continue
        summary = [
            (key.strip(), value.strip())
            for key, _, value in (
                line.partition(":") for line in sapien.render.get_device_summary().splitlines()
            )
        ]
        name = next((value for key, value in summary if key == "GPU"), str(system.device))
        driver = _vulkan_drivers().get(name)
        return RenderProbe(
            ok=True,
            name=name,
            driver=None if driver is None else driver.text,
            device=device,
            why_no_ray_tracing=_why_no_ray_tracing(name, ("rayTrace", "1") in summary, driver),
        )
    return RenderProbe(ok=False, error=_why(refusals[-1]))


def _why_no_ray_tracing(name: str, has_extension: bool, driver: _Driver | None) -> str | None:
    """Why this device cannot draw ray traced pictures, as a clause; None if it can. Lavapipe has the extension too,
    but takes 10 s per picture with 2 samples per pixel (``rt-fast``, 512 x 512), 20 s to compile for each camera, and
    more than 9 minutes with 32 samples (``rt``)."""
    if not has_extension:
        return f"the driver of {name} has none"
    return f"{name} is a software driver" if driver is not None and driver.in_software else None


def _why(refusal: str) -> str:
    """SAPIEN's refusal, with advice if the environment names a driver."""
    for variable in DRIVER_VARIABLES:
        if os.environ.get(variable):
            return (
                f"{refusal} (the environment has {variable}={os.environ[variable]}: unset it, or correct it)"
            )
    return refusal


def _loads(library: str) -> bool:
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True


@dataclass(frozen=True)
class _Driver:
    text: str
    """Name and version of the driver."""
    in_software: bool


def _vulkan_drivers() -> dict[str, _Driver]:
    """Driver of every device that Vulkan lists, by device name. SAPIEN tells only the name of its device.

    Read from ``VkPhysicalDeviceDriverProperties`` (core since 1.2), with the C layout of Vulkan 1.2 on 64
    bits:
    VkApplicationInfo is 48 bytes with apiVersion at 44; VkInstanceCreateInfo is 64 bytes with the application info's
    address at 24;
    VkPhysicalDeviceDriverProperties has driverName (256 characters) at 20 and driverInfo at 276;
    VkPhysicalDeviceProperties2 has pNext at 8 and the properties at 16; within the properties, deviceType is
    at 16 and deviceName at 20.
    """
    try:
        vulkan = ctypes.CDLL(os.environ.get("SAPIEN_VULKAN_LIBRARY_PATH", "libvulkan.so.1"))
    except OSError:
        return {}
    version_1_2 = 1 << 22 | 2 << 12
    application = ctypes.create_string_buffer(48)
    struct.pack_into("=I", application, 44, version_1_2)
    create_info = ctypes.create_string_buffer(64)
    struct.pack_into("=I", create_info, 0, 1)
    struct.pack_into("=Q", create_info, 24, ctypes.addressof(application))
    instance = ctypes.c_void_p()
    if vulkan.vkCreateInstance(create_info, None, ctypes.byref(instance)) != 0:
        return {}
    count = ctypes.c_uint32(16)
    devices = (ctypes.c_void_p * 16)()
    vulkan.vkEnumeratePhysicalDevices(instance, ctypes.byref(count), devices)
    drivers: dict[str, _Driver] = {}
    vk_physical_device_type_cpu = 4
    for device in devices[: count.value]:
        driver = ctypes.create_string_buffer(1024)
        struct.pack_into("=I", driver, 0, 1000196000)
        properties = ctypes.create_string_buffer(4096)
        struct.pack_into("=I", properties, 0, 1000059001)
        struct.pack_into("=Q", properties, 8, ctypes.addressof(driver))
        vulkan.vkGetPhysicalDeviceProperties2(ctypes.c_void_p(device), properties)
        (type_of_device,) = struct.unpack_from("=I", properties, 16 + 16)
        drivers[_text(properties, 16 + 20)] = _Driver(
            ", ".join(filter(None, (_text(driver, 16 + 4), _text(driver, 276)))),
            type_of_device == vk_physical_device_type_cpu,
        )
    return drivers


def _text(buffer: ctypes.Array[ctypes.c_char], offset: int) -> str:
    return bytes(buffer)[offset : offset + 256].split(b"\0", 1)[0].decode(errors="replace")


def _answer() -> None:
    print("\n" + ANSWER + msgspec.json.encode(_look()).decode(), flush=True)


if __name__ == "__main__":
    _answer()
