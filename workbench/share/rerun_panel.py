"""Serves rerun's web viewer for recordings and shows it in a panel or a browser tab."""

from __future__ import annotations

import gzip
import hashlib
import logging
import secrets
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import partial
from importlib.metadata import version
from pathlib import Path
from types import MappingProxyType

import viser

from workbench.episodes.reader.reading import read_store_id
from workbench.episodes.rerun.viewer import VIEWER_FILES, VIEWER_POLICY, viewer_file, viewer_is_cached
from workbench.live.process.background_jobs import Job, JobFailed, Jobs
from workbench.machine.folders import web_assets_folder
from workbench.machine.loop import BlockingPool, later, on_loop, post
from workbench.page.command import Command, Refused
from workbench.page.commands import TellUnfolded
from workbench.page.door.file_response import Downloads, FileReply
from workbench.page.door.gated_server import GatedServer
from workbench.page.widgets.templates import render
from workbench.page.widgets.tools import tool, tools_html
from workbench.page.widgets.visitors import Visitor
from workbench.share.commands import CloseRerun, OpenInRerun

log = logging.getLogger(__name__)

WIDTH_SHARE, MIN_WIDTH_PIXELS = 0.66, 480
"""Width of rerun's panel: its share of the width between the other panels, and its minimum. The scene and the
timeline have the rest."""
PLACED_AFTER_SECONDS = 0.3
"""Time from a page's request for the panel's content until the panel is placed."""
Moments = Mapping[Path, int]
"""The shown step of each recording."""

PANEL = "rerun"
_SHOW = "/rerun/show/"
_VIEWER = f"/rerun/viewer-{version('rerun-sdk')}/"


class RerunPages:
    """The addresses under which rerun shows recordings. One object per `GatedServer`.

    rerun's web viewer is a program of 43 MB that fetches any address it is given and reports its use to its
    makers. The workbench serves the viewer itself: compressed, and from the wheel that wrote the recordings
    (so file and viewer have the same version). The viewer is below the page's own address, so the same cookie
    and one forwarded port suffice, and a content security policy blocks other servers.

    The viewer's address contains the recordings as full addresses, with host and port. Only the browser knows
    the host (behind ``ssh -L`` it differs). So the browser first opens a small page of ours, which builds the
    addresses and redirects to rerun. The address cannot contain the step: rerun accepts a step only for
    recordings of its own servers. So a script of ours in rerun's page sends the step (``viewer_control``,
    rerun 0.41: one hand-written protobuf message) when the recording has been read. A version of rerun
    without that message opens at the first step.
    """

    def __init__(self, gated_server: GatedServer, offers: Downloads) -> None:
        self._offers = offers
        self._secret = secrets.token_bytes(32)
        self._shown: dict[str, tuple[tuple[Path, ...], Callable[[], Moments]]] = {}
        """Recordings by the random part of their address; requests read this dict on other threads."""
        self.unpacking = BlockingPool("rerun-viewer")
        """Decompresses the viewer."""
        headers = {"Content-Security-Policy": VIEWER_POLICY, "Cache-Control": "private, max-age=604800"}
        gated_server.add_route(_VIEWER, _viewer_file, headers)
        gated_server.add_route(_SHOW, self._go_on, {**headers, "Cache-Control": "no-store"})

    def address(self, recordings: Sequence[Path], moments: Callable[[], Moments] = dict) -> str:
        """The address, from the root of the server, that opens these ``.rrd`` files together.

        Args:
            moments: called when the address is opened; returns the step at which each recording opens. A
                recording without an entry opens at its first step.
        """
        paths = tuple(Path(path).absolute() for path in recordings)
        # The key is the same for the same files, and cannot be guessed.
        key = hashlib.blake2b(repr(paths).encode(), key=self._secret, digest_size=16).hexdigest()
        self._shown[key] = paths, moments
        return f"{_SHOW}{key}/"

    def _go_on(self, asked: str, query: Mapping[str, str]) -> tuple[int, str, bytes]:
        shown = self._shown.get(asked.partition("/")[0])
        if shown is None:
            return 404, "text/plain; charset=utf-8", b"There is no such recording."
        paths, moments = shown
        names = ", ".join(path.stem for path in paths)
        # Send the first step too: without it rerun follows the data until it reads the pause at the end of a file.
        begins = {**dict.fromkeys(paths, 0), **{path.absolute(): step for path, step in moments().items()}}
        page = render(
            "rerun_go_on",
            names=names,
            paths=[self._offers.address(path) for path in paths],
            moments=[f"{store}@{step}" for store, step in _stores(begins)],
            viewer=_VIEWER,
        )
        return 200, "text/html; charset=utf-8", page.encode()


def _stores(moments: Moments) -> Iterator[tuple[str, int]]:
    for path, step in moments.items():
        try:
            yield read_store_id(path), step
        except (ValueError, OSError) as error:
            log.warning("rerun cannot open %s at step %d: %s", path.name, step, error)


def _viewer_file(name: str, query: Mapping[str, str]) -> tuple[int, str, bytes] | FileReply:
    if name not in VIEWER_FILES:
        return 404, "text/plain; charset=utf-8", b"There is no such file."
    if name == "index.html":
        page = gzip.decompress(viewer_file(name).read_bytes())
        before, head, after = page.partition(b"<head>")
        ours = b"<script>" + (web_assets_folder() / "in_rerun.js").read_bytes() + b"</script>"
        return 200, VIEWER_FILES[name], before + head + ours + after
    return FileReply(viewer_file(name), VIEWER_FILES[name], gzipped=True)


class RerunView:
    """Buttons in the present container that open recordings in rerun, and the panel that shows rerun.

    Args:
        server: The page.
        pages: Addresses of rerun.
        make_way: Called before the panel opens, to make room for it. Its argument is a function that folds
            and unfolds the panel. Returns the width in pixels between the other panels.
    """

    does = (OpenInRerun, CloseRerun)

    def __init__(
        self,
        server: viser.ViserServer,
        pages: RerunPages,
        make_way: Callable[[Callable[[bool], None]], int] = lambda fold: 0,
    ) -> None:
        self._server, self._pages, self._make_way = server, pages, make_way
        self._paths: tuple[Path, ...] = ()
        self._moments: Moments = {}
        self._panel: viser.PanelHandle | None = None
        self._jobs = Jobs(lambda: None, self._failed)
        self._waiting = False
        """Whether the viewer is being decompressed."""
        self._problem = ""
        self._drawn: object = None
        self._width = MIN_WIDTH_PIXELS
        self._button = server.gui.add_html("")
        self._words = server.gui.add_html("")

    def do(self, command: Command, visitor: Visitor) -> None:
        match command:
            case OpenInRerun() if not self._paths:
                raise Refused("Select recordings that have a .rrd file first.")
            case OpenInRerun():
                self.open()
            case CloseRerun():
                self.close()

    def draw(
        self, paths: Sequence[Path], chosen: int | None = None, moments: Moments = MappingProxyType({})
    ) -> None:
        """Set the ``.rrd`` files that the buttons open.

        Args:
            chosen: number of chosen recordings; some may have no ``.rrd`` file.
            moments: the shown step of each open recording.
        """
        self._paths, self._moments = tuple(paths), moments
        lacking = chosen is not None and chosen > len(self._paths)
        wanted = (self._paths, lacking, self._waiting, self._problem)
        if wanted == self._drawn:
            return
        self._drawn = wanted
        off = not self._paths or self._waiting
        self._button.content = tools_html([tool("Open in rerun", OpenInRerun(), off=off)])
        self._words.content = render(
            "rerun",
            address=self._address(self._paths) if self._paths else None,
            lacking=lacking,
            waiting=self._waiting,
            problem=self._problem,
        )

    def _address(self, paths: tuple[Path, ...]) -> str:
        def moments() -> Moments:
            post(lambda: later(PLACED_AFTER_SECONDS, self._widen))
            return {path: self._moments.get(path, 0) for path in paths}

        return self._pages.address(paths, moments)

    def _widen(self) -> None:
        """Set the panel's width once a page has placed it.

        viser gives 300 pixels to a panel that is docked next to another panel, and ignores the width given at
        docking. A page's request for the panel's content shows that the panel exists on that page.
        """
        if self._panel is not None:
            self._panel.set_width(self._width)

    @on_loop
    def open(self) -> None:
        """Show the recordings in a panel next to the scene, as soon as the viewer can be loaded."""
        if not self._waiting:
            self._problem = ""
            self._jobs.start("opening rerun", partial(self._open, self._paths, self._moments))

    async def _open(self, paths: tuple[Path, ...], moments: Moments, job: Job) -> None:
        unpacking = self._pages.unpacking
        if not await unpacking.run(viewer_is_cached):
            self._waiting = True
            try:
                await unpacking.run(lambda: viewer_file("index.html"))
            except RuntimeError as error:
                raise JobFailed(str(error)) from error
            finally:
                self._waiting = False
        self.close()
        room = self._make_way(self._fold)
        self._panel = panel = self._server.gui.add_panel(order=6.0)
        with panel.add_tab("rerun", viser.Icon.APP_WINDOW):
            self._server.gui.add_html(tools_html([tool("Close rerun", CloseRerun())]))
            begins = {path: moments.get(path, 0) for path in paths}
            heading = [(path.stem, begins[path]) for path in paths]
            self._server.gui.add_html(render("rerun_frame", address=self._address(paths), heading=heading))
            self._server.gui.add_html(render("tell", command=TellUnfolded(panel=PANEL)))
        # Docked next to the scene, with a draggable border.
        panel.dock_left()
        self._width = max(MIN_WIDTH_PIXELS, round(WIDTH_SHARE * room))

    def _failed(self, failure: JobFailed) -> None:
        self._problem = str(failure)

    def _fold(self, folded: bool) -> None:
        if (panel := self._panel) is not None:
            with suppress(RuntimeError):  # the panel was closed meanwhile
                (panel.minimize if folded else panel.expand)()

    @on_loop
    def close(self) -> None:
        """Remove the panel and the viewer in it."""
        panel, self._panel = self._panel, None
        if panel is not None:
            panel.remove()

    @on_loop
    def end(self) -> None:
        """Cancel an opening of rerun. Called when the page is removed; the panel is removed with it."""
        self._jobs.close()
        self._panel = None
