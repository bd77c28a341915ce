"""The decision on one request, as a function; `test_attacks` tests it over real sockets."""

from __future__ import annotations

from dataclasses import replace
from urllib.parse import quote

import pytest

from workbench.page.door.access import (
    AccessRules,
    Admitted,
    Decision,
    Entered,
    RefusedRequest,
    RequestParts,
    Why,
    cookie_name,
    decide,
    split_authority,
)

TOKEN = "right"
GATE = AccessRules(TOKEN)
KNOWN = RequestParts(path="/", host=["localhost:8080"], cookie=["workbench-token-8080=right"])


def why(decision: Decision) -> Why | None:
    return decision.why if isinstance(decision, RefusedRequest) else None


@pytest.mark.parametrize(
    ("text", "split"),
    [
        ("localhost", ("localhost", None)),
        ("LocalHost:1", ("localhost", 1)),
        ("a_box.Lab.example:65535", ("a_box.lab.example", 65535)),
        ("127.0.0.1:8080", ("127.0.0.1", 8080)),
        ("[::1]", ("::1", None)),
        ("[2001:DB8:0:0::1]:80", ("2001:db8::1", 80)),
        ("[::ffff:127.0.0.1]:80", ("::ffff:7f00:1", 80)),
        ("a" * 253, ("a" * 253, None)),
        ("a" * 254, None),
        ("localhost:0", None),
        ("localhost:65536", None),
        ("localhost:", None),
        ("localhost:80:80", None),
        (":80", None),
        ("[::1", None),
        ("[:::1]", None),
        ("::1", None),
        ("user@localhost", None),
        ("", None),
    ],
)
def test_a_host_and_its_port_are_parsed_or_refused(text: str, split: tuple[str, int | None] | None) -> None:
    assert split_authority(text) == split


@pytest.mark.parametrize("host", [[], [""], ["evil.example"], ["localhost:8080", "localhost:8080"]])
def test_a_request_for_another_host_or_for_two_is_refused_with_the_reason(host: list[str]) -> None:
    for websocket in (False, True):
        assert why(decide(GATE, replace(KNOWN, host=host, websocket=websocket))) is Why.NAME


@pytest.mark.parametrize(
    ("host", "origin", "ours"),
    [
        ("localhost:8080", "http://localhost:8080", True),
        ("localhost:8080", "HTTP://LOCALHOST:8080", True),
        ("localhost:8080", "https://localhost:8080", True),
        ("localhost:8080", "ws://localhost:8080", False),
        ("localhost:8080", "localhost:8080", False),
        ("localhost:8080", "http://", False),
        ("localhost:8080", "http:localhost:8080", False),
        # A scheme's default port may be omitted on either side.
        ("localhost", "http://localhost", True),
        ("localhost", "http://localhost:80", True),
        ("localhost:80", "http://localhost", True),
        ("localhost", "https://localhost:443", True),
        ("localhost:443", "https://localhost", True),
        ("localhost:443", "http://localhost", False),
        ("localhost:80", "https://localhost", False),
    ],
)
def test_an_origin_is_ours_if_scheme_host_and_port_match(host: str, origin: str, ours: bool) -> None:
    assert decide(AccessRules(None), RequestParts("/", [host], origin=[origin])) == (
        Admitted(host) if ours else RefusedRequest(Why.SITE, "It came from a page of another site.")
    )


NAVIGATES, DOCUMENT = {"fetch_mode": ["navigate"]}, {"fetch_dest": ["document"]}


@pytest.mark.parametrize("site", [["cross-site"], ["same-site"], [""], ["none", "cross-site"]])
def test_a_load_by_a_foreign_page_is_refused_and_a_followed_link_is_not(
    site: list[str],
) -> None:
    foreign = replace(KNOWN, fetch_site=site)
    for loaded in (foreign, replace(foreign, **NAVIGATES), replace(foreign, **DOCUMENT)):
        assert why(decide(GATE, loaded)) is Why.SITE
    framed = replace(foreign, **NAVIGATES, fetch_dest=["iframe"])
    assert why(decide(GATE, framed)) is Why.SITE
    assert why(decide(GATE, replace(foreign, **NAVIGATES, **DOCUMENT))) is None
    # Browsers send different headers with a handshake, which has an Origin anyway.
    assert why(decide(GATE, replace(foreign, websocket=True))) is None


def test_the_cookie_belongs_to_the_port_that_the_browser_sees() -> None:
    assert cookie_name(8080) == "workbench-token-8080"
    for host, port in (("localhost", 80), ("localhost:80", 80), ("localhost:9000", 9000)):
        name = cookie_name(port)
        assert why(decide(GATE, RequestParts("/", [host], cookie=[f"{name}={TOKEN}"]))) is None
        assert (
            why(decide(GATE, RequestParts("/", [host], cookie=[f"{cookie_name(port + 1)}={TOKEN}"])))
            is Why.NO_TOKEN
        )
        assert why(decide(GATE, RequestParts("/", [host], cookie=[f"{name}=wrong"]))) is Why.OTHER_TOKEN
        entered = decide(GATE, RequestParts(f"/?token={TOKEN}", [host]))
        assert isinstance(entered, Entered)
        assert entered.set_cookie == f"{name}={TOKEN}; Path=/; HttpOnly; SameSite=Strict"


def test_a_wrong_cookie_does_not_hide_the_right_one() -> None:
    name = cookie_name(8080)
    for cookies in (
        [f"{name}=wrong; {name}={TOKEN}"],
        [f"a=b;{name}={TOKEN};  {name}=wrong"],
        [f"{name}=wrong", f"{name}={TOKEN}"],
    ):
        assert why(decide(GATE, replace(KNOWN, cookie=cookies))) is None
    # A token may contain the character that ends a cookie's name.
    assert why(decide(AccessRules("a=b"), replace(KNOWN, cookie=[f"{name}=a=b"]))) is None


@pytest.mark.parametrize(
    ("path", "location"),
    [
        ("/?token=right", "/"),
        ("/some/page?token=right&x=1", "/some/page?x=1"),
        ("/page?x=&y=a%20b&token=right", "/page?x=&y=a+b"),
        ("/~who/a%20b?token=right", "/~who/a%20b"),
        ("//evil.example/x?token=right", "/evil.example/x"),
        ("/\\evil.example?token=right", "/evil.example"),
        ("/%5C%2Fevil.example?token=right", "/evil.example"),
        ("/x?token=right&next=//evil.example", "/x?next=%2F%2Fevil.example"),
        ("/x?token=right&a?b=c", "/x?a%3Fb=c"),
    ],
)
def test_the_right_token_in_the_address_redirects_to_the_same_page_without_it(
    path: str, location: str
) -> None:
    for cookie in ([], KNOWN.cookie):
        entered = decide(GATE, replace(KNOWN, path=path, cookie=cookie))
        assert isinstance(entered, Entered)
        assert (entered.location, entered.by_page) == (location, False)


def test_a_link_with_the_token_on_another_site_redirects_through_a_page() -> None:
    followed = replace(KNOWN, path="/?token=right", **NAVIGATES, **DOCUMENT)
    for site, by_page in (("cross-site", True), ("same-site", True), ("none", False)):
        entered = decide(GATE, replace(followed, fetch_site=[site]))
        assert isinstance(entered, Entered) and entered.by_page is by_page


@pytest.mark.parametrize(
    "query", ["token=wrong", "token=righ", "token=rightt", "token=right&token=right", f"token={quote('é')}"]
)
def test_a_wrong_or_duplicated_token_in_the_address_is_refused_even_with_the_cookie(query: str) -> None:
    assert why(decide(GATE, replace(KNOWN, path=f"/?{query}"))) is Why.OTHER_TOKEN


def test_the_token_in_a_handshakes_address_is_ignored() -> None:
    handshake = replace(KNOWN, path="/?token=right", websocket=True)
    assert decide(GATE, handshake) == Admitted("localhost:8080")
    assert why(decide(GATE, replace(handshake, cookie=[]))) is Why.NO_TOKEN


def test_an_empty_token_in_the_address_is_no_token() -> None:
    assert why(decide(GATE, replace(KNOWN, path="/?token="))) is None
    assert why(decide(GATE, replace(KNOWN, path="/?token=", cookie=[]))) is Why.NO_TOKEN
