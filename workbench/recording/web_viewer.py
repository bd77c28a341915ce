"""rerun's web viewer as files on disk, packed once and kept.

The viewer is inside rerun's own command, which serves it when asked to, to every address by default and without
packing 43 MB of program. So the command is started for a moment on loopback, its three files are taken out, and each
is kept as gzip in a folder of the user's cache, one folder a version of rerun: whoever serves them then sends 14 MB
and reads no more of it than a block at a time. Fetching and packing takes about ten seconds, once for good.
"""

from __future__ import annotations

import gzip
import os
import shutil
import subprocess
import tempfile
import threading
import urllib.error
import urllib.request
from importlib.metadata import version
from pathlib import Path

from workbench.recording.rerun_process import (
    LOOPBACK,
    START_SECONDS,
    await_port,
    end,
    free_port,
    quiet_environment,
    rerun_command,
)

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


def viewer_file(name: str) -> Path:
    """The gzip of the file of the web viewer that is called `name`, one of `VIEWER_FILES`."""
    return web_viewer_folder() / f"{name}.gz"


def web_viewer_folder() -> Path:
    """Where the web viewer's files are, each packed as ``<name>.gz``; they are made at the first time.

    Raises:
        RuntimeError: rerun did not hand them over, or there is no room for them.
    """
    folder = _cache() / version("rerun-sdk")
    # One lock for all threads: a page asks for three files at once.
    with _packing:
        if not folder.is_dir():
            try:
                _keep(web_viewer_files(), folder)
            except OSError as error:
                raise RuntimeError(
                    f"rerun's web viewer could not be kept in {folder} ({error.strerror or error}); make room there, or name "
                    "another folder in XDG_CACHE_HOME."
                ) from error
    return folder


def is_kept() -> bool:
    """Whether `web_viewer_folder` answers at once."""
    return (_cache() / version("rerun-sdk")).is_dir()


def _cache() -> Path:
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "workbench" / "rerun-viewer"


def _keep(files: dict[str, bytes], folder: Path) -> None:
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
