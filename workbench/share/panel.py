"""The Share tab: exports the selected or open recordings, offers downloads, and opens recordings in rerun."""

from __future__ import annotations

import datetime
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import viser

from workbench.episodes.films import FilmEye, cameras_by_name
from workbench.episodes.lerobot.export import ExportOptions
from workbench.episodes.row import LibraryRow, Source
from workbench.library.folder import Library
from workbench.library.panel import LibraryPanel
from workbench.page.command import Command, Refused
from workbench.page.door.file_response import Downloads
from workbench.page.door.gated_server import GatedServer
from workbench.page.widgets.fields import Field, choice, tick
from workbench.page.widgets.parts import PagePart
from workbench.page.widgets.templates import counted, render
from workbench.page.widgets.tools import tool, tools_html
from workbench.page.widgets.visitors import Visitor
from workbench.pictures.camera_conventions import triple
from workbench.review.view import ReviewView
from workbench.share.commands import (
    MAX_INSTRUCTION_CHARACTERS,
    ChooseFilmed,
    ChooseMade,
    ChooseShared,
    MakeShared,
    StopMaking,
    TakeOnlyCompatible,
    TakeOnlySuccesses,
    TypeInstruction,
    What,
)
from workbench.share.make import EVERY_CAMERA, Made, MakeRequest, Making, MakingView, file_name, zip_name
from workbench.share.rerun_panel import RerunPages, RerunView

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
"""Kinds for which all recordings become one dataset, in the folder of recordings."""
ALL_CAMERAS = "every camera"
SHARED = {"the selected recordings": False, "the open recordings": True}
SUCCESSES_HINT = "Leave out recordings without success at any step"
FITTING_HINT = "Leave out recordings that cannot be read, or lack data that the first recording has; the result names them"
TASK_HINT = "In words, for policies that take a language instruction; empty: the task's id"
MAX_RESULTS = 6
"""Maximum number of results in the list, newest first."""
MAX_NAMED = 5
"""Maximum number of recordings and of files that the panel names before *Make* is pressed; it counts the
others."""


@dataclass(frozen=True)
class Chosen:
    """The recordings to share: those selected in the library, or those that are open."""

    sources: tuple[Source, ...] = ()
    cameras: tuple[str, ...] = ()
    """Names of the cameras; known only for open recordings."""
    selected: bool = False
    """Whether `sources` are the recordings selected in the library."""
    in_view: bool = False
    """Whether there is one recording to share, and only this one is open. A film of the 3-D view then uses
    the page's viewpoint."""
    successes: int | None = None
    """Number of recordings that reach success at some step; None if that is unknown for some of them."""


@dataclass(frozen=True)
class ShareChoices:
    """The user's choices."""

    opened: bool = False
    """Whether the open recordings are used instead of the selected ones."""
    what: What = "film"
    camera: str = EVERY_CAMERA
    only_successes: bool = True
    only_fitting: bool = True
    words: str = ""


class SharePanel:
    """The controls for sharing, in the present container.

    Args:
        server: The page.
        offers: Downloads of the results.
        making: Carries out requests; outlives this page.
        folder: Datasets are written into ``datasets`` below it.
    """

    does = (
        ChooseShared,
        ChooseMade,
        ChooseFilmed,
        TakeOnlySuccesses,
        TakeOnlyCompatible,
        TypeInstruction,
        MakeShared,
        StopMaking,
    )

    def __init__(self, server: viser.ViserServer, offers: Downloads, making: Making, folder: Path) -> None:
        self._offers, self._making, self._folder = offers, making, folder
        self._chosen, self._choices = Chosen(), ShareChoices()
        self._drawn: object = None
        gui, first = server.gui, self._choices
        self._shared = choice(
            server, "Share", ChooseShared, "opened", SHARED, first.opened, hint="Your choice is kept"
        )
        self._about = gui.add_html("")
        self._whats = choice(server, "Make", ChooseMade, "what", WHAT, first.what)
        self._cameras = choice(server, "Camera", ChooseFilmed, "camera", _names(()), first.camera)
        self._successes = tick(
            server, "Only successes", TakeOnlySuccesses, "on", first.only_successes, hint=SUCCESSES_HINT
        )
        self._fitting = tick(
            server, "Only compatible ones", TakeOnlyCompatible, "on", first.only_fitting, hint=FITTING_HINT
        )
        self._task = Field(
            server, "Task", TypeInstruction, "words", hint=TASK_HINT, longest=MAX_INSTRUCTION_CHARACTERS
        )
        self._will = gui.add_html("")
        self._tools = gui.add_html("")
        self._made = gui.add_html("")

    def choose_opened(self, both: bool) -> bool:
        """Show the choice between open and selected recordings if both exist; returns whether to share the open ones.

        Args:
            both: whether some recordings are open and different ones are selected.
        """
        self._shared.visible = both
        return both and self._choices.opened

    def do(self, command: Command, visitor: Visitor) -> None:
        match command:
            case ChooseShared(opened=opened):
                self._choices = replace(self._choices, opened=opened)
            case ChooseMade(what=what):
                self._choices = replace(self._choices, what=what)
            case ChooseFilmed(camera=camera):
                self._choices = replace(self._choices, camera=camera)
            case TakeOnlySuccesses(on=on):
                self._choices = replace(self._choices, only_successes=on)
            case TakeOnlyCompatible(on=on):
                self._choices = replace(self._choices, only_fitting=on)
            case TypeInstruction(words=words):
                self._choices = replace(self._choices, words=words)
            case MakeShared():
                self._start(visitor.client)
            case StopMaking():
                self._making.stop()

    def draw(self, chosen: Chosen) -> None:
        self._chosen = chosen
        view, choices = self._making.view(), self._choices
        now = (chosen, view, choices)
        if now == self._drawn:
            return
        self._drawn = now
        what, is_dataset = choices.what, choices.what in DATASETS
        names = [source.stem for source in chosen.sources]
        files = list(zip(short_names(names), names))
        self._about.content = render("share_about", files=files, most=MAX_NAMED, selected=chosen.selected)
        self._shared.show(choices.opened)
        self._whats.show(what)
        self._cameras.show(self._camera(), options=_names(chosen.cameras))
        self._cameras.visible = what == "film" and len(chosen.cameras) > 1
        self._successes.show(self._only_successes(), off=chosen.successes == 0)
        self._successes.visible = is_dataset
        self._fitting.show(choices.only_fitting)
        self._fitting.visible = is_dataset and len(names) > 1
        self._task.show(choices.words)
        self._task.visible = what == "lerobot"
        make = tool("Make", MakeShared(), off=not chosen.sources, tone="main")
        self._tools.content = tools_html([tool("Stop", StopMaking()) if view.running else make])
        will = None if view.running or not names else self._will_make()
        self._will.content = "" if will is None else render("share_will", **will, most=MAX_NAMED)
        self._made.content = self._html(view)

    def _camera(self) -> str:
        """The chosen camera if these recordings have it, else all cameras."""
        return self._choices.camera if self._choices.camera in self._chosen.cameras else EVERY_CAMERA

    def _only_successes(self) -> bool:
        """Whether to use only successes: the user's choice, unless no recording reaches success."""
        return self._choices.only_successes and self._chosen.successes != 0

    def _will_make(self) -> dict[str, Any]:
        what, camera = self._choices.what, self._camera()
        return will_make(what, self._chosen, camera, self._folder, self._only_successes())

    def _start(self, client: viser.ClientHandle) -> None:
        chosen, choices = self._chosen, self._choices
        if not chosen.sources:
            raise Refused("Select recordings in the library, or open one, first.")
        eye = _eye_of(client) if chosen.in_view else None
        wanted = MakeRequest(choices.what, chosen.sources, Path(), eye=eye)
        if choices.what in DATASETS:
            now = datetime.datetime.now()
            export = ExportOptions(
                only_successes=self._only_successes(),
                only_fitting=choices.only_fitting,
                instruction=choices.words.strip() or None,
            )
            folder = self._folder / "datasets" / dataset_name(choices.what, f"{now:%Y-%m-%dT%H-%M-%S}")
            self._making.start(replace(wanted, folder=folder, export=export))
            return
        self._making.start(replace(wanted, camera=self._camera()), download=True)

    def _html(self, view: MakingView) -> str:
        made = [(one, self._links(one)) for one in view.made[:MAX_RESULTS]]
        return render("share", view=view, made=made)

    def _links(self, made: Made) -> list[tuple[str, str, str, int]]:
        """Address, name, short name and bytes of each file to download. A dataset is not offered: the .h5 of demonstrations
        belongs to the .json next to it."""
        paths = made.paths[: len(made.sizes)]
        names = [path.name for path in paths]
        addresses = [self._offers.address(path, download=True) for path in paths]
        return list(zip(addresses, names, short_names(names), made.sizes))


def will_make(
    what: What, chosen: Chosen, camera: str, folder: Path, only_successes: bool = False
) -> dict[str, Any]:
    """What *Make* would write, as far as known before the recordings are read: ``what`` (a description),
    ``files`` (names and short names), ``where`` (the path of a dataset; empty for downloads) and ``note``."""
    names = [source.stem for source in chosen.sources]
    of = "of it" if len(names) == 1 else f"of these {len(names)} recordings"
    if what in DATASETS:
        where = f"{folder / 'datasets'}/{dataset_name(what, WHEN)}"
        known, note = chosen.successes, ""
        if known == 0:
            note = (
                "This recording does not reach success."
                if len(names) == 1
                else "None of these recordings reaches success: all are included."
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
    """Name of the folder or file below ``datasets``."""
    return f"lerobot_{when}" if what == "lerobot" else f"demonstrations_{when}.h5"


_TIME = re.compile(r"_\d{4}-\d\d-\d\dT\d\d-\d\d-\d\d")


def short_names(names: Sequence[str]) -> list[str]:
    """The names without their date and time; the whole names if two of them would become equal."""
    short = [_TIME.sub("", name) for name in names]
    return short if len(set(short)) == len(short) else list(names)


def _names(cameras: tuple[str, ...]) -> dict[str, str]:
    return {ALL_CAMERAS: EVERY_CAMERA, **{camera: camera for camera in cameras}}


def _eye_of(client: viser.ClientHandle) -> FilmEye | None:
    """The page's viewpoint."""
    if client.camera.image_width == 0:
        return None
    camera = client.camera
    return FilmEye(
        triple(camera.position), triple(camera.look_at), triple(camera.up_direction), float(camera.fov)
    )


class Sharing:
    """Downloads, rerun and the running job, which outlive the pages. One object per `GatedServer`."""

    def __init__(self, gated_server: GatedServer) -> None:
        self._offers = Downloads(gated_server.add_route)
        self._rerun = RerunPages(gated_server, self._offers)
        self._making = Making()

    def part(
        self,
        server: viser.ViserServer,
        library: Library,
        table: LibraryPanel,
        make_way: Callable[[Callable[[bool], None]], int],
    ) -> SharePart:
        """The Share tab, in the present container; for `make_way` see `RerunView`."""
        share = SharePanel(server, self._offers, self._making, library.folder)
        server.gui.add_divider()
        return SharePart(library, table, share, RerunView(server, self._rerun, make_way))

    def close(self) -> None:
        """Stop the present job and delete the downloads."""
        self._making.close()


class SharePart(PagePart[ReviewView]):
    """The Share tab of a review page."""

    does = (*SharePanel.does, *RerunView.does)

    def __init__(self, library: Library, table: LibraryPanel, share: SharePanel, rerun: RerunView) -> None:
        self._library, self._table, self._share, self._rerun = library, table, share, rerun

    def do(self, command: Command, visitor: Visitor) -> None:
        owner = self._rerun if isinstance(command, RerunView.does) else self._share
        owner.do(command, visitor)

    def close(self) -> None:
        """Release the part, because the page is removed."""
        self._rerun.end()

    def draw(self, view: ReviewView) -> None:
        opened = {one.id: one.episode for one in view.opened}
        ids = self._table.selected()
        if self._share.choose_opened(bool(ids) and bool(opened) and set(ids) != set(opened)):
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
