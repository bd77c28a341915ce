"""Open recordings in rerun's own viewer, the one that came in the wheel, and only on this machine.

Where there is a screen the native viewer is one command. Over ssh there is none, and rerun can show
itself in a browser; but what it serves binds to every address by default, and its page asks other
hosts for fonts, for news of releases and to take usage statistics. So here every address is loopback,
and the page is served by a few lines of our own: rerun's three files as they are, the recordings
beside them, and a content security policy under which the browser talks to nobody else. The page lies
under a path that nobody can guess, because loopback is shared by all users of a machine.
"""

from __future__ import annotations

import os
import secrets
import socket
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

from workbench.recording.verify import quiet_environment, rerun_command

LOOPBACK = "127.0.0.1"
CONTENT_SECURITY_POLICY = (
    "default-src 'none'; script-src 'self' 'unsafe-inline' 'wasm-unsafe-eval'; style-src 'unsafe-inline'; "
    "connect-src 'self'; img-src 'self' data: blob:; font-src 'self' data:; worker-src 'self' blob:; "
    "frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
)
"""Inline scripts and ``wasm-unsafe-eval`` are how rerun's page starts its program (rerun 0.41)."""

_VIEWER_FILES = {
    "index.html": "text/html",
    "re_viewer.js": "text/javascript",
    "re_viewer_bg.wasm": "application/wasm",
}
_START_SECONDS = 20.0


@dataclass
class Viewer:
    """A viewer that runs; `wait` until its person is done with it, or `close` it."""

    url: str | None
    """Where to point a browser, or None for the native viewer, which has a window."""
    _process: subprocess.Popen[bytes] | None = None
    _server: ThreadingHTTPServer | None = None

    def wait(self) -> None:
        """Return when the native viewer's window is closed; a page is served until `close`.

        Raises:
            RuntimeError: the viewer ended by itself with an error.
        """
        if self._process is not None:
            if status := self._process.wait():
                raise RuntimeError(f"rerun's viewer ended with {status}; what it said is above.")
        else:
            threading.Event().wait()

    def close(self) -> None:
        if self._process is not None:
            _end(self._process)
        if self._server is not None:
            self._server.shutdown()
            self._server.server_close()


def open_in_rerun(paths: Sequence[Path], *, web: bool | None = None) -> Viewer:
    """Show the recordings at `paths` together: in a window where there is a screen, else in a page.

    Args:
        paths: one or more ``.rrd`` files.
        web: True or False chooses the page or the window; None looks for a screen.

    Raises:
        ValueError: `paths` is empty.
        FileNotFoundError: one of them is no file.
        RuntimeError: rerun did not start, or a window was asked for where there is no screen.
    """
    files = [Path(path).resolve() for path in paths]
    if not files:
        raise ValueError("No recording was named: give the path of one or more .rrd files.")
    for file in files:
        if not file.is_file():
            raise FileNotFoundError(f"{file} is not a file: give the path of an .rrd file.")
    if web is None:
        web = not has_screen(os.environ)
    elif not web and not has_screen(os.environ):
        # Rerun would listen, load and only then find out.
        raise RuntimeError(
            "There is no screen here (DISPLAY and WAYLAND_DISPLAY are empty); open the page instead."
        )
    return serve_web_viewer(files) if web else _open_window(files)


def has_screen(environment: Mapping[str, str]) -> bool:
    """Whether a window can be opened: always on Windows and macOS, elsewhere where a display is named."""
    if sys.platform in ("win32", "darwin"):
        return True
    return bool(environment.get("DISPLAY") or environment.get("WAYLAND_DISPLAY"))


def _open_window(files: Sequence[Path]) -> Viewer:
    port = free_port()
    command = [*rerun_command(), "--bind", LOOPBACK, "--port", str(port), "--hide-welcome-screen"]
    process = subprocess.Popen(
        [*command, *map(os.fspath, files)], env=quiet_environment(), stdin=subprocess.DEVNULL
    )
    _await_port(process, port)
    return Viewer(url=None, _process=process)


# --- the page -------------------------------------------------------------------------------------


def serve_web_viewer(files: Sequence[Path]) -> Viewer:
    """Serve rerun's web viewer with `files` on loopback; the url of the result opens them all."""
    pages = web_viewer_files()
    token = secrets.token_urlsafe(16)
    recordings = {f"{index}-{file.name}": file for index, file in enumerate(files)}
    server = ThreadingHTTPServer((LOOPBACK, 0), _handler(token, pages, recordings))
    server.daemon_threads = True
    threading.Thread(target=server.serve_forever, name="rerun page", daemon=True).start()
    root = f"http://{LOOPBACK}:{server.server_port}/{token}/"
    query = [("url", root + "recordings/" + urllib.parse.quote(name)) for name in recordings]
    query += [("hide_welcome_screen", "1"), ("persist", "0")]
    return Viewer(url=f"{root}?{urllib.parse.urlencode(query)}", _server=server)


def web_viewer_files() -> dict[str, bytes]:
    """The files of rerun's web viewer, by name: page, script and program (43 MB in rerun 0.41).

    They are inside rerun's command, which is started for a moment to hand them over.

    Raises:
        RuntimeError: it did not.
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
        _await_port(process, page_port)
        # A proxy that the environment names must not be asked for what lies on this machine.
        opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
        files = {}
        for name in _VIEWER_FILES:
            with opener.open(f"http://{LOOPBACK}:{page_port}/{name}", timeout=_START_SECONDS) as answer:
                files[name] = answer.read()
        return files
    except (urllib.error.URLError, OSError) as error:
        raise RuntimeError(
            f"rerun's web viewer could not be read ({error}); open the file on a desktop."
        ) from error
    finally:
        _end(process)


def _handler(
    token: str, pages: Mapping[str, bytes], recordings: Mapping[str, Path]
) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self._answer(body=True)

        def do_HEAD(self) -> None:
            self._answer(body=False)

        def _answer(self, body: bool) -> None:
            port = self.connection.getsockname()[1]
            # A foreign page whose name was made to point here (DNS rebinding) sends its own name along.
            if self.headers.get("Host") not in (f"{LOOPBACK}:{port}", f"localhost:{port}"):
                return self.send_error(HTTPStatus.FORBIDDEN)
            parts = urllib.parse.unquote(urllib.parse.urlsplit(self.path).path).lstrip("/").split("/")
            if not secrets.compare_digest(parts[0].encode(), token.encode()):
                return self.send_error(HTTPStatus.NOT_FOUND)
            name = parts[1] if len(parts) == 2 else ""
            if len(parts) == 2 and (name or "index.html") in pages:
                content = pages[name or "index.html"]
                self._head(_VIEWER_FILES[name or "index.html"], len(content))
                if body:
                    self.wfile.write(content)
            elif len(parts) == 3 and parts[1] == "recordings" and parts[2] in recordings:
                self._send_file(recordings[parts[2]], body)
            else:
                self.send_error(HTTPStatus.NOT_FOUND)

        def _send_file(self, path: Path, body: bool) -> None:
            try:
                file = path.open("rb")
            except OSError:  # moved away since the page was opened
                return self.send_error(HTTPStatus.NOT_FOUND)
            with file:
                self._head("application/octet-stream", os.fstat(file.fileno()).st_size)
                while body and (block := file.read(1 << 20)):
                    self.wfile.write(block)

        def _head(self, kind: str, length: int) -> None:
            self.send_response(HTTPStatus.OK)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(length))
            self.send_header("Content-Security-Policy", CONTENT_SECURITY_POLICY)
            self.send_header("X-Content-Type-Options", "nosniff")
            self.send_header("Referrer-Policy", "no-referrer")
            self.send_header("Cache-Control", "no-store")
            self.end_headers()

        def log_message(self, format: str, *args: object) -> None:
            """Say nothing: a line a request is no use to anyone, and holds the secret path."""

    return Handler


# --- processes ------------------------------------------------------------------------------------


def free_port() -> int:
    """A loopback port that was free a moment ago; rerun cannot be told to pick one and say which."""
    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        return probe.getsockname()[1]


def _await_port(process: subprocess.Popen[bytes], port: int) -> None:
    deadline = time.monotonic() + _START_SECONDS
    while time.monotonic() < deadline:
        if process.poll() is not None:
            raise RuntimeError(f"rerun ended with {process.returncode} before it was ready.")
        try:
            socket.create_connection((LOOPBACK, port), timeout=1.0).close()
            return
        except OSError:
            time.sleep(0.05)
    _end(process)
    raise RuntimeError(f"rerun was not ready within {_START_SECONDS:.0f} s.")


def _end(process: subprocess.Popen[bytes]) -> None:
    process.terminate()
    try:
        process.wait(timeout=5.0)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
