"""Sharing and rerun on the review page: which recordings they are about, and what outlives the page.

They are about the recordings that are selected in the library, and where none is, about those that are open; where both are
there and differ, a person chooses.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import viser

from workbench.recording.camera_pictures import cameras_by_name
from workbench.recording.library import Library
from workbench.recording.library_row import LibraryRow
from workbench.recording.sources import Source
from workbench.session.review_view import ReviewView
from workbench.ui.door import Door
from workbench.ui.library_panel import LibraryPanel
from workbench.ui.making import Making
from workbench.ui.offers import Offers
from workbench.ui.parts import Part
from workbench.ui.rerun_view import RerunPages, RerunView
from workbench.ui.review_page import AddPart, Places, ReviewOffers
from workbench.ui.share_panel import Chosen, SharePanel

if TYPE_CHECKING:
    from workbench.ui.put_together import Workplace


class Sharing:
    """What is shared of a folder of recordings through a door, whatever page is shown. One a door."""

    def __init__(self, door: Door) -> None:
        self._offers = Offers(door)
        self._rerun = RerunPages(door, self._offers)
        self._making = Making()

    def offer(self, place: Workplace, offers: ReviewOffers) -> ReviewOffers:
        """`offers` with the Share tab, for `Workplace.offer`."""
        return replace(offers, parts=(*offers.parts, self._part(place.shelf.library)))

    def _part(self, library: Library) -> AddPart:
        def build(server: viser.ViserServer, places: Places) -> SharePart:
            with places.share:
                share = SharePanel(server, self._offers, self._making, library.folder)
                server.gui.add_divider()
                rerun = RerunView(server, self._rerun, places.make_way, places.unfolded)
            return SharePart(library, places.library, share, rerun)

        return build

    def close(self) -> None:
        """Stop what is made, and take away what was made for the page."""
        self._making.close()


class SharePart(Part[ReviewView]):
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
        self._share.draw(
            Chosen(tuple(map(source_of, rows)), tuple(cameras), selected=bool(ids), in_view=alone)
        )
        states = {one.id: state for one, state in zip(view.opened, view.states)}
        moments = {path: states[row.id] for row in rows if row.id in states for path in rerun_files((row,))}
        self._rerun.draw(rerun_files(rows), len(rows), moments)


def source_of(row: LibraryRow) -> Source:
    """What a row of the library is read from."""
    if row.kind == "lerobot" and row.trajectory is not None:
        return Source(row.paths[0].parents[1], row.trajectory)
    if row.trajectory is not None:
        return Source(row.paths[0].with_suffix(".h5"), row.trajectory)
    return Source(row.paths[0])


def rerun_files(rows: Sequence[LibraryRow]) -> tuple[Path, ...]:
    """The .rrd files of these; ManiSkill's recordings have none."""
    return tuple(path for row in rows for path in row.paths if path.suffix == ".rrd")
