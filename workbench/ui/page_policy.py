"""The headers that tell a browser what it may do with what the door serves.

`PAGE` is the Content-Security-Policy of viser's page. Nothing is allowed there but what is listed, and each exception
is needed: `tests/ui/test_page_policy.py` takes them away one by one and finds the page broken.

- ``script-src``: our own files and viser's program, the latter by the hashes of its two scripts (one unpacks the
  other). Not ``unsafe-inline``: a name, a note or a file from elsewhere that came into the page as HTML in spite of all
  escaping would still not run. ``unsafe-hashes`` allows the few fixed handlers in our templates and no others.
  ``wasm-unsafe-eval`` is for the program that unpacks what the server sends. JavaScript's own ``eval`` stays forbidden:
  viser needs it for Gaussian splats and Plotly, and the workbench has neither (``web_assets/no_eval.js``).
- ``worker-src blob:``: viser's connection and its sorting run in workers that are made from texts.
- ``style-src 'unsafe-inline'``: viser's widgets and our HTML have styles in their tags. A style runs no code, and the
  next lines leave it nowhere to send anything.
- ``img-src data: blob:``: pictures that come over the websocket, and viser's own icons.
- ``connect-src``: this server alone. viser's page takes the address of another one from its own address
  (``?websocket=``, ``?playbackPath=``), and obeys it. ``data:`` and ``blob:`` are textures and programs that the page
  has already. The websocket is named with its scheme for browsers to which ``'self'`` does not mean ``ws:`` as well.
- ``frame-src 'self'``: rerun's viewer beside the recordings.
"""

from __future__ import annotations

import base64
import hashlib

VISERS_SCRIPTS = (
    "sha256-5iRcjB7VnwnYpbUpHa15FmjNIRu22hIQnvWuocHMxJw=",
    "sha256-o/BTEGoB4UnTxqb+3RxwUFQZkWXpqUxouHkbDNrAkqE=",
)
"""Of viser 1.1.1: the script in its page, and the one that this unpacks."""
HANDLERS = (
    "wb.press(event)",
    "wb.choose(event,this)",
    "wb.place(event)",
    "wb.copy(event)",
    "wb.intoSight(this)",
    "wb.follow(this)",
)
"""Every handler in ``web_assets/panels``; what they do is in ``web_assets/pressed.js``."""


def hash_of(script: str) -> str:
    """As a Content-Security-Policy names a script."""
    return "sha256-" + base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()


def _quoted(*hashes: str) -> str:
    return " ".join(f"'{one}'" for one in hashes)


DIRECTIVES: dict[str, str] = {
    "default-src": "'none'",
    "script-src": f"'self' 'wasm-unsafe-eval' 'unsafe-hashes' {_quoted(*VISERS_SCRIPTS, *map(hash_of, HANDLERS))}",
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
    """Content-Security-Policy for viser's page as seen on ``authority`` (``host:port``, known to be ours)."""
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
            *("gamepad", "geolocation", "gyroscope", "hid", "identity-credentials-get", "idle-detection"),
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
    + ", clipboard-write=(self), fullscreen=(self)",
    "Connection": "close",
}
"""Of a refusal too: no guessing of types, no address passed on, no other site that frames, opens or embeds this one,
and none of the machine's devices."""
PAGE_OF_OURS = {
    "Content-Security-Policy": "default-src 'none'; style-src 'unsafe-inline'; img-src data:; base-uri 'none'; "
    "form-action 'none'; frame-ancestors 'self'",
    "Cache-Control": "no-store",
}
"""Of a refusal and of the step that sets the cookie."""
