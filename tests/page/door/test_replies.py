"""The reply to an admitted request, as a function; `test_gated_server` tests it over real sockets."""

from __future__ import annotations

import asyncio
import gzip
import html
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import pytest
from websockets.asyncio.server import ServerConnection
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from workbench.page.door.connection_limits import RateLimitedLog
from workbench.page.door.file_response import Handler
from workbench.page.door.responses import (
    EVERY_REPLY,
    MAX_NAME_BYTES,
    MAX_PATH_BYTES,
    PAGE_OF_OURS,
    SCRIPTS,
    STYLES,
    admitted_reply,
    folder_handler,
    page_policy,
    refusals,
    request_parts,
)

AUTHORITY = "localhost:8080"
PAGE = b"<html><head><title>viser</title></head><body></body></html>"
NO_SUCH_FILE = b"There is no such file."


def of_viser(kind: str = "text/html; charset=utf-8", body: bytes = PAGE, **headers: str) -> Any:
    """viser's own reply to any request."""
    fields = {"Content-Type": kind, "Content-Length": str(len(body)), **headers}
    return lambda connection, request: Response(200, "OK", Headers(fields), body)


def answer(
    path: str,
    routes: Mapping[str, tuple[Handler, Mapping[str, str]]] | None = None,
    viser_hook: Any = None,
    accepts: str = "",
) -> Response:
    request = Request(path, Headers({"Accept-Encoding": accepts} if accepts else {}))
    connection = cast(ServerConnection, None)  # only a streamed file needs a connection
    hook = viser_hook or of_viser()
    return asyncio.run(admitted_reply(routes or {}, hook, connection, request, AUTHORITY, RateLimitedLog()))


def says(body: bytes, kind: str = "text/plain") -> Handler:
    return lambda path, query: (200, kind, body)


@pytest.mark.parametrize(
    ("upgrade", "websocket"),
    [([], False), (["websocket"], True), (["WebSocket"], False), (["websocket", "websocket"], False)],
)
def test_a_handshake_is_recognized_as_viser_does(upgrade: list[str], websocket: bool) -> None:
    assert (
        request_parts(Request("/", Headers([("Upgrade", value) for value in upgrade]))).websocket is websocket
    )


def test_a_refusal_gives_reason_and_link_in_html_without_foreign_markup() -> None:
    refused = refusals("http://localhost:8080/?a=<b>")("<script>")
    text = bytes(refused.body).decode()
    assert refused.status_code == 403
    assert "&lt;script&gt;" in text and html.escape("?a=<b>") in text and "<svg" in text
    assert "<script>" not in text and "{{" not in text
    assert PAGE_OF_OURS.items() <= dict(refused.headers.raw_items()).items()


@pytest.mark.parametrize("zipped", [False, True])
def test_visers_page_gets_our_head_and_the_new_length(zipped: bool) -> None:
    body, headers = (gzip.compress(PAGE), {"Content-Encoding": "gzip"}) if zipped else (PAGE, {})
    made = answer("/", viser_hook=of_viser(body=body, **headers))
    assert made.headers.get_all("Content-Length") == [str(len(made.body))]
    text = (gzip.decompress(made.body) if zipped else bytes(made.body)).decode()
    head, _, rest = text.partition("</head>")
    assert head.startswith("<html><head><title>viser</title>") and rest == "<body></body></html>"
    assert [f'src="/workbench/{name}"' in head for name in SCRIPTS] == [True] * len(SCRIPTS)
    assert f'<link rel="stylesheet" href="/workbench/{STYLES}">' in head
    assert made.headers["Content-Security-Policy"] == page_policy(AUTHORITY)
    assert EVERY_REPLY.items() <= dict(made.headers.raw_items()).items()


def test_other_replies_of_viser_are_unchanged() -> None:
    made = answer("/x.js", viser_hook=of_viser("text/javascript", b"</head>"))
    assert (made.body, made.headers["Content-Length"]) == (b"</head>", "7")
    assert made.headers["Content-Security-Policy"] == page_policy(AUTHORITY)
    nameless = of_viser("", b"</head>")
    assert answer("/x", viser_hook=nameless).body == b"</head>"


def test_a_handshake_that_only_viser_recognizes_is_a_bad_request() -> None:
    made = answer("/", viser_hook=lambda connection, request: None)
    assert (made.status_code, bytes(made.body)) == (400, b"Bad request.")


def test_the_longest_prefix_gets_the_remaining_path_decoded_once() -> None:
    def route(name: str) -> Handler:
        return lambda path, query: (200, "text/plain", f"{name}: {path} {query}".encode())

    routes = {"/a/": (route("a"), {}), "/a/b/": (route("b"), {"X-Of-Route": "1"})}
    assert answer("/a/x%20y?z=1%202", routes).body == b"a: x y {'z': '1 2'}"
    made = answer("/a/b/x%2520y", routes)
    assert (made.body, made.headers["X-Of-Route"]) == (b"b: x%20y {}", "1")
    assert made.headers["Cache-Control"] == "no-cache"
    assert answer("/c/x", routes, of_viser("text/plain", b"viser's")).body == b"viser's"


def test_a_failing_route_is_reported_and_its_error_logged(caplog: pytest.LogCaptureFixture) -> None:
    def fails(path: str, query: object) -> tuple[int, str, bytes]:
        raise ZeroDivisionError

    made = answer("/a/x", {"/a/": (fails, {})})
    assert (made.status_code, bytes(made.body)) == (
        500,
        b"This request failed; the terminal shows the error.",
    )
    assert caplog.records[0].exc_info and caplog.records[0].exc_info[0] is ZeroDivisionError


@pytest.mark.parametrize(
    ("kind", "size", "accepts", "packed"),
    [
        ("text/plain; charset=utf-8", 1025, "gzip", True),
        ("text/plain; charset=utf-8", 1025, "br, gzip;q=0.5", True),
        ("text/plain; charset=utf-8", 1024, "gzip", False),
        ("text/plain; charset=utf-8", 1025, "br", False),
        ("text/plain; charset=utf-8", 1025, "", False),
        ("application/json; charset=utf-8", 1025, "gzip", True),
        ("application/wasm", 1025, "gzip", True),
        ("image/svg+xml", 1025, "gzip", True),
        ("image/png", 1025, "gzip", False),
    ],
)
def test_large_compressible_replies_are_compressed_for_clients_that_accept_it(
    kind: str, size: int, accepts: str, packed: bool
) -> None:
    made = answer("/a/x", {"/a/": (says(b"x" * size, kind), {})}, accepts=accepts)
    assert ("Content-Encoding" in made.headers) is packed
    assert (gzip.decompress(made.body) if packed else bytes(made.body)) == b"x" * size
    assert made.headers["Content-Length"] == str(len(made.body))


@pytest.mark.parametrize(
    ("path", "served"),
    [
        ("/a/" + "x" * MAX_NAME_BYTES, True),
        ("/a/" + "x" * (MAX_NAME_BYTES + 1), False),
        ("/a/" + "é" * (MAX_NAME_BYTES // 2), True),
        ("/a/" + "é" * (MAX_NAME_BYTES // 2 + 1), False),
        ("/a" + "/" + "/".join(["x" * 100] * 29 + ["x" * (MAX_PATH_BYTES - 2901)]), True),
        ("/a" + "/" + "/".join(["x" * 100] * 29 + ["x" * (MAX_PATH_BYTES - 2900)]), False),
        ("/a/..", False),
        ("/a/%2e%2e/x", False),
        ("/a/..%5Cx", False),
        ("/a/..x/x..", True),
        ("/a/x%00y", False),
    ],
)
def test_an_impossible_path_is_answered_without_disk_access(path: str, served: bool) -> None:
    assert (MAX_NAME_BYTES, MAX_PATH_BYTES) == (255, 3000)
    made = answer(path, {"/a/": (says(b"served"), {})})
    assert (made.status_code, bytes(made.body)) == ((200, b"served") if served else (404, NO_SUCH_FILE))


def test_a_folder_serves_only_its_own_files(tmp_path: Path) -> None:
    folder = tmp_path / "served"
    (folder / "below").mkdir(parents=True)
    (folder / "below" / "a.JS").write_bytes(b"1")
    (tmp_path / "secret.txt").write_text("secret")
    (folder / "link.txt").symlink_to(tmp_path / "secret.txt")
    (folder / "inside.txt").symlink_to(folder / "below" / "a.JS")
    handle = folder_handler(folder)
    assert (
        handle("below/a.JS", {}) == handle("/below/a.JS", {}) == (200, "text/javascript; charset=utf-8", b"1")
    )
    assert handle("inside.txt", {})[2] == b"1"
    for path in ("", "below", "link.txt", "none.txt", "../secret.txt"):
        assert handle(path, {}) == (404, "text/plain; charset=utf-8", NO_SUCH_FILE)


def test_a_requested_path_writes_no_control_codes_to_the_terminal(caplog: pytest.LogCaptureFixture) -> None:
    def fails(path: str, query: object) -> tuple[int, str, bytes]:
        raise ZeroDivisionError

    answer("/a/%1b[31m", {"/a/": (fails, {})})
    logged = caplog.records[0].getMessage()  # `caplog.text` strips such codes
    assert "/a/" in logged and "\x1b" not in logged


def test_a_sibling_folder_and_a_link_to_itself_are_not_served(tmp_path: Path) -> None:
    folder, beside = tmp_path / "served", tmp_path / "served-not"
    for made in (folder, beside):
        made.mkdir()
        (made / "a.txt").write_text("a")
    (folder / "loop").symlink_to(folder / "loop")
    through_a_link = tmp_path / "link"
    through_a_link.symlink_to(folder)
    for handle in (folder_handler(folder), folder_handler(through_a_link)):
        assert handle("a.txt", {})[::2] == (200, b"a")
        for path in ("loop", "../served-not/a.txt", str(beside / "a.txt")):
            assert handle(path, {})[::2] == (404, NO_SUCH_FILE)
