"""Rerun's own viewer, which its wheel brings along as a command: in a window on a screen, or as files for a page.

What rerun serves binds to every address by default; here it is told loopback. Its web viewer is inside the command, which
serves it when asked to, without packing 43 MB of program. So the command is started for a moment, its three files are
taken out, and each is kept as gzip in a folder of the user's cache, one folder a version of rerun: whoever serves them
then (`workbench.ui.share.rerun_view`) sends 14 MB and reads no more of it than a block at a time. Fetching and packing takes
about ten seconds, once for good.
"""

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

from workbench.machine.processes.child_python import child_environment, python_command
from workbench.machine.text import only_colours
from workbench.machine.user_folder import cache_folder

LOOPBACK = "127.0.0.1"
START_SECONDS = 20.0
VIEWER_FILES = {
    "index.html": "text/html; charset=utf-8",
    "re_viewer.js": "text/javascript; charset=utf-8",
    "re_viewer_bg.wasm": "application/wasm",
}
"""Name to content type."""

VIEWER_POLICY = (
    "default-src 'none'; script-src 'self' 'unsafe-inline' 'wasm-unsafe-eval'; style-src 'unsafe-inline'; "
    "connect-src 'self'; img-src 'self' data: blob:; font-src 'self' data:; worker-src 'self' blob:; "
    "frame-ancestors 'self'; base-uri 'none'; form-action 'none'"
)
"""Content-Security-Policy under which rerun's page runs and talks to nobody but who served it: by itself it asks for
fonts, for news of releases, and sends usage statistics. Inline scripts and ``wasm-unsafe-eval`` are how the page starts
its program (rerun 0.41)."""
_packing = threading.Lock()


# --- its command -----------------------------------------------------------------------------------


def rerun_command() -> list[str]:
    """The command of the rerun that this interpreter imports.

    A ``rerun`` on PATH may belong to another environment and another version, and file and viewer go
    together by version. The program itself and not ``python -m rerun_cli``: that one forgets the exit
    status (rerun 0.41), and ending it would leave the program that it started behind.
    """
    for folder in rerun_cli.__path__:
        if (program := Path(folder, "rerun")).is_file():
            return [os.fspath(program)]
    return python_command("-m", "rerun")


def quiet_environment() -> dict[str, str]:
    """The environment in which rerun's command sends no usage statistics.

    Rerun has no variable for just that; but where ``CI`` is set it neither sends nor asks, and leaves
    the person's own settings for rerun as they are (rerun 0.41, crate re_analytics).
    """
    environment = child_environment(CI="true")
    environment.pop("FORCE_RERUN_ANALYTICS", None)
    return environment


def free_port() -> int:
    """A loopback port that was free a moment ago; rerun cannot be told to pick one and say which."""
    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        return probe.getsockname()[1]


def await_port(process: subprocess.Popen[bytes], port: int) -> None:
    """Return when `process` listens on `port`.

    Raises:
        RuntimeError: it ended before, or took too long (and was ended).
    """
    deadline = time.monotonic() + START_SECONDS
    while time.monotonic() < deadline:
        if process.poll() is not None:
            raise RuntimeError(f"rerun ended with {process.returncode} before it was ready.")
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
    """A window that is open; `wait` until its person is done with it, or `close` it."""

    _process: subprocess.Popen[bytes]
    _says: threading.Thread

    def wait(self) -> None:
        """Return when the window is closed.

        Raises:
            RuntimeError: the viewer ended by itself with an error.
        """
        # Not for ever in one go: a signal that the kernel hands to another thread does not wake this one.
        while (status := self._process.poll()) is None:
            time.sleep(0.1)
        if status:
            self._says.join(timeout=5.0)
            raise RuntimeError(f"rerun's viewer ended with {status}; what it said is above.")

    def close(self) -> None:
        end(self._process)


def resolve_recordings(paths: Sequence[Path]) -> list[Path]:
    """These recordings, in full.

    Raises:
        ValueError: `paths` is empty, or one is no .rrd file by its name.
        FileNotFoundError: one of them is no file.
    """
    files = [Path(path).resolve() for path in paths]
    if not files:
        raise ValueError("No recording was named: give the path of one or more .rrd files.")
    for file in files:
        if not file.is_file():
            raise FileNotFoundError(f"{file} is not a file: give the path of an .rrd file.")
        if file.suffix != ".rrd":
            # A page would show nothing of it, and say nothing.
            raise ValueError(f"{file} is no .rrd file.")
    return files


def open_window(paths: Sequence[Path]) -> Viewer:
    """Show the recordings at `paths` together, in a window of rerun's viewer.

    Raises:
        ValueError, FileNotFoundError: see `resolve_recordings`.
        RuntimeError: there is no screen here, or rerun did not start.
    """
    files = resolve_recordings(paths)
    if not has_screen(os.environ):
        # Rerun would listen, load and only then find out.
        raise RuntimeError(
            "There is no screen here (DISPLAY and WAYLAND_DISPLAY are empty); open the page instead."
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
    """What rerun says of a file has names from the file in it."""
    with output:
        for line in output:
            print(only_colours(line.decode(errors="replace")), end="", file=sys.stderr, flush=True)


def has_screen(environment: Mapping[str, str]) -> bool:
    """Whether a window can be opened: where a display is named."""
    return bool(environment.get("DISPLAY") or environment.get("WAYLAND_DISPLAY"))


# --- in a page -------------------------------------------------------------------------------------


def viewer_file(name: str) -> Path:
    """The gzip of the file of the web viewer that is called `name`, one of `VIEWER_FILES`."""
    return web_viewer_folder() / f"{name}.gz"


def web_viewer_folder() -> Path:
    """Where the web viewer's files are, each packed as ``<name>.gz``; they are made at the first time.

    Raises:
        RuntimeError: rerun did not hand them over, or there is no room for them.
    """
    folder = _cache_path()
    # One lock for all threads: a page asks for three files at once.
    with _packing:
        if not folder.is_dir():
            try:
                _write_cache(web_viewer_files(), folder)
            except OSError as error:
                raise RuntimeError(
                    f"rerun's web viewer could not be kept in {folder} ({error.strerror or error}); make room there, or name "
                    "another folder in XDG_CACHE_HOME."
                ) from error
    return folder


def viewer_is_cached() -> bool:
    """Whether `web_viewer_folder` answers at once."""
    return _cache_path().is_dir()


def _cache_path() -> Path:
    return cache_folder() / "rerun-viewer" / version("rerun-sdk")


def _write_cache(files: dict[str, bytes], folder: Path) -> None:
    folder.parent.mkdir(parents=True, exist_ok=True)
    made = Path(tempfile.mkdtemp(prefix=".making-", dir=folder.parent))
    try:
        for name, content in files.items():
            (made / f"{name}.gz").write_bytes(gzip.compress(content, 6))
        # All three or none: another process sees a whole folder under this name.
        made.rename(folder)
    except OSError:
        shutil.rmtree(made, ignore_errors=True)
        if not folder.is_dir():  # else another process was quicker, with the same files
            raise


def web_viewer_files() -> dict[str, bytes]:
    """The files of rerun's web viewer, by name: page, script and program (43 MB in rerun 0.41).

    Raises:
        RuntimeError: rerun's command did not hand them over.
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
        # A proxy that the environment names must not be asked for what lies on this machine.
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
