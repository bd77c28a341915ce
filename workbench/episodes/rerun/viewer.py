"""Runs rerun's own viewer in a window, and extracts its web viewer for a page."""

from __future__ import annotations

import gzip
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import IO

import rerun_cli

from workbench.machine.folders import cache_folder
from workbench.machine.processes.child_environment import child_environment, python_command
from workbench.machine.text import only_colours

LOOPBACK = "127.0.0.1"
START_SECONDS = 20.0
VIEWER_FILES = {
    "index.html": "text/html; charset=utf-8",
    "re_viewer.js": "text/javascript; charset=utf-8",
    "re_viewer_bg.wasm": "application/wasm",
}
"""Content type by name."""

VIEWER_POLICY = (
    "default-src 'none'; script-src 'self' 'unsafe-inline' 'wasm-unsafe-eval'; style-src 'unsafe-inline'; "
    "connect-src 'self'; img-src 'self' data: blob:; font-src 'self' data:; worker-src 'self' blob:; "
    "frame-ancestors 'self'; base-uri 'none'; form-action 'none'"
)
"""Content-Security-Policy that restricts rerun's page to its own server: by default the page loads fonts and
release notes and sends usage statistics. The page needs inline scripts and ``wasm-unsafe-eval`` to start its
program (rerun 0.41)."""
_packing = threading.Lock()


# --- rerun's command -------------------------------------------------------------------------------


def rerun_command() -> list[str]:
    """The command of the rerun version that this interpreter imports.

    A ``rerun`` on PATH may have another version, but file and viewer must be of the same version. ``python -m
    rerun_cli`` loses the exit status (rerun 0.41), and killing it leaves its program running.
    """
    for folder in rerun_cli.__path__:
        if (program := Path(folder, "rerun")).is_file():
            return [os.fspath(program)]
    return python_command("-m", "rerun")


def quiet_environment() -> dict[str, str]:
    """Environment in which rerun's command sends no usage statistics.

    Rerun has no variable for that alone; with ``CI`` set, rerun neither sends statistics nor asks about them,
    and keeps the user's settings (rerun 0.41, crate re_analytics).
    """
    environment = child_environment(CI="true")
    environment.pop("FORCE_RERUN_ANALYTICS", None)
    return environment


def free_port() -> int:
    """A free loopback port; rerun cannot choose one and report it."""
    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        return probe.getsockname()[1]


def await_port(process: subprocess.Popen[bytes], port: int) -> None:
    """Wait until `process` listens on `port`.

    Raises:
        RuntimeError: the process ended, or was killed after `START_SECONDS`.
    """
    deadline = time.monotonic() + START_SECONDS
    while time.monotonic() < deadline:
        if process.poll() is not None:
            raise RuntimeError(f"rerun ended with exit status {process.returncode} before it was ready.")
        try:
            socket.create_connection((LOOPBACK, port), timeout=1.0).close()
            return
        except OSError:
            time.sleep(0.05)
    end(process)
    raise RuntimeError(f"rerun was not ready within {START_SECONDS:.0f} s.")


def end(process: subprocess.Popen[bytes]) -> None:
    process.terminate()
    try:
        process.wait(timeout=5.0)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


# --- in a window -----------------------------------------------------------------------------------


@dataclass
class Viewer:
    """An open window."""

    _process: subprocess.Popen[bytes]
    _says: threading.Thread

    def wait(self) -> None:
        """Wait until the window is closed.

        Raises:
            RuntimeError: the viewer ended with an error.
        """
        # Poll, because a signal that the kernel delivers to another thread does not wake a blocking wait.
        while (status := self._process.poll()) is None:
            time.sleep(0.1)
        if status:
            self._says.join(timeout=5.0)
            raise RuntimeError(f"rerun's viewer ended with exit status {status}; its output is above.")

    def close(self) -> None:
        end(self._process)


def resolve_recordings(paths: Sequence[Path]) -> list[Path]:
    """Absolute paths of these recordings.

    Raises:
        ValueError: `paths` is empty, or one does not end in .rrd.
        FileNotFoundError: one of them is not a file.
    """
    files = [Path(path).resolve() for path in paths]
    if not files:
        raise ValueError("No recording given: give the path of one or more .rrd files.")
    for file in files:
        if not file.is_file():
            raise FileNotFoundError(f"{file} is not a file: give the path of an .rrd file.")
        if file.suffix != ".rrd":
            # The web viewer would show nothing, without an error.
            raise ValueError(f"{file} is not an .rrd file.")
    return files


def open_window(paths: Sequence[Path]) -> Viewer:
    """Show the recordings at `paths` together, in a window of rerun's viewer.

    Raises:
        ValueError, FileNotFoundError: see `resolve_recordings`.
        RuntimeError: there is no display, or rerun did not start.
    """
    files = resolve_recordings(paths)
    if not has_screen(os.environ):
        # Checked first, because rerun fails only after loading the files.
        raise RuntimeError(
            "There is no display here (DISPLAY and WAYLAND_DISPLAY are empty); open the page instead."
        )
    port = free_port()
    command = [*rerun_command(), "--bind", LOOPBACK, "--port", str(port), "--hide-welcome-screen"]
    process = subprocess.Popen(
        [*command, *map(os.fspath, files)],
        env=quiet_environment(),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
    )
    says = threading.Thread(target=_print_all, args=(process.stdout,), name="rerun-says", daemon=True)
    says.start()
    await_port(process, port)
    return Viewer(process, says)


def _print_all(output: IO[bytes]) -> None:
    """Print rerun's output without control characters, because it contains names from the file."""
    with output:
        for line in output:
            print(only_colours(line.decode(errors="replace")), end="", file=sys.stderr, flush=True)


def has_screen(environment: Mapping[str, str]) -> bool:
    """Whether a window can be opened: the environment names a display."""
    return bool(environment.get("DISPLAY") or environment.get("WAYLAND_DISPLAY"))


# --- in a page -------------------------------------------------------------------------------------


def viewer_file(name: str) -> Path:
    """Path of a gzipped file of the web viewer; `name` is a key of `VIEWER_FILES`."""
    return web_viewer_folder() / f"{name}.gz"


def web_viewer_folder() -> Path:
    """Folder of the web viewer's files ``<name>.gz``; the first call creates them, in about ten seconds.

    The files are embedded in rerun's command, which can only serve them, uncompressed (43 MB). So the command
    is started once per version of rerun, on loopback (by default it binds to every address), and the files
    are stored as gzip (14 MB) in the user's cache. `share.rerun_panel` serves them.

    Raises:
        RuntimeError: rerun did not serve the files, or they cannot be stored.
    """
    folder = _cache_path()
    # A page requests all files at once.
    with _packing:
        if not folder.is_dir():
            try:
                _write_cache(web_viewer_files(), folder)
            except OSError as error:
                raise RuntimeError(
                    f"rerun's web viewer could not be stored in {folder} ({error.strerror or error}); make room there, or set "
                    "another folder in XDG_CACHE_HOME."
                ) from error
    return folder


def viewer_is_cached() -> bool:
    """Whether the web viewer's files are stored already."""
    return _cache_path().is_dir()


def _cache_path() -> Path:
    return cache_folder() / "rerun-viewer" / version("rerun-sdk")


def _write_cache(files: dict[str, bytes], folder: Path) -> None:
    folder.parent.mkdir(parents=True, exist_ok=True)
    made = Path(tempfile.mkdtemp(prefix=".making-", dir=folder.parent))
    try:
        for name, content in files.items():
            (made / f"{name}.gz").write_bytes(gzip.compress(content, 6))
        # Rename at the end, so that other processes see a complete folder.
        made.rename(folder)
    except OSError:
        shutil.rmtree(made, ignore_errors=True)
        if not folder.is_dir():  # if it exists, another process has stored the same files
            raise


def web_viewer_files() -> dict[str, bytes]:
    """Contents of the web viewer's files by name: page, script and program (43 MB in rerun 0.41).

    Raises:
        RuntimeError: rerun's command did not serve them.
    """
    port, page_port = free_port(), free_port()
    command = [*rerun_command(), "--serve-web", "--bind", LOOPBACK, "--port", str(port)]
    process = subprocess.Popen(
        [*command, "--web-viewer-port", str(page_port)],
        env=quiet_environment(),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        await_port(process, page_port)
        # Ignore the environment's proxies: the files are on this machine.
        opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
        files = {}
        for name in VIEWER_FILES:
            with opener.open(f"http://{LOOPBACK}:{page_port}/{name}", timeout=START_SECONDS) as answer:
                files[name] = answer.read()
        return files
    except (urllib.error.URLError, OSError) as error:
        raise RuntimeError(
            f"rerun's web viewer could not be read ({error}); open the file on a desktop."
        ) from error
    finally:
        end(process)
