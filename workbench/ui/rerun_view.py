"""Recordings in rerun's own viewer, beside the page or in a tab of its own, through the page's one door.

rerun's web viewer is a program of 43 MB that looks at any address it is given and tells its makers that it runs. Here
it comes from the wheel that wrote the recordings (so file and viewer are of one version), packed; it is served under
the page's own address, where the same cookie lets it in and one forwarded port carries all of it; and a content
security policy lets it talk to nobody else.

Which recordings it opens stands in its address, and has to be a whole address there, host and port included. What
host a browser sees is known in the browser alone (behind ``ssh -L`` it is another one), so the page that is opened
is a small one of ours that puts the addresses together and goes on to rerun's.
"""

from __future__ import annotations

import gzip
import html
import json
import secrets
import threading
from collections.abc import Callable, Sequence
from importlib.metadata import version
from pathlib import Path

import viser

from workbench.recording.web_viewer import VIEWER_FILES, VIEWER_POLICY, is_kept, viewer_file
from workbench.ui.changed import fill
from workbench.ui.door import Door
from workbench.ui.file_reply import FileReply
from workbench.ui.fragments import render
from workbench.ui.offers import Offers

WIDTH = 760
"""Pixels of the panel; rerun's own panels are folded away in our recordings."""

_SHOW = "/rerun/show/"
_VIEWER = f"/rerun/viewer-{version('rerun-sdk')}/"
_GO_ON = """<!doctype html><meta charset="utf-8"><title>Workbench: {title}</title>
<style>body {{ background: #0d1011; color: #cad8de; font: 14px system-ui, sans-serif; margin: 2em }}</style>
<p>Opening {title} in rerun&hellip;</p>
<script>
const query = new URLSearchParams([["hide_welcome_screen", "1"], ["persist", "0"]]);
for (const path of {paths}) query.append("url", location.origin + path);
// Dark or light as the page that this is in.
let theme = "dark";
try {{ theme = parent.document.documentElement.dataset.mantineColorScheme || theme; }} catch {{ }}
query.append("theme", theme);
// rerun's own look-ups of a fast graphics driver end in a dialog where there is none.
if (!navigator.gpu) query.append("renderer", "webgl");
location.replace({viewer} + "index.html?" + query);
</script>
"""

_WITH_COOKIE = b"""<script>
const fetch_as_told = window.fetch;
window.fetch = (what, how) => fetch_as_told(what, { ...how, credentials: "same-origin" });
</script>"""
"""rerun fetches recordings without cookies (0.41), and the door lets nobody in without."""


class RerunPages:
    """The addresses under which recordings are shown. One a door."""

    def __init__(self, door: Door, offers: Offers) -> None:
        self._offers = offers
        self._lock = threading.Lock()
        self._shown: dict[str, tuple[Path, ...]] = {}
        self._keys: dict[tuple[Path, ...], str] = {}
        headers = {"Content-Security-Policy": VIEWER_POLICY, "Cache-Control": "private, max-age=604800"}
        door.add_route(_VIEWER, _viewer_file, headers)
        door.add_route(_SHOW, self._go_on, {**headers, "Cache-Control": "no-store"})

    def address(self, recordings: Sequence[Path]) -> str:
        """The address, from the root of the server, that opens these ``.rrd`` files together."""
        paths = tuple(Path(path).resolve() for path in recordings)
        with self._lock:
            key = self._keys.setdefault(paths, secrets.token_urlsafe(16))
            self._shown[key] = paths
        return f"{_SHOW}{key}/"

    def _go_on(self, asked: str) -> tuple[int, str, bytes]:
        with self._lock:
            paths = self._shown.get(asked.partition("/")[0])
        if paths is None:
            return 404, "text/plain; charset=utf-8", b"There is no such recording."
        names = ", ".join(path.stem for path in paths)
        page = _GO_ON.format(
            title=html.escape(names),
            # "</script>" in a file's name would end the script.
            paths=json.dumps([self._offers.address(path) for path in paths]).replace("<", "\\u003c"),
            viewer=json.dumps(_VIEWER),
        )
        return 200, "text/html; charset=utf-8", page.encode()


def _viewer_file(name: str) -> tuple[int, str, bytes] | FileReply:
    if name not in VIEWER_FILES:
        return 404, "text/plain; charset=utf-8", b"There is no such file."
    if name == "index.html":
        page = gzip.decompress(viewer_file(name).read_bytes())
        before, head, after = page.partition(b"<head>")
        return 200, VIEWER_FILES[name], before + head + _WITH_COOKIE + after
    return FileReply(viewer_file(name), VIEWER_FILES[name], gzipped=True)


class RerunView:
    """Buttons in the present container that open recordings in rerun, and the panel in which they are shown.

    Args:
        server: The page.
        pages: Where rerun is served.
        make_way: Called before the panel comes, to make room for it.
    """

    def __init__(
        self, server: viser.ViserServer, pages: RerunPages, make_way: Callable[[], None] = lambda: None
    ) -> None:
        self._server, self._pages, self._make_way = server, pages, make_way
        self._paths: tuple[Path, ...] = ()
        self._chosen = 0
        self._panel: viser.PanelHandle | None = None
        self._lock = threading.Lock()
        self._problem = ""
        self._waiting = False
        self._drawn: object = None
        self._button = server.gui.add_button("Open in rerun", icon=viser.Icon.APP_WINDOW, disabled=True)
        self._words = server.gui.add_html("")
        self._button.on_click(lambda _: self.open())

    def draw(self, paths: Sequence[Path], chosen: int | None = None) -> None:
        """From now on the buttons are about these ``.rrd`` files, of as many recordings as are `chosen`."""
        self._chosen = len(paths) if chosen is None else chosen
        self._paths = tuple(paths)
        disabled = not self._paths or self._waiting
        if self._button.disabled != disabled:
            self._button.disabled = disabled
        wanted = (self._paths, self._chosen, self._waiting, self._problem)
        if wanted == self._drawn:
            return
        self._drawn = wanted
        words = render(
            "rerun",
            address=self._pages.address(self._paths) if self._paths else None,
            lacking=self._chosen > len(self._paths),
            waiting=self._waiting,
            problem=self._problem,
        )
        fill(self._words, words)

    def open(self) -> None:
        """Show the recordings in a panel beside the scene; returns when the viewer is there to be loaded."""
        paths = self._paths
        with self._lock:
            if not paths or self._waiting:
                return
            self._waiting, self._problem = not is_kept(), ""
        try:
            if self._waiting:
                self.draw(paths, self._chosen)
                viewer_file("index.html")
        except RuntimeError as error:
            self._problem = str(error)
            return
        finally:
            self._waiting = False
            self.draw(self._paths, self._chosen)
        self.close()
        self._make_way()
        with self._lock:
            self._panel = panel = self._server.gui.add_panel(order=6.0)
        with panel.add_tab("rerun", viser.Icon.APP_WINDOW):
            self._server.gui.add_html(render("rerun_frame", address=self._pages.address(paths)))
            self._server.gui.add_button("Close rerun", icon=viser.Icon.X).on_click(lambda _: self.close())
        # Over the scene and not beside it: beside the library a small window has no room for a third column. Who
        # has a larger one docks it.
        panel.float(x=12, y=12, width=WIDTH)

    def close(self) -> None:
        """Take the panel away, and the program that runs in it."""
        with self._lock:
            panel, self._panel = self._panel, None
        if panel is not None:
            panel.remove()
