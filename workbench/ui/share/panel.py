"""The Share tab: make something from the selected or open recordings, download it, or open them in rerun."""

from __future__ import annotations

import datetime
import re
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import viser

from workbench.core.cameras.conventions import triple
from workbench.recording.episode.row import LibraryRow, Source
from workbench.recording.films import FilmEye, cameras_by_name
from workbench.recording.lerobot.export import ExportOptions
from workbench.recording.library.library import Library
from workbench.session.review.view import ReviewView
from workbench.ui.library.panel import LibraryPanel
from workbench.ui.server.file_response import Downloads
from workbench.ui.server.gated_server import GatedServer
from workbench.ui.share.make import (
    EVERY_CAMERA,
    Made,
    MakeRequest,
    Making,
    MakingView,
    What,
    file_name,
    zip_name,
)
from workbench.ui.share.rerun_view import RerunPages, RerunView
from workbench.ui.widgets.parts import PagePart
from workbench.ui.widgets.templates import counted, render

WHAT: dict[str, What] = {
    "Video of a camera (mp4)": "film",
    "Video of the 3D view (mp4)": "scene",
    "Animated 3D page (html)": "page",
    "Sheet of pictures (png)": "sheet",
    "The recording itself (zip)": "zip",
    "LeRobot dataset": "lerobot",
    "ManiSkill demonstrations (h5)": "maniskill",
}
WHEN = "\u2039date and time\u203a"
DATASETS: tuple[What, ...] = ("lerobot", "maniskill")
"""One of all recordings, kept in the folder of recordings."""
ALL_CAMERAS = "every camera"
SELECTED, OPENED = "the selected recordings", "the open recordings"
MOST_SHOWN = 6
"""Results in the list; the newest."""
MOST_NAMED = 5
"""Recordings and files that are named before they are made; the others are counted."""


@dataclass(frozen=True)
class Chosen:
    """The recordings that the tab is about: those selected in the library, or else those that are open."""

    sources: tuple[Source, ...] = ()
    cameras: tuple[str, ...] = ()
    """Known only for recordings that are open."""
    selected: bool = False
    """They are those selected in the library."""
    in_view: bool = False
    """It is the one recording in the 3-D view: a film of the view uses the page's viewpoint."""
    successes: int | None = None
    """How many of them reach success at some step; None where it is not known of each."""


class SharePanel:
    """The controls in the present container.

    Args:
        server: The page.
        offers: Downloads of what was made.
        making: Makes it; outlives this page.
        folder: Datasets go into ``datasets`` below it.
    """

    def __init__(self, server: viser.ViserServer, offers: Downloads, making: Making, folder: Path) -> None:
        self._offers, self._making, self._folder = offers, making, folder
        self._chosen = Chosen()
        self._drawn: object = None
        self._of = server.gui.add_dropdown(
            "Share", (SELECTED, OPENED), initial_value=SELECTED, visible=False, hint="Stays as you choose it"
        )
        self._about = server.gui.add_html("")
        self._what = server.gui.add_dropdown("Make", tuple(WHAT))
        self._camera = server.gui.add_dropdown("Camera", _names(()))
        self._successes = server.gui.add_checkbox(
            "Only successes", True, hint="Leave out recordings that reach success at no step"
        )
        self._fitting = server.gui.add_checkbox(
            "Only compatible ones",
            True,
            hint="Leave out recordings that cannot be read, or lack what the first one has; the result names them",
        )
        self._task = server.gui.add_text(
            "Task", "", hint="In words, for policies that take a language instruction; empty: the task's id"
        )
        self._will = server.gui.add_html("")
        self._make = server.gui.add_button("Make", icon=viser.Icon.SPARKLES)
        self._stop = server.gui.add_button("Stop", icon=viser.Icon.PLAYER_STOP, color="gray", visible=False)
        self._made = server.gui.add_html("")
        self._wants_successes = True
        """As a person ticked it, while there is a success to choose."""
        self._successes.on_update(self._on_successes)
        self._make.on_click(lambda event: self._start(event.client))
        self._stop.on_click(lambda _: self._making.stop())

    def _on_successes(self, event: viser.GuiEvent) -> None:
        if event.client is not None and not self._successes.disabled:
            self._wants_successes = self._successes.value

    def takes_opened(self, choice: bool) -> bool:
        """Whether the person chose the open recordings instead of the selected ones; `choice`: there are both."""
        self._of.visible = choice
        return choice and self._of.value == OPENED

    def draw(self, chosen: Chosen) -> None:
        self._chosen = chosen
        view = self._making.view()
        what = WHAT[self._what.value]
        camera = self._camera.value
        now = (chosen, view, what, camera, self._wants_successes)
        if now == self._drawn:
            return
        self._drawn = now
        names = [source.stem for source in chosen.sources]
        files = list(zip(short_names(names), names))
        self._about.content = render("share_about", files=files, most=MOST_NAMED, selected=chosen.selected)
        options = _names(chosen.cameras)
        if self._camera.options != options:
            self._camera.options = options
        self._camera.visible = what == "film" and len(options) > 2
        self._successes.visible = what in DATASETS
        self._successes.disabled = chosen.successes == 0
        self._successes.value = self._wants_successes and chosen.successes != 0
        self._fitting.visible = what in DATASETS and len(names) > 1
        self._task.visible = what == "lerobot"
        self._make.visible = not view.running
        self._stop.visible = view.running
        self._make.disabled = not chosen.sources
        will = None if view.running or not names else self._will_make(what, camera)
        self._will.content = "" if will is None else render("share_will", **will, most=MOST_NAMED)
        self._made.content = self._html(view)

    def _will_make(self, what: What, camera: str) -> dict[str, Any]:
        return will_make(what, self._chosen, camera, self._folder, self._successes.value)

    def _start(self, client: viser.ClientHandle | None) -> None:
        chosen, what = self._chosen, WHAT[self._what.value]
        if not chosen.sources:
            return
        wanted = MakeRequest(what, chosen.sources, Path(), eye=_eye_of(client) if chosen.in_view else None)
        if what in DATASETS:
            now = datetime.datetime.now()
            words = self._task.value.strip()[:400]
            export = ExportOptions(
                only_successes=self._successes.value,
                only_fitting=self._fitting.value,
                instruction=words or None,
            )
            folder = self._folder / "datasets" / dataset_name(what, f"{now:%Y-%m-%dT%H-%M-%S}")
            self._making.start(replace(wanted, folder=folder, export=export))
            return
        camera = self._camera.value if self._camera.value in chosen.cameras else EVERY_CAMERA
        # A new folder each time: a file of the same name may exist from before.
        folder = Path(tempfile.mkdtemp(dir=self._making.scratch()))
        self._making.start(replace(wanted, folder=folder, camera=camera))

    def _html(self, view: MakingView) -> str:
        made = [(one, self._links(one)) for one in view.made[:MOST_SHOWN]]
        return render("share", view=view, made=made)

    def _links(self, made: Made) -> list[tuple[str, Path, str]]:
        """Address, path and short name of each file."""
        # A dataset stays where it is: the .h5 of demonstrations belongs to the .json beside it.
        kept = self._folder / "datasets"
        files = [path for path in made.paths if path.is_file() and not path.is_relative_to(kept)]
        short = short_names([path.name for path in files])
        return [(self._offers.address(path, download=True), path, name) for path, name in zip(files, short)]


def will_make(
    what: What, chosen: Chosen, camera: str, folder: Path, only_successes: bool = False
) -> dict[str, Any]:
    """What a press on *Make* will make, as far as known before the recordings are read: a description, the files with
    their short names, the folder ``where`` they go (empty for downloads), and a sentence of what to know before."""
    names = [source.stem for source in chosen.sources]
    of = "of it" if len(names) == 1 else f"of these {len(names)} recordings"
    if what in DATASETS:
        where = f"{folder / 'datasets'}/{dataset_name(what, WHEN)}"
        known, note = chosen.successes, ""
        if known == 0:
            note = (
                "It does not reach success."
                if len(names) == 1
                else "None of them reaches success: all are taken."
            )
        elif only_successes and known is not None and known < len(names):
            of = f"of the {known} of these {len(names)} recordings that reach success"
        one = "one dataset" if what == "lerobot" else "one file of demonstrations, and its .json,"
        return {"what": f"{one} {of}", "files": (), "where": where, "note": note}
    if what == "zip":
        archive = zip_name(names)
        named = list(zip([archive], short_names([archive])))
        return {"what": f"one archive {of}", "files": named, "where": "", "note": ""}
    if what != "film":
        files = [file_name(what, name) for name in names]
    elif camera in chosen.cameras:
        files = [file_name(what, name, camera) for name in names]
    elif chosen.cameras and len(names) == 1:
        files = [file_name(what, name, known) for name in names for known in chosen.cameras]
    else:
        known = f" ({', '.join(chosen.cameras)})" if chosen.cameras else ""
        return {"what": f"one video for each camera{known} {of}", "files": (), "where": "", "note": ""}
    named = list(zip(files, short_names(files)))
    return {"what": counted(len(files), "file"), "files": named, "where": "", "note": ""}


def dataset_name(what: What, when: str) -> str:
    """Of the folder or file below ``datasets``."""
    return f"lerobot_{when}" if what == "lerobot" else f"demonstrations_{when}.h5"


_TIME = re.compile(r"_\d{4}-\d\d-\d\dT\d\d-\d\d-\d\d")


def short_names(names: Sequence[str]) -> list[str]:
    """Names without the time at their end, unless two would become equal."""
    short = [_TIME.sub("", name) for name in names]
    return short if len(set(short)) == len(short) else list(names)


def _names(cameras: tuple[str, ...]) -> tuple[str, ...]:
    return (ALL_CAMERAS, *cameras)


def _eye_of(client: viser.ClientHandle | None) -> FilmEye | None:
    """The page's viewpoint."""
    if client is None or client.camera.image_width == 0:
        return None
    camera = client.camera
    return FilmEye(
        triple(camera.position), triple(camera.look_at), triple(camera.up_direction), float(camera.fov)
    )


class Sharing:
    """Downloads, rerun and work in progress: what outlives the pages. One for each `GatedServer`."""

    def __init__(self, gated_server: GatedServer) -> None:
        self._offers = Downloads(gated_server)
        self._rerun = RerunPages(gated_server, self._offers)
        self._making = Making()

    def part(
        self,
        server: viser.ViserServer,
        library: Library,
        table: LibraryPanel,
        make_way: Callable[[Callable[[bool], None]], int],
        unfolded: Callable[[], None],
    ) -> SharePart:
        """The Share tab, in the present container; `make_way` and `unfolded` as `RerunView` has them."""
        share = SharePanel(server, self._offers, self._making, library.folder)
        server.gui.add_divider()
        return SharePart(library, table, share, RerunView(server, self._rerun, make_way, unfolded))

    def close(self) -> None:
        """Stop the present work and delete the downloads."""
        self._making.close()


class SharePart(PagePart[ReviewView]):
    """The Share tab of a review page."""

    def __init__(self, library: Library, table: LibraryPanel, share: SharePanel, rerun: RerunView) -> None:
        self._library, self._table, self._share, self._rerun = library, table, share, rerun

    def draw(self, view: ReviewView) -> None:
        opened = {one.id: one.episode for one in view.opened}
        ids = self._table.selected()
        if self._share.takes_opened(bool(ids) and bool(opened) and set(ids) != set(opened)):
            ids = ()
        rows = [row for row in map(self._library.row, ids or tuple(opened)) if row is not None]
        rows = [row for row in rows if row.problem is None]
        cameras = {name: None for row in rows if row.id in opened for name in cameras_by_name(opened[row.id])}
        alone = len(rows) == 1 and len(view.opened) == 1 and rows[0].id in opened
        reached = [row.success_once for row in rows]
        successes = None if not rows or None in reached else reached.count(True)
        sources = tuple(row.source for row in rows)
        self._share.draw(Chosen(sources, tuple(cameras), bool(ids), alone, successes))
        states = {one.id: state for one, state in zip(view.opened, view.states)}
        moments = {path: states[row.id] for row in rows if row.id in states for path in rerun_files((row,))}
        self._rerun.draw(rerun_files(rows), len(rows), moments)


def rerun_files(rows: Sequence[LibraryRow]) -> tuple[Path, ...]:
    """The .rrd files of these rows; ManiSkill's recordings have none."""
    return tuple(path for row in rows for path in row.paths if path.suffix == ".rrd")
