"""Decides whether to admit an HTTP request or websocket handshake. Pure functions."""

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
class AccessRules:
    """The token and the host names of this server.

    The page drives the author's machine: it runs their code, reads their files and writes into their source. A server
    on loopback is not private: any web page that the author has open can send requests to ``127.0.0.1`` (browsers do
    not apply the same-origin rule to websockets), a foreign name can be made to resolve there after its page was
    loaded (DNS rebinding), and other users of the machine can connect.
    """

    token: str | None
    """The token; None if no token is needed (loopback only, see `ServerOptions`)."""
    names: frozenset[str] = frozenset()
    """Host names and addresses of this server, in lower case, without a port; loopback is always accepted."""
    any_address: bool = False
    """Accept every IP address as Host, for a server that is not bound to loopback only."""


@dataclass(frozen=True)
class RequestParts:
    """The parts of a request that `decide` checks. Each header is the list of all its values: a header that is sent twice
    tries to make two programs read different values."""

    path: str
    """Raw path: percent-encoded, with the query."""
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
    """The Host header, checked to be ours: safe to use in a reply's headers."""


@dataclass(frozen=True)
class Entered:
    """The right token was in the address: set the cookie, then redirect to ``location``."""

    location: str
    set_cookie: str
    by_page: bool
    """Whether the browser followed a link on another site. An HTTP redirect would keep that site as the
    initiator, and the browser would not send a SameSite=Strict cookie; if a page of ours redirects instead,
    we are the initiator."""


class Why(Enum):
    """Reason for refusing a request."""

    NAME = "name"
    """The Host header is not a name of this server."""
    SITE = "site"
    """A page of another site made the request."""
    NO_TOKEN = "no token"
    OTHER_TOKEN = "other token"
    """A wrong token, or an old token that a new one has replaced."""


@dataclass(frozen=True)
class RefusedRequest:
    why: Why
    reason: str
    """One sentence for the 403 page. Contains no text of the request."""


Decision = Admitted | Entered | RefusedRequest

_OTHER_TOKEN = (
    "Its token is not valid. Each start of the workbench makes a new token, and so does renewing the token."
)


def split_authority(text: str) -> tuple[str, int | None] | None:
    """Host and port of ``host`` or ``host:port``; None if malformed.

    The host is in lower case; an IPv6 address is in its shortest form, without brackets.
    """
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
    """Whether ``host``, as returned by `split_authority`, is ``localhost``, 127.0.0.0/8 or ::1."""
    address = _address(host)
    return host == "localhost" if address is None else address.is_loopback


def host_is_ours(rules: AccessRules, host: str) -> bool:
    """Whether ``host`` is a name of this server.

    The port is not compared: with ``ssh -L 9000:localhost:8080`` or a container's port map the browser sends
    another port. That is safe: rebinding makes a *foreign name* point here, and no attacker can re-point
    ``localhost`` or a bare IP address.
    """
    if is_loopback(host) or host in rules.names:
        return True
    return rules.any_address and _address(host) is not None


def cookie_name(port: int) -> str:
    """Name of the cookie for a page on the browser's ``port``. Cookies ignore ports: without the port in the name, two
    workbenches on one machine would log each other out at every load."""
    return f"workbench-token-{port}"


def _cookies(headers: Sequence[str], name: str) -> list[str]:
    """All values of the cookie ``name``: another server on the host may set a cookie of this name for a
    narrower path, which must not hide the right value."""
    pairs = (part.strip().partition("=") for header in headers for part in header.split(";"))
    return [value for key, _, value in pairs if key == name]


def _equal(given: str, token: str) -> bool:
    return hmac.compare_digest(given.encode("utf-8", "surrogatepass"), token.encode())


def _same_origin(origin: str, host: tuple[str, int | None]) -> bool:
    """Whether an Origin header matches the Host header; ``https`` is accepted too, for a TLS proxy in front of us."""
    scheme, separator, authority = origin.partition("://")
    default = {"http": 80, "https": 443}.get(scheme.lower())
    split = split_authority(authority)
    if not separator or default is None or split is None:
        return False
    return (split[0], split[1] or default) == (host[0], host[1] or default)


def _without_token(path: str) -> str:
    """``path`` without its token; always a path on this server."""
    plain, _, query = path.partition("?")
    rest = [(key, value) for key, value in parse_qsl(query, keep_blank_values=True) if key != "token"]
    # "//evil.example" and "/\evil.example" are other hosts to a browser, not paths.
    plain = "/" + quote(unquote(plain).lstrip("/\\"), safe="/~")
    return plain + ("?" + urlencode(rest) if rest else "")


def decide(rules: AccessRules, asked: RequestParts) -> Decision:
    """Decide on one request or handshake. Never raises, for any client input.

    Checks, in this order. *Host*: must name this server; after DNS rebinding it does not. *Origin*: if present, must be
    exactly this address. *Sec-Fetch-Site*: a request without an Origin (such as that of an image or script tag) must not
    come from a page of another site. *Token*: 256 random bits, first in the printed address, afterwards
    in a cookie that scripts cannot read and that pages of other sites do not send.

    Not prevented: cookies ignore ports, so another *server* that the author visits under the same host name gets our cookie
    too. No cookie attribute prevents that; on a shared machine use a Unix socket (`ServerOptions.socket`).
    """
    host = split_authority(asked.host[0]) if len(asked.host) == 1 else None
    if host is None or not host_is_ours(rules, host[0]):
        return RefusedRequest(
            Why.NAME,
            "It used a host name that is not one of the workbench's own. "
            "Use the machine's address or host name instead.",
        )

    if len(asked.origin) > 1 or (asked.origin and not _same_origin(asked.origin[0], host)):
        return RefusedRequest(Why.SITE, "It came from a page of another site.")

    # Requests without an Origin: an <img> or <script> in a foreign page. A link that the user follows continues to the
    # token check. Websocket handshakes of browsers always have an Origin, and browsers disagree about Sec-Fetch-Site for
    # ws://.
    opened_by_link = list(asked.fetch_mode) == ["navigate"] and list(asked.fetch_dest) == ["document"]
    foreign = any(site not in ("same-origin", "none") for site in asked.fetch_site)
    if foreign and not opened_by_link and not asked.websocket:
        return RefusedRequest(Why.SITE, "It came from a page of another site.")

    if rules.token is None:
        return Admitted(asked.host[0])

    # Use the browser's port, not ours: behind ssh -L they differ.
    name = cookie_name(host[1] or 80)
    tokens = [value for key, value in parse_qsl(asked.path.partition("?")[2]) if key == "token"]
    if tokens and not asked.websocket:
        if len(tokens) > 1 or not _equal(tokens[0], rules.token):
            return RefusedRequest(Why.OTHER_TOKEN, _OTHER_TOKEN)
        return Entered(
            location=_without_token(asked.path),
            set_cookie=f"{name}={rules.token}; Path=/; HttpOnly; SameSite=Strict",
            by_page=foreign,
        )
    shown = _cookies(asked.cookie, name)
    if any(_equal(value, rules.token) for value in shown):
        return Admitted(asked.host[0])
    if shown:
        return RefusedRequest(Why.OTHER_TOKEN, _OTHER_TOKEN)
    return RefusedRequest(Why.NO_TOKEN, "This browser did not give the token of this workbench.")
