"""A software Vulkan driver for someone who is not root: apt's packages, unpacked into their own folder.

On a shared server nobody installs a package because one user wants camera pictures. apt needs root
for dpkg's database, not for fetching: with its lists and its cache in a folder of our own it resolves
what Mesa needs beyond what the machine has, checks the same signatures with the same keys, and
downloads. `dpkg-deb` unpacks. The Vulkan loader is then told of the driver by VK_DRIVER_FILES, and
the dynamic linker of its libraries by LD_LIBRARY_PATH, in the environment of the process that
renders and of no other. Deleting the folder undoes all of it.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

from workbench.machine.apt import AptFailed, PackageVersion, apt_get, available_versions
from workbench.machine.user_folder import cache_folder


def private_mesa_folder() -> Path:
    """Where the packages are unpacked: a folder of the user's cache."""
    return cache_folder() / "mesa"


def private_mesa_env() -> dict[str, str] | None:
    """The variables that make a new process use what `unpack_private_mesa` left; None if there is nothing."""
    return _env_of(private_mesa_folder())


def unpack_private_mesa(
    package: str, extra_source: str | None, choose: Callable[[list[PackageVersion]], PackageVersion | None]
) -> dict[str, str]:
    """Fetch `package` with the libraries that this machine lacks and unpack them into the user's cache.

    Args:
        package: the package that carries lavapipe.
        extra_source: a deb822 source to read besides the machine's own, or None.
        choose: picks one of the versions on offer, None if none will do.

    Returns:
        The variables that a process must be started with to render with it.

    Raises:
        AptFailed: nothing suitable on offer, or fetching or unpacking failed.
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
                f"{package} {version.version} brought no lavapipe driver ({len(archives)} packages)"
            )
        shutil.rmtree(target, ignore_errors=True)
        unpacked.rename(target)
    _point_manifests_into(target)
    env = _env_of(target)
    assert env is not None, "the manifests were there a moment ago"
    print(f"software Vulkan driver unpacked into {target}", file=sys.stderr)
    return env


def _private_apt(scratch: Path, extra_source: str | None) -> list[str]:
    """apt options that keep lists and cache in `scratch` and read the machine's sources and one more."""
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
    """Debian's manifest names the driver by its path on the system, or by a bare name that the linker seeks."""
    for manifest in _manifests(root):
        content = json.loads(manifest.read_text())
        driver = Path(content["ICD"]["library_path"]).name
        found = sorted(root.glob(f"usr/lib/**/{driver}"))
        if not found:
            raise AptFailed(f"{manifest.name} names {driver}, which the package does not carry")
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
