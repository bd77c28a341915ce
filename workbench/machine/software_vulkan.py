"""Provides a software Vulkan driver (Mesa lavapipe) where SAPIEN finds no other."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import platform
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path

import msgspec

from workbench.machine.apt import (
    AptFailed,
    PackageVersion,
    apt_get,
    apt_install,
    available_versions,
    backports_source,
    can_install_packages,
    has_apt,
    os_release,
    read_apt_sources,
)
from workbench.machine.folders import cache_folder, read_private, write_private
from workbench.machine.render_probe import (
    DRIVER_VARIABLES,
    SYSTEM_LIBRARIES,
    RenderProbe,
    driver_files,
    probe_render_device,
)
from workbench.machine.versions import installed


def private_mesa_folder() -> Path:
    """Folder in the user's cache where the packages are unpacked."""
    return cache_folder() / "mesa"


def private_mesa_env() -> dict[str, str] | None:
    """Environment variables with which a new process uses the driver of `unpack_private_mesa`; None without such a driver."""
    return _env_of(private_mesa_folder())


def unpack_private_mesa(
    package: str, extra_source: str | None, choose: Callable[[list[PackageVersion]], PackageVersion | None]
) -> dict[str, str]:
    """Fetch `package` with the libraries that this machine lacks and unpack them into the user's cache.

    apt needs root for dpkg's database, not for fetching: with lists and cache in a separate folder it
    resolves dependencies, checks the same signatures and downloads; `dpkg-deb` unpacks. VK_DRIVER_FILES and
    LD_LIBRARY_PATH then point the process that renders to driver and libraries. Deleting the folder undoes
    everything.

    Args:
        package: the package with lavapipe.
        extra_source: a deb822 source in addition to the machine's, or None.
        choose: picks one of the available versions; returns None if none is suitable.

    Returns:
        The environment variables with which a process renders with this driver.

    Raises:
        AptFailed: no suitable version is offered, or fetching or unpacking failed.
    """
    target = private_mesa_folder()
    target.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=target.parent, prefix="mesa-") as scratch_name:
        scratch = Path(scratch_name)
        options = _private_apt(scratch, extra_source)
        apt_get(["update"], options)
        version = choose(available_versions(package, options))
        if version is None:
            raise AptFailed(f"apt's sources offer no {package} that is new enough")
        wanted = [
            "--download-only",
            "--no-install-recommends",
            "-t",
            version.suite,
            f"{package}={version.version}",
        ]
        apt_get(["install", *wanted], options)
        archives = sorted((scratch / "cache" / "archives").glob("*.deb"))
        unpacked = scratch / "root"
        for archive in archives:
            done = subprocess.run(
                ["dpkg-deb", "-x", str(archive), str(unpacked)], capture_output=True, text=True
            )
            if done.returncode != 0:
                raise AptFailed(f"{archive.name} could not be unpacked: {done.stderr.strip()}")
        if not list(_manifests(unpacked)):
            raise AptFailed(
                f"{package} {version.version} contains no lavapipe driver ({len(archives)} packages unpacked)"
            )
        shutil.rmtree(target, ignore_errors=True)
        unpacked.rename(target)
    _point_manifests_into(target)
    env = _env_of(target)
    assert env is not None, "the manifests were there a moment ago"
    print(f"software Vulkan driver unpacked into {target}", file=sys.stderr)
    return env


def _private_apt(scratch: Path, extra_source: str | None) -> list[str]:
    """apt options that keep lists and cache in `scratch`, with the machine's sources and `extra_source`."""
    for folder in ("lists/partial", "cache/archives/partial", "sources"):
        (scratch / folder).mkdir(parents=True)
    machine = Path("/etc/apt")
    if (machine / "sources.list").is_file():
        shutil.copy(machine / "sources.list", scratch / "sources" / "machine.list")
    for path in (machine / "sources.list.d").glob("*"):
        if path.suffix in (".list", ".sources") and os.access(path, os.R_OK):
            shutil.copy(path, scratch / "sources" / path.name)
    if extra_source is not None:
        (scratch / "sources" / "workbench-backports.sources").write_text(extra_source)
    settings = {
        "Dir::State::lists": scratch / "lists",
        "Dir::Cache": scratch / "cache",
        "Dir::Etc::sourcelist": "/dev/null",
        "Dir::Etc::sourceparts": scratch / "sources",
        "Debug::NoLocking": "true",
    }
    return [part for name, value in settings.items() for part in ("-o", f"{name}={value}")]


def _manifests(root: Path) -> list[Path]:
    return sorted((root / "usr/share/vulkan/icd.d").glob("lvp_icd*.json"))


def _point_manifests_into(root: Path) -> None:
    """Write the path of the unpacked driver into the manifests: Debian's contain a system path or a bare
    library name."""
    for manifest in _manifests(root):
        content = json.loads(manifest.read_text())
        driver = Path(content["ICD"]["library_path"]).name
        found = sorted(root.glob(f"usr/lib/**/{driver}"))
        if not found:
            raise AptFailed(f"{manifest.name} names {driver}, which the package does not contain")
        content["ICD"]["library_path"] = str(found[0])
        manifest.write_text(json.dumps(content))


def _env_of(root: Path) -> dict[str, str] | None:
    manifests = _manifests(root)
    if not manifests:
        return None
    folders = sorted(
        {str(path.parent) for base in ("usr/lib", "lib") for path in root.glob(f"{base}/**/*.so*")}
    )
    inherited = [part for part in os.environ.get("LD_LIBRARY_PATH", "").split(os.pathsep) if part]
    kept = [part for part in inherited if part not in folders]
    return {
        "VK_DRIVER_FILES": os.pathsep.join(map(str, manifests)),
        "LD_LIBRARY_PATH": os.pathsep.join([*folders, *kept]),
    }


# --- providing a render device ---------------------------------------------------------------------


MESA = "mesa-vulkan-drivers"
OLDEST_MESA = (24, 3)
"""SAPIEN 3.0.3 refuses lavapipe 22.3 and renders on 25.0.7; 24.3 is the first version with what SAPIEN needs."""
BACKPORTS_FILE = Path("/etc/apt/sources.list.d/workbench-backports.sources")


@dataclass(frozen=True)
class MesaPlan:
    """Source of a Mesa that is new enough."""

    package: PackageVersion | None
    """Version to install; None if it is known only after `source_to_add` has been read."""
    source_to_add: str | None = None
    """A deb822 source, or None if apt already offers a good version."""


def mesa_version(debian_version: str) -> tuple[int, int]:
    """Major and minor version, without the epoch: (25, 0) for ``25.0.7-2~bpo12+1``; (0, 0) for an unknown
    form."""
    match = re.match(r"(?:\d+:)?(\d+)\.(\d+)", debian_version)
    return (int(match[1]), int(match[2])) if match else (0, 0)


def first_good_mesa(versions: list[PackageVersion]) -> PackageVersion | None:
    """The newest of these versions that SAPIEN renders on; None if there is none."""
    return next((version for version in versions if mesa_version(version.version) >= OLDEST_MESA), None)


def plan_mesa() -> MesaPlan | None:
    """Source of Mesa 24.3 or newer on this machine; None if the distribution has none."""
    good = first_good_mesa(available_versions(MESA))
    if good is not None:
        return MesaPlan(good)
    source = backports_of_this_machine()
    return None if source is None else MesaPlan(None, source)


def ensure_render_device(install: bool) -> RenderProbe:
    """Find a render device, and with `install` provide what is missing.

    A working driver is left alone. Without one, Mesa's lavapipe (24.3 or newer) is used, from the distribution or from
    Debian's backports. For root it is installed with apt. For other users it is unpacked into the user's cache; the process
    that renders then needs `RenderProbe.env` (``python -m workbench.machine.software_vulkan --export`` prints it for a shell).

    Returns:
        The last probe. If it is ``ok``, add its ``env`` to the environment of the process that renders. If
        not, its ``error`` ends with what to do next.
    """
    probe = probe_render_device()
    if probe.missing_libraries and install and can_install_packages():
        probe = _install_libraries(probe)
    if probe.ok:
        return probe
    if probe.missing_libraries:
        packages = " ".join(SYSTEM_LIBRARIES[library] for library in probe.missing_libraries)
        return _with_advice(probe, f"Type: sudo apt-get install {packages}")
    if any(os.environ.get(variable) for variable in DRIVER_VARIABLES):
        # The environment names a driver: another one, even if installed, would not be used.
        return probe
    return _bring_mesa(probe, install)


def use_private_driver() -> None:
    """Let SAPIEN in this process and its children find a driver that was unpacked for this user."""
    os.environ.update(known_render_device(install=False).env)


def known_render_device(install: bool) -> RenderProbe:
    """The result of `ensure_render_device`, cached on disk until something that determines it changes.

    A probe imports SAPIEN and makes a Vulkan device, and `make open` needs the result twice before the worker
    starts. If a device fails although nothing changed, the worker, a separate process, reports it.
    """
    # One file per environment: with a driver in the user's cache, `make open` probes again with the driver's
    # variables.
    name = f"render-device-{hashlib.blake2b(repr(_what_decides()).encode(), digest_size=8).hexdigest()}.json"
    with contextlib.suppress(OSError, msgspec.MsgspecError):
        if (kept := read_private(name, cache_folder())) is not None:
            return msgspec.json.decode(kept, type=RenderProbe)
    probe = ensure_render_device(install)
    if probe.ok:
        # A full disk, or another user's folder: the next process probes again.
        with contextlib.suppress(OSError):
            write_private(name, msgspec.json.encode(probe), cache_folder())
    return probe


def _what_decides() -> list[str]:
    """Everything that determines the cached result: the kernel, the Python environment, environment
    variables, driver files with their modification times, devices, the versions of SAPIEN and torch, and the
    fields of `RenderProbe`."""
    named = (*DRIVER_VARIABLES, "LD_LIBRARY_PATH", "SAPIEN_VULKAN_LIBRARY_PATH", "CUDA_VISIBLE_DEVICES")
    files = [*driver_files(), *_manifests(private_mesa_folder())]
    devices = [*Path("/dev").glob("nvidia*"), *Path("/dev/dri").glob("*")]
    return [
        platform.release(),
        sys.prefix,
        *(f"{name}={os.environ.get(name, '')}" for name in named),
        *(f"{file} {file.stat().st_mtime_ns}" for file in files if file.exists()),
        *sorted(map(str, devices)),
        *(f"{name} {installed(name)}" for name in ("sapien", "torch")),
        *(field.name for field in fields(RenderProbe)),
    ]


def _install_libraries(probe: RenderProbe) -> RenderProbe:
    try:
        apt_install(*(SYSTEM_LIBRARIES[name] for name in probe.missing_libraries))
    except AptFailed as failure:
        return replace(probe, error=f"{probe.error}; {failure}")
    return probe_render_device()


def _bring_mesa(probe: RenderProbe, install: bool) -> RenderProbe:
    private = private_mesa_env()
    if private is not None and (probe_with := probe_render_device(private)).ok:
        return probe_with
    if not install:
        return _with_advice(probe, "Type: python -m workbench.machine.software_vulkan")
    if not has_apt():
        return _with_advice(
            probe, "Install Mesa 24.3 or newer with its Vulkan drivers (lavapipe) from your distribution."
        )
    try:
        if can_install_packages():
            return _install_mesa(probe)
        env = unpack_private_mesa(MESA, backports_of_this_machine(), first_good_mesa)
    except AptFailed as failure:
        return _with_advice(probe, f"{failure}\n{_command_to_type()}")
    return probe_render_device(env)


def _install_mesa(probe: RenderProbe) -> RenderProbe:
    apt_get(["update"])
    plan = plan_mesa()
    if plan is None:
        return _with_advice(probe, _command_to_type())
    package = plan.package
    if plan.source_to_add is not None:
        BACKPORTS_FILE.write_text(plan.source_to_add)
        apt_get(["update"])
        package = first_good_mesa(available_versions(MESA))
    if package is None:
        return _with_advice(probe, f"the mirror's backports suite has no {MESA} that is new enough")
    apt_get(["install", "--no-install-recommends", "-t", package.suite, f"{MESA}={package.version}"])
    after = probe_render_device()
    return (
        after
        if after.ok
        else _with_advice(after, f"{MESA} {package.version} is installed, but SAPIEN still cannot render.")
    )


def backports_of_this_machine() -> str | None:
    """The backports source that a Debian machine may need; None on other machines."""
    release = os_release()
    if release.get("ID") != "debian":
        return None
    return backports_source(read_apt_sources(), release.get("VERSION_CODENAME", ""))


def _command_to_type() -> str:
    release = os_release()
    plan = plan_mesa()
    if plan is None:
        name = release.get("PRETTY_NAME", "this system")
        return (
            f"{name} has no Mesa 24.3 or newer, which SAPIEN's software rendering needs. Debian 12 "
            "(backports), Debian 13 and Ubuntu 24.04 (updates) have it. Or install your GPU's Vulkan driver."
        )
    if plan.package is not None:
        return f"Type: sudo apt-get install -t {plan.package.suite} {MESA}"
    suite = f"{release['VERSION_CODENAME']}-backports"
    lines = shlex.quote(plan.source_to_add or "")
    return (
        f"Type: printf %s {lines} | sudo tee {BACKPORTS_FILE} && sudo apt-get update && "
        f"sudo apt-get install -t {suite} {MESA}"
    )


def main() -> None:
    """Provide a render device if there is none. Prints the device, and the shell lines that set its
    variables; with ``--export`` only these lines."""
    export = "--export" in sys.argv[1:]
    probe = known_render_device(install=True) if export else ensure_render_device(install=True)
    if probe.ok:
        if not export:
            print(f"SAPIEN renders on {probe.name} ({probe.driver or 'driver unknown'})")
        for name, value in probe.env.items():
            print(f"export {name}={shlex.quote(value)}")
    else:
        # Not an error for the shell: without a renderer everything except camera pictures works.
        print(f"SAPIEN cannot render here, so there are no camera pictures: {probe.error}", file=sys.stderr)


def _with_advice(probe: RenderProbe, advice: str) -> RenderProbe:
    return replace(probe, error=f"{probe.error}. {advice}")


if __name__ == "__main__":
    main()
