"""Builds HTTP responses: headers, refusals, files, and viser's page with our scripts in its head."""

from __future__ import annotations

import asyncio
import functools
import gzip
import html
import mimetypes
from collections.abc import Callable, Mapping
from http import HTTPStatus
from pathlib import Path
from urllib.parse import parse_qsl, unquote

from websockets.asyncio.server import ServerConnection
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from workbench.machine.folders import web_assets_folder
from workbench.machine.text import short_line
from workbench.page.door import access, viser_private
from workbench.page.door.connection_limits import RateLimitedLog
from workbench.page.door.file_response import FileReply, Handler, send_file

SCRIPTS = (
    "browser.js",
    "input.js",
    "panels.js",
)
"""Scripts of ``web_assets/`` injected into viser's index.html, in load order."""
STYLES = "panels/page.css"
"""Style sheet of ``web_assets/``. It is in the page's head, because viser removes an HTML element from the
page while the element's panel is folded."""

MAX_NAME_BYTES = 255
"""Maximum length of a file name in all common file systems."""
MAX_PATH_BYTES = 3000
"""Maximum length of a path below a folder."""


def request_parts(request: Request) -> access.RequestParts:
    """The parts of a request that `access` checks."""
    get = request.headers.get_all
    return access.RequestParts(
        path=request.path,
        host=get("Host"),
        origin=get("Origin"),
        cookie=get("Cookie"),
        fetch_site=get("Sec-Fetch-Site"),
        fetch_mode=get("Sec-Fetch-Mode"),
        fetch_dest=get("Sec-Fetch-Dest"),
        # Exactly viser's own test: a request that viser treats as a handshake must have been checked as one.
        websocket=get("Upgrade") == ["websocket"],
    )


def refusals(example: str) -> Callable[[str], Response]:
    """Returns a function that makes 403 replies with a reason; they tell the user to open the address ``example``."""
    folder = web_assets_folder()
    page = (folder / "refused.html").read_text(encoding="utf-8")
    page = page.replace("{{logo}}", (folder / "logo.svg").read_text(encoding="utf-8"))
    page = page.replace("{{example}}", html.escape(example))

    def refuse(reason: str) -> Response:
        body = page.replace("{{reason}}", html.escape(reason)).encode()
        return reply(403, "text/html; charset=utf-8", body, PAGE_OF_OURS)

    return refuse


def reply(status: int, kind: str, body: bytes, headers: Mapping[str, str], gzipped: bool = False) -> Response:
    extra = {"Content-Encoding": "gzip", "Vary": "Accept-Encoding"} if gzipped else {}
    fields = {"Content-Type": kind, "Content-Length": str(len(body)), **EVERY_REPLY, **extra, **headers}
    return Response(status, HTTPStatus(status).phrase, Headers(fields), body)


def entered_reply(entered: access.Entered) -> Response:
    cookie = {"Set-Cookie": entered.set_cookie, **PAGE_OF_OURS}
    if not entered.by_page:
        return reply(303, "text/plain; charset=utf-8", b"", {"Location": entered.location, **cookie})
    onward = f'<!doctype html><title>Workbench</title><meta http-equiv="refresh" content="0;url={html.escape(entered.location)}">'
    return reply(200, "text/html; charset=utf-8", onward.encode(), cookie)


async def admitted_reply(
    routes: Mapping[str, tuple[Handler, Mapping[str, str]]],
    viser_hook: viser_private.Hook,
    connection: ServerConnection,
    request: Request,
    authority: str,
    events_log: RateLimitedLog,
) -> Response:
    """The reply to an admitted request, from the route with the longest matching prefix; from viser if no
    route matches.

    Args:
        authority: the checked Host header, see `access.Admitted`.
    """
    page = {"Content-Security-Policy": page_policy(authority), "Cache-Control": "no-cache"}
    # Decode once, like viser: anything still encoded is part of a file name.
    path = unquote(request.path.partition("?")[0]).replace("\\", "/")
    if not _is_path_of_files(path):
        return _no_such_file(page)
    prefix = max((prefix for prefix in routes if path.startswith(prefix)), key=len, default=None)
    if prefix is None:
        response = viser_hook(connection, request)
        if response is None:  # viser treats the request as a handshake, but it was not checked as one
            return reply(400, "text/plain; charset=utf-8", b"Bad request.", page)
        if response.headers.get("Content-Type", "").startswith("text/html"):
            zipped = response.headers.get("Content-Encoding") == "gzip"
            # In a thread: compressing viser's page takes a while the first time.
            response.body = await asyncio.to_thread(with_our_head, bytes(response.body), zipped)
            del response.headers["Content-Length"]
            response.headers["Content-Length"] = str(len(response.body))
        for name, value in {**EVERY_REPLY, **page}.items():
            response.headers[name] = value
        return response
    handler, headers = routes[prefix]
    accepts_gzip = any("gzip" in value for value in request.headers.get_all("Accept-Encoding"))

    def work() -> Response | FileReply:
        try:
            made = handler(path[len(prefix) :], dict(parse_qsl(request.path.partition("?")[2])))
        except Exception as error:
            events_log.add(("route", prefix), f"The route {prefix} failed on {short_line(path, 200)}.", error)
            made = 500, "text/plain; charset=utf-8", b"This request failed; the terminal shows the error."
        if isinstance(made, FileReply):
            return made
        status, kind, body = made
        zip_it = accepts_gzip and len(body) > 1024 and _compresses(kind)
        return reply(status, kind, gzip.compress(body, 6) if zip_it else body, {**page, **headers}, zip_it)

    # In a thread: reading and compressing would block every page's websocket.
    made = await asyncio.to_thread(work)
    if isinstance(made, Response):
        return made
    fields = {**EVERY_REPLY, **page, **headers}
    return await send_file(connection, made, fields, accepts_gzip, lambda: _no_such_file(page))


def _is_path_of_files(path: str) -> bool:
    """Whether a file below a folder could have this path. False for a path with ``..``, and for a path on
    which the system would raise: too long, or with a NUL."""
    parts = path.encode("utf-8", "surrogatepass").split(b"/")
    return (
        b".." not in parts
        and "\0" not in path
        and all(len(part) <= MAX_NAME_BYTES for part in parts)
        and sum(map(len, parts)) <= MAX_PATH_BYTES
    )


def _no_such_file(headers: Mapping[str, str]) -> Response:
    return reply(404, "text/plain; charset=utf-8", b"There is no such file.", headers)


@functools.lru_cache(maxsize=4)
def with_our_head(page: bytes, zipped: bool) -> bytes:
    """viser's page with `STYLES` and `SCRIPTS` in its head; viser itself has no way to add them.

    Raises:
        ValueError: the page has no head, so the viser version is unknown.
    """
    plain = gzip.decompress(page) if zipped else page
    before, head_end, after = plain.partition(b"</head>")
    if not head_end:
        raise ValueError("viser's page has no </head>, which every tested version has.")
    tags = f'<link rel="stylesheet" href="/workbench/{STYLES}">'
    tags += "".join(f'<script src="/workbench/{name}"></script>' for name in SCRIPTS)
    plain = before + tags.encode() + head_end + after
    return gzip.compress(plain, 6) if zipped else plain


def _compresses(kind: str) -> bool:
    plain = kind.partition(";")[0]
    return plain.startswith("text/") or plain in (
        "application/json",
        "application/javascript",
        "application/wasm",
        "image/svg+xml",
    )


def folder_handler(folder: Path) -> Callable[[str, Mapping[str, str]], tuple[int, str, bytes]]:
    """A handler that serves the files below ``folder``; it does not follow links to files outside."""
    root = folder.resolve()

    def handle(path: str, query: Mapping[str, str]) -> tuple[int, str, bytes]:
        try:
            file = (root / path.lstrip("/")).resolve()
        except RuntimeError:  # a symlink loop
            file = root
        if not file.is_relative_to(root) or not file.is_file():
            return 404, "text/plain; charset=utf-8", b"There is no such file."
        return 200, content_type(file.name), file.read_bytes()

    return handle


def content_type(name: str) -> str:
    """Content type by suffix. The system's table may list JavaScript as plain text, which browsers refuse to run."""
    known = {
        ".css": "text/css; charset=utf-8",
        ".html": "text/html; charset=utf-8",
        ".js": "text/javascript; charset=utf-8",
        ".json": "application/json",
        ".svg": "image/svg+xml",
        ".wasm": "application/wasm",
        ".webp": "image/webp",
    }
    return known.get(Path(name).suffix.lower()) or mimetypes.guess_type(name)[0] or "application/octet-stream"


# --- Security headers ------------------------------------------------------------------------------


def _scripts() -> str:
    """Source list of the scripts that may run in the page. If viser's version is unknown, all scripts may run
    (`unknown_page_text`)."""
    known = viser_private.page_scripts()
    if known is None:
        return "'unsafe-inline'"
    return " ".join(f"'sha256-{one}'" for one in known)


# Everything that is not listed is forbidden, and each exception is needed: `tests/page/door/test_page_policy.py` removes
# them one by one and finds the page broken.
# - script-src: our own files and viser's program, by the hashes of its two scripts (`_scripts`). Not
#   unsafe-inline: a script in a name, a note or a file that slipped past escaping still would not run.
#   wasm-unsafe-eval is for the program that decodes the server's messages. eval stays forbidden: viser needs
#   it for Gaussian splats and Plotly, which the workbench does not use (web_assets/browser.js).
# - worker-src blob: viser's connection and its sorting run in workers made from strings.
# - style-src 'unsafe-inline': viser's widgets and our HTML have inline styles; a style runs no code.
# - img-src data: blob: pictures from the websocket, and viser's icons.
# - connect-src: only this server. viser's page would connect to any server that its address names
#   (?websocket=, ?playbackPath=). data: and blob: are textures and programs of the page. The websocket is
#   listed for browsers where 'self' excludes ws:.
# - frame-src 'self': rerun's viewer.
DIRECTIVES: dict[str, str] = {
    "default-src": "'none'",
    "script-src": f"'self' 'wasm-unsafe-eval' {_scripts()}",
    "worker-src": "blob:",
    "style-src": "'self' 'unsafe-inline'",
    "img-src": "'self' data: blob:",
    "connect-src": "'self' data: blob: ws://{authority} wss://{authority}",
    "frame-src": "'self'",
    "base-uri": "'none'",
    "form-action": "'none'",
    "frame-ancestors": "'self'",
}


def page_policy(authority: str) -> str:
    """Content-Security-Policy of viser's page on ``authority`` (``host:port``, known to be ours)."""
    parts = (f"{name} {sources}" for name, sources in DIRECTIVES.items())
    return "; ".join(parts).replace("{authority}", authority)


EVERY_REPLY = {
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "X-Frame-Options": "SAMEORIGIN",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Permissions-Policy": ", ".join(
        f"{feature}=()"
        for feature in (
            *("accelerometer", "autoplay", "browsing-topics", "camera", "display-capture", "encrypted-media"),
            *("geolocation", "gyroscope", "hid", "identity-credentials-get", "idle-detection"),
            *("local-fonts", "magnetometer", "microphone", "midi", "payment", "picture-in-picture"),
            *(
                "publickey-credentials-get",
                "screen-wake-lock",
                "serial",
                "storage-access",
                "usb",
                "xr-spatial-tracking",
            ),
        )
    )
    + ", clipboard-write=(self), fullscreen=(self), gamepad=(self)",
    "Connection": "close",
}
"""Headers of every reply, including refusals: no MIME sniffing, no referrer, no framing, opening or embedding by other
sites, no devices but gamepads."""
PAGE_OF_OURS = {
    "Content-Security-Policy": "default-src 'none'; style-src 'unsafe-inline'; img-src data:; base-uri 'none'; "
    "form-action 'none'; frame-ancestors 'self'",
    "Cache-Control": "no-store",
}
"""Headers of a refusal and of the reply that sets the cookie."""
