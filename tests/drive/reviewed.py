"""The review page on real files, without a browser: open recordings, operate on them, and see what is shown."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.drive.charts import Chart
from tests.drive.panels import Clock, Panels, forget_what_was_drawn
from tests.drive.waiting import until
from workbench.app.review_page import ReviewPage
from workbench.app.server import App
from workbench.app.session import Session
from workbench.live.timeline_commands import Seek
from workbench.page.door.gated_server import GatedServer
from workbench.review.commands import SelectRecording
from workbench.task.description import TaskOptions


def no_session(*_: object) -> Session:
    raise AssertionError("no test here goes live from a recording")


class Reviewed(Panels):
    """The review page of a folder, operated by a test; needs the fixture `child_process`."""

    def __init__(self, gated_server: GatedServer, folder: Path) -> None:
        super().__init__(gated_server.server)
        self.app = App(gated_server, folder, no_session, TaskOptions())
        self.come_to(self.app.shared.visitors)
        self.review, self.library = self.app.shared.recordings.review, self.app.shared.recordings.library
        self.library.refresh()
        self.clock = Clock()
        self.page = ReviewPage(
            self.app.shared, self.app.open_task, self.app.review_tools, self.app.does, clock=self.clock
        )
        self.visitors.do = self.page.do

    def draw(self) -> None:
        self.clock.passes()
        self.page.redraw()

    def all_drawn(self) -> dict[str, object]:
        """Everything visible after a forced redraw of every part."""
        unread = 'class="wb-library-picture"></td>'
        until(lambda: self.draw() or unread not in self.html(unread), "the thumbnails of the library")
        forget_what_was_drawn(self.page._parts)
        self.draw()
        return self.everything()

    def open(self, *seeds: int) -> None:
        rows = {-1 if row.seed is None else row.seed: row.id for row in self.library.view().rows}
        self.review.open([rows[seed] for seed in seeds])
        until(
            lambda: len(self.review.view().opened) == len(seeds) and not self.review.view().loading,
            "the opened recordings",
            seen=lambda: self.review.view().problems,
        )
        self.draw()

    def select(self, index: int) -> None:
        self.review.do(SelectRecording(id=self.review.view().opened[index].id))

    def seek(self, position: int) -> None:
        self.review.do(Seek(step=position))
        self.draw()

    def chart(self, title: str) -> Chart:
        (chart,) = (chart for chart in self.part("Curves").charts() if chart.title == title)
        return chart


@contextmanager
def review_of(gated_server: GatedServer, folder: Path) -> Iterator[Reviewed]:
    reviewed = Reviewed(gated_server, folder)
    try:
        yield reviewed
    finally:
        reviewed.app.close()
