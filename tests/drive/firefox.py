"""A real Firefox, driven by WebDriver BiDi: Playwright cannot drive the Firefox that a distribution ships."""

from __future__ import annotations

import base64
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from websockets.sync.client import connect
from websockets.sync.connection import Connection

from tests.drive.waiting import until
from workbench.machine.apt import AptFailed, apt_install, can_install_packages

PREFERENCES = {
    "webgl.force-enabled": True,
    # Without these Firefox looks up Mozilla's hosts at every start.
    "app.normandy.enabled": False,
    "app.update.auto": False,
    "browser.safebrowsing.downloads.remote.enabled": False,
    "browser.safebrowsing.malware.enabled": False,
    "browser.safebrowsing.phishing.enabled": False,
    "browser.shell.checkDefaultBrowser": False,
    "datareporting.policy.dataSubmissionEnabled": False,
    "extensions.systemAddon.update.enabled": False,
    "network.captive-portal-service.enabled": False,
    "network.connectivity-service.enabled": False,
    "services.settings.server": "data:,",
}
START_SECONDS = 60


def why_no_firefox() -> str:
    """Return why Firefox cannot be driven, or an empty string. On Debian as root a missing Firefox is installed,
    with an X server: without a screen Firefox has no WebGL.
    """
    if _found():
        return ""
    if can_install_packages():
        try:
            apt_install("firefox-esr", "xvfb", "xauth", "libgl1-mesa-dri", "libegl1")
        except AptFailed as failure:
            return f"Firefox could not be installed: {failure}"
    return "" if _found() else "there is no Firefox with Xvfb; type: sudo apt-get install firefox-esr xvfb"


def _found() -> str | None:
    firefox = shutil.which("firefox-esr") or shutil.which("firefox")
    return firefox if shutil.which("Xvfb") else None


class Firefox:
    """One page of a running Firefox."""

    def __init__(self, socket: Connection) -> None:
        self._socket, self._number = socket, 0
        self.errors: list[str] = []
        """Console errors and uncaught exceptions of the page."""
        self._call("session.new", capabilities={})
        self._call("session.subscribe", events=["log.entryAdded"])
        self._page = self._call("browsingContext.getTree")["contexts"][0]["context"]

    def size(self, width: int, height: int) -> None:
        self._call(
            "browsingContext.setViewport", context=self._page, viewport={"width": width, "height": height}
        )

    def goto(self, url: str) -> None:
        self._call("browsingContext.navigate", context=self._page, url=url, wait="complete")

    def evaluate(self, expression: str) -> Any:
        """The value of a JavaScript expression, as JSON."""
        made = self._call(
            "script.evaluate",
            expression=f"(async () => JSON.stringify(await ({expression})))()",
            target={"context": self._page},
            awaitPromise=True,
        )
        if made["type"] == "exception":
            raise AssertionError(f"{expression[:80]}: {made['exceptionDetails']['text']}")
        value = made["result"].get("value")
        return None if value is None else json.loads(value)

    def text(self) -> str:
        return self.evaluate("document.body?.innerText ?? ''")

    def click(self, role: str, name: str) -> None:
        """Click with the mouse the element that has this role and exactly this text or label."""
        script = (
            f"(() => {{ const e = [...document.querySelectorAll({json.dumps(role)})]"
            f".find(e => [e.innerText.trim(), e.ariaLabel].includes({json.dumps(name)}) && e.checkVisibility());"
            " if (!e) return null; e.scrollIntoView({block: 'nearest'});"
            " const r = e.getBoundingClientRect(); return [r.x + r.width / 2, r.y + r.height / 2].map(Math.round) })()"
        )
        x, y = until(lambda: self.evaluate(script), f"{role} {name}", 60)
        moves = [
            {"type": "pointerMove", "x": x, "y": y},
            {"type": "pointerDown", "button": 0},
            {"type": "pointerUp", "button": 0},
        ]
        self._call(
            "input.performActions",
            context=self._page,
            actions=[{"type": "pointer", "id": "mouse", "actions": moves}],
        )

    def picture(self, file: Path) -> None:
        file.write_bytes(
            base64.b64decode(self._call("browsingContext.captureScreenshot", context=self._page)["data"])
        )

    def _call(self, method: str, **parameters: Any) -> dict[str, Any]:
        self._number += 1
        self._socket.send(json.dumps({"id": self._number, "method": method, "params": parameters}))
        while True:
            message = json.loads(self._socket.recv(timeout=60))
            if message.get("method") == "log.entryAdded" and message["params"]["level"] == "error":
                self.errors.append(str(message["params"]["text"]))
            if message.get("id") == self._number:
                if message["type"] == "error":
                    raise AssertionError(f"{method}: {message['message']}")
                return message["result"]


@contextmanager
def open_firefox(width: int = 1280, height: int = 720) -> Iterator[Firefox]:
    """Start a Firefox with an empty profile on its own X server; stop both at the end."""
    program = _found()
    assert program is not None
    with tempfile.TemporaryDirectory(prefix="workbench-firefox-") as folder:
        preferences = "".join(
            f"user_pref({json.dumps(k)}, {json.dumps(v)});\n" for k, v in PREFERENCES.items()
        )
        (Path(folder) / "user.js").write_text(preferences)
        with _screen() as display:
            command = [program, "--no-remote", "--profile", folder, "--remote-debugging-port", "0"]
            process = subprocess.Popen(
                command,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                text=True,
                env={**os.environ, "DISPLAY": display, "HOME": folder, "MOZ_CRASHREPORTER_DISABLE": "1"},
            )
            try:
                with connect(f"{_address(process)}/session", max_size=None, proxy=None) as socket:
                    firefox = Firefox(socket)
                    firefox.size(width, height)
                    yield firefox
            finally:
                process.terminate()
                try:
                    process.wait(timeout=20)
                except subprocess.TimeoutExpired:
                    process.kill()
                    process.wait()


@contextmanager
def _screen() -> Iterator[str]:
    """Start an X server on a free display number."""
    reading, writing = os.pipe()
    server = subprocess.Popen(
        ["Xvfb", "-displayfd", str(writing), "-screen", "0", "2000x1200x24", "-nolisten", "tcp"],
        pass_fds=(writing,),
        stderr=subprocess.DEVNULL,
    )
    os.close(writing)
    try:
        with os.fdopen(reading) as told:
            number = told.readline().strip()
        assert number, "Xvfb ended at once"
        yield f":{number}"
    finally:
        server.terminate()
        server.wait(timeout=20)


def _address(process: subprocess.Popen[str]) -> str:
    """The websocket address that Firefox prints. Later output is read too: with a full pipe Firefox would block."""
    lines: list[str] = []
    stream = process.stderr
    assert stream is not None

    def read() -> None:
        for line in stream:
            lines.append(line.rstrip())

    threading.Thread(target=read, daemon=True).start()

    def found() -> str | None:
        return next(
            (m[1] for line in list(lines) if (m := re.search(r"BiDi listening on (ws://\S+)", line))), None
        )

    address = until(found, "Firefox's websocket", START_SECONDS, lambda: "\n".join(lines[-10:]))
    assert address is not None
    return address


if __name__ == "__main__":
    sys.exit(why_no_firefox() or None)
