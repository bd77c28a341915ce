"""Making sure that SAPIEN can render: a software Vulkan driver where there is no other.

A machine whose driver works is left alone; that is settled by asking SAPIEN (render_device.py), not
by looking for files. Where nothing works, Mesa's software driver (lavapipe) does, from 24.3 on: from
the distribution if that has it, from Debian's backports suite otherwise. Root gets it installed with
apt. Anyone else gets the very same packages unpacked into a folder of their own (private_mesa.py),
and a pair of environment variables that the process which renders must be started with: they are in
`RenderProbe.env`, and ``python -m workbench.machine.software_vulkan --export`` prints them for a
shell.

Nothing here is fatal: a workbench without camera pictures is still a workbench. What could not be
done is said in `RenderProbe.error`, with the command to type.
"""

from __future__ import annotations

import os
import re
import shlex
import sys
from dataclasses import dataclass, replace
from pathlib import Path

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
from workbench.machine.private_mesa import private_mesa_env, unpack_private_mesa
from workbench.machine.render_device import (
    DRIVER_VARIABLES,
    SYSTEM_LIBRARIES,
    RenderProbe,
    probe_render_device,
)

MESA = "mesa-vulkan-drivers"
OLDEST_MESA = (24, 3)
"""SAPIEN 3.0.3 refuses lavapipe 22.3 and renders on 25.0.7; 24.3 is the first with what it asks for."""
BACKPORTS_FILE = Path("/etc/apt/sources.list.d/workbench-backports.sources")


@dataclass(frozen=True)
class MesaPlan:
    """Where a Mesa that is new enough comes from."""

    package: PackageVersion | None
    """None if it is known only after `source_to_add` has been added and read."""
    source_to_add: str | None = None
    """A deb822 source, or None if apt knows a good version already."""


def mesa_version(debian_version: str) -> tuple[int, int]:
    """``25.0.7-2~bpo12+1`` -> (25, 0), an epoch left out; (0, 0) if it does not begin with numbers."""
    match = re.match(r"(?:\d+:)?(\d+)\.(\d+)", debian_version)
    return (int(match[1]), int(match[2])) if match else (0, 0)


def first_good_mesa(versions: list[PackageVersion]) -> PackageVersion | None:
    """The newest of apt's versions that SAPIEN renders on."""
    return next((version for version in versions if mesa_version(version.version) >= OLDEST_MESA), None)


def plan_mesa() -> MesaPlan | None:
    """How to come by Mesa 24.3 or newer on this machine; None where this distribution has no way."""
    good = first_good_mesa(available_versions(MESA))
    if good is not None:
        return MesaPlan(good)
    source = backports_of_this_machine()
    return None if source is None else MesaPlan(None, source)


def ensure_render_device(install: bool) -> RenderProbe:
    """Find a render device, and with `install` bring what is missing. Slow only where it installs.

    Returns:
        The last probe. Where ``ok``, start the process that renders with ``probe.env`` added. Where not,
        ``error`` ends with what to do next.
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
        # The person chose a driver. Another one, installed beside it, would not be looked at anyway.
        return probe
    return _bring_mesa(probe, install)


def use_private_driver() -> None:
    """Let SAPIEN, in this process and in those that it starts, find the driver of a user who may not install one."""
    os.environ.update(ensure_render_device(install=False).env)


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
        else _with_advice(after, f"{MESA} {package.version} is installed and does not help.")
    )


def backports_of_this_machine() -> str | None:
    """The backports source that Debian's machines may need, None elsewhere."""
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
            f"{name} has no Mesa 24.3 or newer, which SAPIEN's software rendering needs. Debian 12 (backports) and "
            "13, and Ubuntu 24.04 with its updates, do; or install your GPU's Vulkan driver."
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
    """Bring a render device if there is none; ``--export`` prints shell lines for the variables it needs."""
    probe = ensure_render_device(install=True)
    if probe.ok:
        if "--export" not in sys.argv[1:]:
            print(f"SAPIEN renders on {probe.name} ({probe.driver or 'driver unknown'})")
        for name, value in probe.env.items():
            print(f"export {name}={shlex.quote(value)}")
    else:
        # Not an error for the shell: without a renderer everything but the camera pictures still works.
        print(f"SAPIEN cannot render here, so there are no camera pictures: {probe.error}", file=sys.stderr)


def _with_advice(probe: RenderProbe, advice: str) -> RenderProbe:
    return replace(probe, error=f"{probe.error}. {advice}")


if __name__ == "__main__":
    main()
