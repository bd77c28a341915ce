"""``make test-gpu``: install a virtual environment with CUDA and PhysX's GPU library, and run this folder's checks.

Imports only the standard library, since it runs before anything is installed.
"""

from __future__ import annotations

import argparse
import ctypes
import os
import re
import shutil
import subprocess
import sys
import venv
from pathlib import Path

import tomllib

ROOT = Path(__file__).parents[2]
VENV = ROOT / ".venv-gpu"
PYTHON = VENV / "bin" / "python"
HOME = VENV / "home"
"""HOME during the checks: SAPIEN stores PhysX's GPU library there and not in the user's own home."""
TIMEOUT_MINUTES = 8
DOWNLOAD_TIMEOUT_SECONDS = 120
TEST_PACKAGES = ("pytest", "pytest-timeout")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--wheels", type=Path, help="install from the wheels in this folder, without a network"
    )
    parser.add_argument(
        "--physx-gpu", type=Path, help="PhysX's GPU library, libPhysXGpu_64.so, if it cannot be downloaded"
    )
    parser.add_argument(
        "--fetch", action="store_true", help="only fill the --wheels folder, on a machine with a network"
    )
    parser.add_argument("--for-python", default="3.12", help="with --fetch: Python version of the wheels")
    options, pytest_arguments = parser.parse_known_args()
    if options.fetch:
        fetch(options.wheels, options.for_python)
        return
    try:
        ctypes.CDLL("libcuda.so.1")
    except OSError:
        sys.exit("This machine has no CUDA driver (libcuda.so.1): nothing was tested.")
    install(options.wheels)
    place_physx(options.physx_gpu)
    command = [str(PYTHON), "-m", "pytest", "-m", "gpu", "-v", "-rs", "--timeout", "150", "tests/gpu"]
    environment = {**os.environ, "HOME": str(HOME), "MS_ASSET_DIR": str(assets())}
    done = subprocess.run(
        [
            "timeout",
            "--signal=INT",
            "--kill-after=20",
            str(60 * TIMEOUT_MINUTES),
            *command,
            *pytest_arguments,
        ],
        cwd=ROOT,
        env=environment,
    )
    if done.returncode in (124, 137):
        print(
            f"The checks did not end within {TIMEOUT_MINUTES} minutes; the results above are valid.",
            file=sys.stderr,
        )
    sys.exit(done.returncode)


def install(wheels: Path | None) -> None:
    """Install the workbench and its checks' requirements into `VENV`; use this Python's torch if it has CUDA."""
    own_torch = torch_has_cuda(sys.executable)
    if not PYTHON.exists():
        venv.create(VENV, with_pip=True)
    found = sorted(VENV.glob("lib/python*/site-packages"))
    # Appended after VENV's own packages; system_site_packages fails if this Python is itself a virtual environment.
    behind = [path for path in sys.path if path.endswith("-packages")] if own_torch else []
    (found[0] / "workbench.pth").write_text("\n".join([str(ROOT), *behind, ""]))
    where = []
    if wheels is not None:
        files = sorted(wheels.glob("*.whl"))
        if not files:
            sys.exit(
                f"There is no wheel in {wheels}: fill it with make gpu-wheels WHEELS=DIR on a machine with a network."
            )
        print(f"{wheels}: {len(files)} wheels, {sum(file.stat().st_size for file in files) / 1e6:.0f} MB")
        where = ["--no-index", "--find-links", str(wheels)]
    pinned = VENV / "constraints.txt"
    lines = (ROOT / "constraints.txt").read_text().splitlines(keepends=True)
    pinned.write_text("".join(line for line in lines if not (own_torch and line.startswith("torch=="))))
    command = [str(PYTHON), "-m", "pip", "install", "-q", "--disable-pip-version-check", "-c", str(pinned)]
    if subprocess.run([*command, *where, *requirements()]).returncode:
        sys.exit("The packages could not be installed: nothing was tested.")
    if not torch_has_cuda(str(PYTHON)):
        sys.exit("torch sees no CUDA device, or was built without CUDA: nothing was tested.")


def requirements() -> list[str]:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    return [*project["dependencies"], *project["optional-dependencies"]["maniskill"], *TEST_PACKAGES]


def torch_has_cuda(python: str) -> bool:
    code = "import sys, torch; sys.exit(not torch.cuda.is_available())"
    return subprocess.run([python, "-c", code], capture_output=True).returncode == 0


def place_physx(library: Path | None) -> None:
    """Put PhysX's GPU library where SAPIEN looks for it; without it the simulation checks are skipped with a reason."""
    version = output("import sapien.physx as p; print(p.version())")
    here = HOME / ".sapien" / "physx" / version / "libPhysXGpu_64.so"
    theirs = Path.home() / here.relative_to(HOME)
    if library is not None and not library.is_file():
        sys.exit(f"{library} is no file: PHYSX_GPU must name libPhysXGpu_64.so of PhysX {version}.")
    here.parent.mkdir(parents=True, exist_ok=True)
    if source := library or (theirs if theirs.exists() else None):
        # Copy to a temporary name first: a truncated copy would be taken for the library.
        shutil.copyfile(source, here.with_suffix(".part"))
        here.with_suffix(".part").replace(here)
    elif not here.exists():
        print("Downloading PhysX's GPU library, as SAPIEN does.", flush=True)
        try:
            subprocess.run(
                [str(PYTHON), "-c", "import sapien.physx as p; p.enable_gpu()"],
                env={**os.environ, "HOME": str(HOME)},
                timeout=DOWNLOAD_TIMEOUT_SECONDS,
                check=True,
                capture_output=True,
            )
        except (subprocess.CalledProcessError, subprocess.TimeoutExpired):
            print(
                f"The download failed: simulation checks are skipped, picture checks run. Without a network, "
                f"set PHYSX_GPU=FILE to the libPhysXGpu_64.so of PhysX {version}."
            )


def assets() -> Path:
    """Return ManiSkill's folder of downloads: the user's own, although the checks run with another HOME."""
    return Path(os.environ.get("MS_ASSET_DIR", Path.home() / ".maniskill"))


def output(code: str) -> str:
    return subprocess.run(
        [str(PYTHON), "-c", code], capture_output=True, text=True, check=True
    ).stdout.strip()


def fetch(folder: Path | None, python: str) -> None:
    """Fill a folder with the wheels of all `requirements` in the tested versions, except torch and CUDA."""
    if folder is None:
        sys.exit("--fetch needs --wheels, the folder to fill")
    folder.mkdir(parents=True, exist_ok=True)
    pins = dict(
        line.split("==")
        for line in (ROOT / "constraints.txt").read_text().split()
        if re.fullmatch(r"[\w.-]+==\S+", line)
    )
    normal = {re.sub(r"[-_.]+", "-", name).lower(): name for name in pins}
    wanted = [f"{normal[name]}=={pins[normal[name]]}" for name in sorted(needed() & set(normal))]
    platforms = [f"manylinux_2_{minor}_x86_64" for minor in (39, 38, 35, 34, 31, 28, 27, 24, 17)]
    command = [sys.executable, "-m", "pip", "download", "-q", "--disable-pip-version-check", "--no-deps"]
    command += [
        "--only-binary=:all:",
        "--python-version",
        python,
        "--implementation",
        "cp",
        "-d",
        str(folder),
    ]
    for platform in [*platforms, "manylinux2014_x86_64", "manylinux1_x86_64"]:
        command += ["--platform", platform]
    if subprocess.run([*command, *wanted]).returncode:
        sys.exit("Not every wheel could be downloaded.")
    size = sum(file.stat().st_size for file in folder.glob("*.whl"))
    print(
        f"{folder}: {len(wanted)} wheels for Python {python}, {size / 1e6:.0f} MB. torch is not among them."
    )


def needed() -> set[str]:
    """Return the installed packages that `requirements` need, except torch and what only torch needs."""
    from importlib.metadata import PackageNotFoundError, requires

    def name_of(requirement: str) -> str:
        match = re.match(r"[\w.-]+", requirement)
        assert match is not None, requirement
        return re.sub(r"[-_.]+", "-", match[0]).lower()

    found: set[str] = set()
    queue = [name_of(each) for each in requirements()]
    while queue:
        name = queue.pop()
        if name in found or name == "torch":
            continue
        try:
            further = requires(name) or []
        except PackageNotFoundError:
            continue  # for another platform, or of an extra
        found.add(name)
        queue += [name_of(each) for each in further if "extra ==" not in each]
    return found


if __name__ == "__main__":
    main()
