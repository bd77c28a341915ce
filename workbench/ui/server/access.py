"""Who may come in: the judgement on one HTTP request or websocket handshake, and nothing else.

The page drives the author's machine: it runs their code, reads their files and writes into their
source. A server on loopback is not private by itself. Any web page that the author has open can send
requests to ``127.0.0.1`` (browsers do not hold websockets back by the same-origin rule at all), a
foreign name can be made to resolve to ``127.0.0.1`` after its page was loaded (DNS rebinding), and
other people on the same machine can simply connect.

So every request is asked four things, in this order. *Host*: was the browser told to go to a name
that is ours? This is what a rebound name cannot fake. *Origin*: does the page that asks come from
this very address? *Sec-Fetch-Site*: the same question for requests that carry no Origin (an image or
script tag in a foreign page). *Token*: 256 random bits, once in the printed address, afterwards in a
cookie that scripts cannot read and that other sites' pages do not send. The functions here are pure;
`workbench.ui.server.gated_server` puts them in front of the server.

What this does not stop: cookies know hosts but no ports, so another *server* on the same machine that
the author visits under the same host name is sent our cookie too. There is no cookie attribute
against that; a Unix socket (`DoorOptions.socket`) is the way on a machine that others use too.
"""

from __future__ import annotations

import hmac
import ipaddress
import re
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from urllib.parse import parse_qsl, quote, unquote, urlencode

_AUTHORITY = re.compile(r"(\[[0-9A-Fa-f:.]{2,45}\]|[A-Za-z0-9_](?:[A-Za-z0-9._-]{0,252}))(?::([0-9]{1,5}))?")


@dataclass(frozen=True)
class Gate:
    """What is ours."""

    token: str | None
    """None: no token is asked for (loopback only, see `DoorOptions`)."""
    names: frozenset[str] = frozenset()
    """Lower-case host names and addresses, without a port, that are ours besides the loopback ones."""
    any_address: bool = False
    """Accept every IP address as Host: for a server that is bound wider than loopback."""


@dataclass(frozen=True)
class Asked:
    """The parts of a request that the gate looks at. Each header is the list of all its values, because
    a header that was sent twice is an attempt to have two programs read two different things."""

    path: str
    """As sent: percent-encoded, with the query."""
    host: Sequence[str]
    origin: Sequence[str] = ()
    cookie: Sequence[str] = ()
    fetch_site: Sequence[str] = ()
    fetch_mode: Sequence[str] = ()
    fetch_dest: Sequence[str] = ()
    websocket: bool = False


@dataclass(frozen=True)
class Admitted:
    authority: str
    """The Host header, known to be ours: safe to quote in a reply's headers."""


@dataclass(frozen=True)
class Entered:
    """The right token was in the address: set the cookie, then go to ``location``."""

    location: str
    set_cookie: str
    by_page: bool
    """True where the browser followed a link on another site. A redirect would carry that site as its
    initiator, and the browser would not send a Strict cookie with it; a small page that goes on by
    itself makes us the initiator."""


class Why(Enum):
    """What was wrong with a request that is refused."""

    NAME = "name"
    """It was told to go to a host that is not ours."""
    SITE = "site"
    """A page of another site made it."""
    NO_TOKEN = "no token"
    OTHER_TOKEN = "other token"
    """A token that is not, or no longer, this one's."""


@dataclass(frozen=True)
class Refused:
    why: Why
    reason: str
    """One sentence for the person who reads the 403 page. Holds no text from the request."""


Verdict = Admitted | Entered | Refused

_OTHER_TOKEN = (
    "The token that it showed is not this workbench's. Each start makes a new one, and so does renewing it."
)


def split_authority(text: str) -> tuple[str, int | None] | None:
    """``host`` or ``host:port`` of a Host header or a URL: the host in lower case (an IPv6 address in
    its shortest form, without brackets) and the port or None. None if it is not well formed."""
    match = _AUTHORITY.fullmatch(text)
    if match is None:
        return None
    host = match[1].lower()
    if host.startswith("["):
        try:
            host = str(ipaddress.IPv6Address(host[1:-1]))
        except ValueError:
            return None
    port = None if match[2] is None else int(match[2])
    if port is not None and not 0 < port < 65536:
        return None
    return host, port


def _address(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(host)
    except ValueError:
        return None


def is_loopback(host: str) -> bool:
    """``localhost``, 127.0.0.0/8 or ::1; ``host`` as `split_authority` gives it."""
    address = _address(host)
    return host == "localhost" if address is None else address.is_loopback


def host_is_ours(gate: Gate, host: str) -> bool:
    """Whether a browser that was told to go to ``host`` was told to come here.

    The port is left out on purpose. ``ssh -L 9000:localhost:8080`` makes the browser say
    ``localhost:9000``, and a container's port map does the same. That is safe: rebinding makes a
    *foreign name* point here, and ``localhost`` or a bare IP address is nobody's to re-point.
    """
    if is_loopback(host) or host in gate.names:
        return True
    return gate.any_address and _address(host) is not None


def cookie_name(port: int) -> str:
    """The cookie's name for a page that the browser sees on ``port``. Cookies ignore ports, so without
    the port in the name two workbenches on one machine would log each other out at every load."""
    return f"workbench-token-{port}"


def _cookies(headers: Sequence[str], name: str) -> list[str]:
    """All values of the cookie ``name``. More than one is possible (another server on the host may set
    the same name for a narrower path), and none of them may hide the right one."""
    pairs = (part.strip().partition("=") for header in headers for part in header.split(";"))
    return [value for key, _, value in pairs if key == name]


def _equal(given: str, token: str) -> bool:
    return hmac.compare_digest(given.encode("utf-8", "surrogatepass"), token.encode())


def _same_origin(origin: str, host: tuple[str, int | None]) -> bool:
    """An Origin header against the Host header; ``https`` too, for a TLS proxy in front of us."""
    scheme, separator, authority = origin.partition("://")
    default = {"http": 80, "https": 443}.get(scheme.lower())
    split = split_authority(authority)
    if not separator or default is None or split is None:
        return False
    return (split[0], split[1] or default) == (host[0], host[1] or default)


def _without_token(path: str) -> str:
    """``path`` without its token, as a path on this server whatever it looked like."""
    plain, _, query = path.partition("?")
    rest = [(key, value) for key, value in parse_qsl(query, keep_blank_values=True) if key != "token"]
    # "//evil.example" and "/\evil.example" are other hosts to a browser, not paths.
    plain = "/" + quote(unquote(plain).lstrip("/\\"), safe="/~")
    return plain + ("?" + urlencode(rest) if rest else "")


def judge(gate: Gate, asked: Asked) -> Verdict:
    """Judge one request or handshake. Never raises on what a client sent."""
    host = split_authority(asked.host[0]) if len(asked.host) == 1 else None
    if host is None or not host_is_ours(gate, host[0]):
        return Refused(
            Why.NAME,
            "It asked for this page under a name that the workbench does not know as its own. "
            "Use the machine's address or host name instead.",
        )

    if len(asked.origin) > 1 or (asked.origin and not _same_origin(asked.origin[0], host)):
        return Refused(Why.SITE, "It came from a page of another site.")

    # Requests without an Origin: an <img> or <script> in a foreign page. A person who follows a link
    # there is let through to the token check. Websocket handshakes always carry an Origin in browsers,
    # and what browsers say here about ws:// (another scheme than the page's) differs.
    opened_by_link = list(asked.fetch_mode) == ["navigate"] and list(asked.fetch_dest) == ["document"]
    foreign = any(site not in ("same-origin", "none") for site in asked.fetch_site)
    if foreign and not opened_by_link and not asked.websocket:
        return Refused(Why.SITE, "It was made by a page of another site.")

    if gate.token is None:
        return Admitted(asked.host[0])

    # The browser's port, not ours: behind ssh -L they differ.
    name = cookie_name(host[1] or 80)
    tokens = [value for key, value in parse_qsl(asked.path.partition("?")[2]) if key == "token"]
    if tokens and not asked.websocket:
        if len(tokens) > 1 or not _equal(tokens[0], gate.token):
            return Refused(Why.OTHER_TOKEN, _OTHER_TOKEN)
        return Entered(
            location=_without_token(asked.path),
            set_cookie=f"{name}={gate.token}; Path=/; HttpOnly; SameSite=Strict",
            by_page=foreign,
        )
    shown = _cookies(asked.cookie, name)
    if any(_equal(value, gate.token) for value in shown):
        return Admitted(asked.host[0])
    if shown:
        return Refused(Why.OTHER_TOKEN, _OTHER_TOKEN)
    return Refused(Why.NO_TOKEN, "This browser has not shown the token of this workbench.")
